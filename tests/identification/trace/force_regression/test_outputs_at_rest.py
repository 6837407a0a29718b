"""Test a stage whose axes are excited one at a time: the other one is within its noise then."""

from __future__ import annotations

import numpy as np
import pytest

from levid.benchmarks.trace.imported_plant_cases import low_pass_noise
from levid.benchmarks.trace.imported_plant_simulation import Acting, Kind, Linear, simulated
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.records.record import IdentificationError
from levid.identification.trace.force_regression.force_trace_summary import force_summary
from levid.identification.trace.force_regression.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
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


def traced(*excited: int) -> ForceTrace:
    """Trace records of the stage with a friction of x, each with one axis excited."""
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
    return trace_records(records, config, all_effects, lambda *_: None)


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
    assert (coupling, of_coupling) == (3.0, np.inf)
    assert "x is within its noise in 1-y, and counts as at rest there" in found.notes


def test_axis_that_is_excited_in_no_record_is_named() -> None:
    with pytest.raises(IdentificationError, match="found y within the noise in every record"):
        traced(0)
