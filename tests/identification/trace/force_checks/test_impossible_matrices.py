"""Test the doubt of a law beside which the model's damping or inertia cannot be."""

from __future__ import annotations

import numpy as np

from levid.benchmarks.trace.imported_plant_cases import low_pass_noise
from levid.benchmarks.trace.imported_plant_simulation import Linear, simulated
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_trace.force_trace_outcome import force_outcome
from levid.identification.trace.force_trace.trace_imported import trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.candidate_effects import all_effects

BUOY = """
levid: model
name: buoy
dof: [{name: h, unit: m}]
inputs: [{name: f, unit: N}]
parameters:
  m: {value: 250, unit: kg}
  d: {value: 60, unit: N s/m}
  k: {value: 2900, unit: N/m}
M: [[m]]
D: [[d]]
K: [[k]]
"""
TS, ROWS = 0.02, 4000
MASS, DAMPER, SPRING, RADIATED, W, ZETA = 210.0, 25.0, 2400.0, 260.0, 1.6, 0.45


def test_a_law_that_needs_a_negative_damper_is_in_doubt() -> None:
    """Waves that a buoy radiates act back with a memory, which no law of the table is. It has the
    transfer function of a load on a soft shaft and a damper of -121 N s/m."""
    none = np.zeros((2, 2))
    plant = Linear(
        np.diag([MASS, 1.0]),
        np.array([[DAMPER, RADIATED * W], [-1.0, 2 * ZETA * W]]),
        np.diag([SPRING, W**2]),
        np.eye(2), none, none, np.full(2, 1e-5), TS, 20,
    )  # fmt: skip
    config, records = parse_text(BUOY, ModelConfig, "buoy"), []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        v = np.stack([250.0 * low_pass_noise(rng, ROWS, TS, 3.0), np.zeros(ROWS)], axis=1)
        moved = simulated(plant, v, rng)
        record = Experiment(f"{seed}", TS, moved.u[:, :1], moved.y[:, :1], {}, frozenset(), False)
        records.append(imported_trace_record(record, config))
    found = trace_records(records, config, all_effects, lambda *_: None)
    (law,) = force_outcome(found).laws
    assert law.placed.effect.effect_class == "flexible_mode"
    assert found.found.point.model.values["d"] < -50.0
    assert law.doubts == ("the damping at h is negative with it, and not without it",)
