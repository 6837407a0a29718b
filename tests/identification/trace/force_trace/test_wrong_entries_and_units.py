"""Trace a model file with a wrong sign in K, and a record with a column in another unit."""

from __future__ import annotations

import re

import numpy as np
import pytest

from levid.benchmarks.trace.imported_plant_cases import low_pass_noise
from levid.benchmarks.trace.imported_plant_simulation import Linear, simulated
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.subspace.response_uncertainty import SURE_95
from levid.identification.trace.force_trace.force_trace_outcome import force_outcome
from levid.identification.trace.force_trace.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.base import Effect, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

TABLE = """
levid: model
name: table
dof: [{name: x, unit: m}, {name: y, unit: m}]
inputs: [{name: f, unit: N}, {name: g, unit: N}]
parameters:
  m1: {value: 1.5, unit: kg, min: 0}
  m2: {value: 3.1, unit: kg, min: 0}
  c1: {value: 9, unit: N s/m, min: 0}
  c2: {value: 4, unit: N s/m, min: 0}
  c: {value: 10, unit: N s/m, min: 0}
  k1: {value: 1700, unit: N/m, min: 0}
  k: {value: 3500, unit: N/m, min: 0}
M: [[m1, 0], [0, m2]]
D: [[c1 + c, -c], [-c, c2 + c]]
K: [[k1 + k, -k], [-k, k]]
"""
TS, ROWS = 4e-3, 3000
TRUE = {"m1": 1.8, "m2": 2.7, "c1": 7.0, "c2": 5.0, "c": 12.0, "k1": 1500.0, "k": 4100.0}
LAWS = ("reading.gain", "coil_gain", "linear.", "friction.", "backlash", "stiffness.", "delay")

GAINS = ("reading.gain", "coil_gain", "linear.")


def traced(
    text: str,
    columns: tuple[float, float] = (1.0, 1.0),
    command: float = 1.0,
    laws: tuple[str, ...] = LAWS,
) -> ForceTrace:
    """Trace a table of two masses with springs; `columns` multiply the outputs of the record, and
    `command` its first input."""
    v, none = TRUE, np.zeros((2, 2))
    plant = Linear(
        np.diag([v["m1"], v["m2"]]),
        np.array([[v["c1"] + v["c"], -v["c"]], [-v["c"], v["c2"] + v["c"]]]),
        np.array([[v["k1"] + v["k"], -v["k"]], [-v["k"], v["k"]]]),
        np.eye(2), none, none, np.full(2, 1e-6), TS, 10,
    )  # fmt: skip
    config, records = parse_text(text, ModelConfig, "table"), []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        u = np.stack([20.0 * low_pass_noise(rng, ROWS, TS, 12.0) for _ in range(2)], axis=1)
        moved = simulated(plant, u, rng)
        y = moved.y * np.array(columns)
        record = Experiment(f"{seed}", TS, moved.u * [command, 1.0], y, {}, frozenset(), False)
        records.append(imported_trace_record(record, config))

    def table(places: Places, extent: Extent) -> list[Effect]:
        return [e for e in all_effects(places, extent) if e.key.startswith(laws)]

    return trace_records(records, config, table, lambda *_: None)


def test_a_wrong_sign_in_the_stiffness_matrix_is_a_linear_spring() -> None:
    """A friction that never slips and a gap of zero are such a spring, too."""
    trace = traced(TABLE.replace("[[k1 + k, -k]", "[[k1 + k, k]"))
    (law,) = force_outcome(trace).laws
    assert law.placed.effect.identity == "linear.stiffness@x - y"
    assert (law.alternatives, law.doubtful) == ((), False)
    assert law.parameters["k"].value == pytest.approx(TRUE["k"], rel=1e-3)
    assert any(note.startswith("k (declared 3500) is next to nothing") for note in trace.notes)


@pytest.mark.parametrize(
    ("columns", "command", "name"), [((1.0, 1000.0), 1.0, "y"), ((1.0, 1.0), 1000.0, "f")]
)
def test_a_column_in_millimetres_is_no_coupling(
    columns: tuple[float, float], command: float, name: str
) -> None:
    """It was a crosstalk of -791 and four more laws, surely."""
    trace = traced(TABLE, columns, command, laws=("reading.crosstalk",))
    assert trace.exchange is not None
    first, factor, last = re.split(r"([0-9.]+)", trace.exchange.words)
    assert (first, last) == (f"{name} is in another unit, ", " times too large")
    # Fitted without weights, it is as right as an equation is.
    assert float(factor) == pytest.approx(1000.0, rel=5e-3)
    assert trace.exchange.after.max() < 0.01
    assert all(law.doubtful for law in force_outcome(trace).laws if not law.free)


def test_of_two_outputs_a_large_gain_may_be_that_of_either() -> None:
    """All parameters of the model are free, so that the records have the ratio of the gains."""
    trace = traced(TABLE, (1.0, 57.3), laws=GAINS)
    (law,) = force_outcome(trace).laws
    # With the other one all parameters would be 57 times smaller than declared.
    assert law.placed.effect.identity == "reading.gain@y"
    assert [r.placed.effect.identity for r in law.alternatives] == ["reading.gain@x"]
    assert not law.doubtful
    assert law.parameters["error"].value == pytest.approx(1.0 - 1.0 / 57.3, abs=1e-5)
    assert trace.found.point.model.values["m1"] == pytest.approx(TRUE["m1"], rel=1e-3)


def test_a_large_gain_is_told_where_the_other_equation_has_a_declared_number() -> None:
    """A stiffness that is not free says which of the outputs is wrong."""
    k1 = "k1: {value: 1700, unit: N/m, min: 0}"
    fixed = TABLE.replace(k1, "k1: {value: 1500, unit: N/m, fixed: true}")
    trace = traced(fixed, (1.0, 57.3), laws=GAINS)
    (law,) = force_outcome(trace).laws
    assert law.placed.effect.identity == "reading.gain@y"
    assert law.alternatives == ()
    m1 = trace.found.point.parameters.names.index("m1")
    error = trace.found.point.values[m1] - TRUE["m1"]
    assert abs(error) < SURE_95 * trace.errors[m1] + 1e-3 * TRUE["m1"]


def test_a_dead_zone_wider_than_all_commands_is_a_gain() -> None:
    """A mass that is held at a wrong value is also a gain of all actuators, or of all sensors."""
    wrong = TABLE.replace(
        "m2: {value: 3.1, unit: kg, min: 0}", "m2: {value: 2.2, unit: kg, fixed: true}"
    )
    trace = traced(wrong, laws=("linear.inertia", "coil_gain", "reading.gain", "dead_zone"))
    (law,) = force_outcome(trace).laws
    named = {r.placed.effect.identity for r in (law.rated, *law.alternatives)}
    assert named == {"linear.inertia@y", "coil_gain.all@f+g", "reading.gain.all@x+y"}
