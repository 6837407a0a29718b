"""Test laws of an actuator behind the model's own lag, where they are other forces than before."""

from __future__ import annotations

import numpy as np

from levid.benchmarks.trace.imported_plant_simulation import Acting, Kind, Linear, simulated
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_trace.force_trace_summary import force_summary
from levid.identification.trace.force_trace.trace_imported import trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.candidate_effects import all_effects

PUMP = """
levid: model
name: pump
dof: [{name: q, unit: rad}]
inputs: [{name: u, unit: N m}]
parameters:
  j: {value: 0.057, unit: kg m^2, min: 0.001, max: 1}
  d: {value: 0.05, unit: N m s/rad, min: 0, max: 10}
  k: {value: 0.5, unit: N m/rad, min: 0, max: 100}
  T: {value: 0.21, unit: s, min: 0.001, max: 1}
M: [[j]]
D: [[d]]
K: [[k]]
lag_s: T
"""


def test_square_behind_a_slow_lag_is_named() -> None:
    """Before the lag it takes little, as the slow lag leaves a small part of each command."""
    rng, rows, Ts_s = np.random.default_rng(3), 8000, 0.02
    plant = Linear(
        np.array([[0.05]]), np.array([[0.06]]), np.array([[0.5]]), np.array([[1.0]]),
        np.zeros((1, 1)), np.zeros((1, 1)), np.array([2e-4]), Ts_s, 20,
    )  # fmt: skip
    v = np.convolve(rng.normal(size=rows), np.ones(8) / 8, mode="same")[:, None]
    lag, square = Acting(Kind.LAG, 0, np.array([0.25])), Acting(Kind.SQUARED, 0, np.array([0.5]))
    moved = simulated(plant, v / v.std(), rng, lag, square)
    config = parse_text(PUMP, ModelConfig, "pump")
    record = Experiment("r", Ts_s, moved.u, moved.y, {}, frozenset(), False)
    trace = trace_records(
        [imported_trace_record(record, config)], config, all_effects, lambda *_: None
    )
    (law,) = force_summary(trace)["effects"]
    assert trace.found.point.placed[0].effect.key == "actuator.squared_after_lag"
    assert not law["evidence"]["doubtful"]
    a = law["parameters"]["a"]
    assert abs(a["value"] - 0.5) < 3.0 * a["se"] + 0.005  # and an equation is 1 % right
