"""Test whether columns are noticed that are exchanged, or of another sign than the model says."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from levid.benchmarks.trace.imported_plant_cases import low_pass_noise
from levid.benchmarks.trace.imported_plant_simulation import Acting, Kind, Linear, simulated
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_trace.force_trace_outcome import force_outcome
from levid.identification.trace.force_trace.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.base import Effect, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent
from levid.report.trace.answer import imported_answer
from levid.report.trace.imported_page import imported_report

Array = np.ndarray

MASSES = """
levid: model
name: masses
dof: [{name: a, unit: m}, {name: b, unit: m}]
inputs: [{name: f, unit: N}, {name: g, unit: N}]
parameters:
  ma: {value: 2.4, unit: kg, min: 0}
  mb: {value: 2.6, unit: kg, min: 0}
  ka: {value: 250, unit: N/m, min: 0}
  kab: {value: 120, unit: N/m, min: 0}
  da: {value: 5, unit: N s/m, min: 0}
  db: {value: 4, unit: N s/m, min: 0}
M: [[ma, 0], [0, mb]]
D: [[da, 0], [0, db]]
K: [[ka + kab, -kab], [-kab, kab]]
"""
TS, ROWS = 0.01, 2000


def traced(
    outputs: Sequence[int] = (0, 1),
    inputs: Sequence[int] = (0, 1),
    signs: Sequence[float] = (1.0, 1.0),
    friction_n: float = 0.0,
) -> ForceTrace:
    """Trace records of two masses on springs whose columns are in an order, outputs with signs."""
    none, stiffness = np.zeros((2, 2)), np.array([[320.0, -140.0], [-140.0, 140.0]])
    plant = Linear(
        np.diag([2.0, 3.0]), np.diag([6.0, 5.0]), stiffness, np.eye(2), none, none,
        np.full(2, 1e-5), TS, 20,
    )  # fmt: skip
    rubs = [Acting(Kind.COULOMB, 0, np.array([friction_n, 0.01]))] if friction_n else []
    config, records = parse_text(MASSES, ModelConfig, "masses"), []
    for seed in range(2 if friction_n else 1):
        rng = np.random.default_rng(seed)
        v = np.stack([6.0 * low_pass_noise(rng, ROWS, TS, 5.0) for _ in range(2)], axis=1)
        moved = simulated(plant, v, rng, *rubs)
        y = moved.y[:, list(outputs)] * np.array(signs)
        u = moved.u[:, list(inputs)]
        record = Experiment(f"{seed}", TS, u, y, {}, frozenset(), False)
        records.append(imported_trace_record(record, config))

    def table(places: Places, extent: Extent) -> list[Effect]:
        every = all_effects(places, extent) if friction_n else []
        return [e for e in every if e.key == "friction.coulomb"]

    return trace_records(records, config, table, lambda *_: None)


@pytest.mark.parametrize(
    ("connected", "words"),
    [
        ({"outputs": (1, 0)}, "a and b are exchanged"),
        ({"inputs": (1, 0)}, "f and g are exchanged"),
        ({"signs": (1.0, -1.0)}, "b has the other sign"),
    ],
)
def test_columns_that_are_exchanged_are_named(
    connected: dict[str, Sequence[int]], words: str, tmp_path: Path
) -> None:
    found = traced(**connected)  # type: ignore[arg-type]
    assert found.exchange is not None
    assert found.exchange.words == words
    assert np.all(found.exchange.after < 0.01)
    assert imported_answer(force_outcome(found)).startswith(f"It looks as if {words}: without")
    assert force_outcome(found).lacks_something
    page = imported_report(found, tmp_path).read_text(encoding="utf-8")
    assert f"it looks as if {words}" in page
    assert "Compare columns and units in the signals files with the rig" in page


def test_records_as_declared_are_not_exchanged() -> None:
    assert traced().exchange is None


def test_an_effect_that_is_there_is_no_exchange() -> None:
    """Half of the force is missing without it, and no order of the columns explains that."""
    found = traced(friction_n=4.0)
    assert found.exchange is None
    (law,) = force_outcome(found).laws
    assert (law.placed.effect.effect_class, law.doubts) == ("friction", ())
