"""Test a stage whose axes are excited one at a time: the other one is within its noise then."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from levid.benchmarks.trace.imported_plant_cases import low_pass_noise
from levid.benchmarks.trace.imported_plant_simulation import Acting, Kind, Linear, simulated
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.records.record import IdentificationError, NotARecordError
from levid.identification.trace.force_balance.reported_errors import output_noise
from levid.identification.trace.force_trace.force_trace_summary import force_summary
from levid.identification.trace.force_trace.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.read_records import require_live
from levid.identification.trace.records.record_from_log import TraceRecord, imported_trace_record
from levid.model.effects.candidate_effects import all_effects

STAGE = """
levid: model
name: stage
dof: [{name: x, unit: m}, {name: y, unit: m}]
inputs: [{name: u, unit: N}, {name: v, unit: N}]
parameters:
  mx: {value: 2.4, unit: kg, min: 0, max: 20}
  my: {value: 1.6, unit: kg, min: 0, max: 20}
  dx: {value: 5, unit: N s/m, min: 0, max: 100}
  dy: {value: 4, unit: N s/m, min: 0, max: 100}
  kx: {value: 300, unit: N/m, min: 0, max: 9000}
  ky: {value: 500, unit: N/m, min: 0, max: 9000}
  c: {value: 3, unit: N/m}
M: [[mx, 0], [0, my]]
D: [[dx, 0], [0, dy]]
K: [[kx, c], [c, ky]]
B: [[1, 0], [0, 1]]
"""
MASSES, DAMPERS, SPRINGS, FRICTION_N = (2.0, 1.3), (6.0, 5.0), (250.0, 420.0), 0.3
TRUTH = np.array([*MASSES, *DAMPERS, *SPRINGS])
TS, ROWS = 0.005, 8000


def recorded(*excited: int) -> list[TraceRecord]:
    """Return records of the stage with a friction of x, each with one axis excited."""
    none = np.zeros((2, 2))
    plant = Linear(
        np.diag(MASSES), np.diag(DAMPERS), np.diag(SPRINGS), np.eye(2), none, none,
        np.full(2, 1e-5), TS, 20,
    )  # fmt: skip
    config, records = parse_text(STAGE, ModelConfig, "stage"), []
    friction = Acting(Kind.COULOMB, 0, np.array([FRICTION_N, 0.002]))
    for number, axis in enumerate(excited):
        rng = np.random.default_rng(number)
        v = np.zeros((ROWS, 2))
        v[:, axis] = 4.0 * low_pass_noise(rng, ROWS, TS, 6.0)
        moved = simulated(plant, v, rng, friction)
        name = f"{number}-{'xy'[axis]}"
        record = Experiment(name, TS, moved.u, moved.y, {}, frozenset(), False)
        records.append(imported_trace_record(record, config))
    return records


def traced(*excited: int) -> ForceTrace:
    config = parse_text(STAGE, ModelConfig, "stage")
    return trace_records(recorded(*excited), config, all_effects, lambda *_: None)


def test_axes_that_are_excited_one_at_a_time_are_traced() -> None:
    """The noise of the other axis limited the band to nothing. It shows no coupling either: what
    no record tells of keeps its declared value, without an interval."""
    found = traced(0, 1)
    (law,) = force_summary(found)["effects"]
    assert (law["class"], law["where"]) == ("friction", ["x"])
    own = law["parameters"]["friction"]
    assert abs(own["value"] - FRICTION_N) < 4.0 * own["se"] < 0.04
    *values, coupling = found.found.point.values
    *errors, of_coupling = found.errors[:7]
    assert np.all(np.abs(values - TRUTH) < 4.0 * np.array(errors))
    assert np.all(np.array(errors) < 0.01 * TRUTH)
    assert coupling == pytest.approx(3.0, rel=1e-12)  # not fitted
    assert of_coupling == np.inf
    assert "x is within its noise in 1-y, and counts as at rest there" in found.notes


def test_axis_that_is_excited_in_no_record_is_named() -> None:
    with pytest.raises(IdentificationError, match="found y within the noise in every record"):
        traced(0)


def stays(record: TraceRecord, axis: int) -> TraceRecord:
    """Return a record in which the encoder of an axis stays at 1 mm."""
    y = record.experiment.y.copy()
    y[:, axis] = 1e-3
    return replace(record, experiment=replace(record.experiment, y=y), gap=y)


def test_axis_that_nothing_pushes_may_stay_at_one_reading() -> None:
    x, _ = recorded(0, 1)
    require_live(stays(x, 1), Path("x.mcap"))
    with pytest.raises(NotARecordError, match=r"left out: x is frozen at 0.001 m in every row"):
        require_live(stays(x, 0), Path("x.mcap"))
    with pytest.raises(NotARecordError, match="left out: x, y is frozen"):
        require_live(stays(stays(x, 0), 1), Path("x.mcap"))


def test_noise_of_an_axis_is_that_of_records_in_which_it_moves() -> None:
    x, y = recorded(0, 1)
    sd = output_noise([stays(x, 1), stays(x, 1), y])
    np.testing.assert_allclose(sd[1], output_noise([y])[1])
