"""Test the cost of a model whose effects leave nothing of the command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from levid.benchmarks.trace.imported_plant_cases import low_pass_noise
from levid.benchmarks.trace.imported_plant_simulation import Linear, simulated
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_search.weighed_records import unweighed
from levid.identification.trace.force_trace.trace_imported import trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects

MASS = """
levid: model
name: mass
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
parameters:
  m: {value: 2.4, unit: kg}
  d: {value: 12, unit: N s/m}
  k: {value: 800, unit: N/m}
M: [[m]]
D: [[d]]
K: [[k]]
"""
TS, ROWS = 0.005, 2000


def test_a_dead_zone_that_is_wider_than_all_commands_costs_more_than_any_model() -> None:
    """With all parameters at zero nothing would be missing."""
    none = np.zeros((1, 1))
    plant = Linear(
        np.array([[2.0]]), np.array([[15.0]]), np.array([[1000.0]]), np.eye(1), none, none,
        np.full(1, 1e-6), TS, 10,
    )  # fmt: skip
    rng = np.random.default_rng(1)
    moved = simulated(plant, 8.0 * low_pass_noise(rng, ROWS, TS, 8.0)[:, None], rng)
    config = parse_text(MASS, ModelConfig, "mass")
    made = Experiment("made", TS, moved.u, moved.y, {}, frozenset(), False)
    records = [imported_trace_record(made, config)]
    trace = trace_records(records, config, lambda *_: (), lambda *_: None)
    training, point, _ = unweighed(trace.declared, trace.fitted, trace.limit_hz, trace.options)
    (zone,) = (e for e in all_effects(records[0].places) if e.key == "dead_zone")
    largest = float(np.abs(moved.u).max())

    def cost(width: float, values: np.ndarray) -> float:
        placed = (Placed(zone, (width,), (1.0,)),)
        return training.cost(replace(point.with_values(values), placed=placed))

    assert np.isfinite(cost(0.5 * largest, point.values))
    assert cost(2.0 * largest, point.values) == np.inf
    assert cost(2.0 * largest, 1e-9 * point.values) == np.inf
