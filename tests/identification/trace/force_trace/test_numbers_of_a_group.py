"""Test the model's numbers beside effects that the records do not tell apart.

A beam on two linear motors, whose ends move together: which motor's current drives the other one
too, or which lever is wrong, these records do not tell. With each of these the model has other
numbers, of which the intervals have to tell.
"""

from __future__ import annotations

import numpy as np

from levid.benchmarks.trace.imported_plant_cases import low_pass_noise
from levid.benchmarks.trace.imported_plant_simulation import Linear, simulated
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.subspace.response_uncertainty import SURE_95
from levid.identification.trace.force_trace.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.base import Effect, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

GANTRY = """
levid: model
name: gantry
dof: [{name: x1, unit: m}, {name: x2, unit: m}]
inputs: [{name: f1, unit: N}, {name: f2, unit: N}]
parameters:
  ma: {value: 10.1, unit: kg, min: 0, max: 180}
  mb: {value: 6.8, unit: kg, min: 0, max: 160}
  mc: {value: 1.7, unit: kg, min: 0, max: 30}
  d1: {value: 33, unit: N s/m, min: 0, max: 800}
  d2: {value: 29, unit: N s/m, min: 0, max: 700}
  kj: {value: 66000, unit: N/m, min: 0, max: 1200000}
  dj: {value: 49, unit: N s/m, min: 0, max: 1200}
M: [[ma, mc], [mc, mb]]
D: [[d1 + dj, -dj], [-dj, d2 + dj]]
K: [[kj, -kj], [-kj, kj]]
B: [[1, 0], [0, 1]]
"""
MA, MB, MC, D1, D2, KJ, DJ = TRUTH = np.array([9.0, 8.0, 1.5, 40.0, 35.0, 60_000.0, 60.0])
CROSSTALK, NOISE_M = 0.06, 2e-5
TS, ROWS = 0.001, 20_000


def test_intervals_contain_the_numbers_that_the_model_has_with_another_member() -> None:
    rng = np.random.default_rng(1)
    M = np.array([[MA, MC], [MC, MB]])
    D = np.array([[D1 + DJ, -DJ], [-DJ, D2 + DJ]])
    K = KJ * np.array([[1.0, -1.0], [-1.0, 1.0]])
    B, none = np.array([[1.0, CROSSTALK], [0.0, 1.0]]), np.zeros((2, 2))
    plant = Linear(M, D, K, B, none, none, np.full(2, NOISE_M), TS, 20)
    v = 25.0 * np.stack([low_pass_noise(rng, ROWS, TS, 12.0) for _ in range(2)], axis=1)
    moved = simulated(plant, v, rng)
    config = parse_text(GANTRY, ModelConfig, "gantry")
    record = Experiment("r", TS, moved.u, moved.y, {}, frozenset(), False)
    records = [imported_trace_record(record, config)]

    def traced(*members: str) -> ForceTrace:
        def table(places: Places, extent: Extent) -> list[Effect]:
            every = all_effects(places, extent)
            return [e for e in every if not members or e.identity in members]

        return trace_records(records, config, table, lambda *_: None)

    found = traced()
    (crossed,) = found.found.rated
    assert len(crossed.alternatives) == 3
    values, errors = found.found.point.values, found.errors[: len(TRUTH)]
    assert np.all(np.abs(values - TRUTH) < 3.0 * errors)
    outside = np.zeros(len(TRUTH), bool)
    for other in crossed.alternatives:
        # As if the table had no other cause; frequencies have other weights then.
        alone = traced(other.placed.effect.identity)
        assert len(alone.found.rated) == 1
        own = alone.errors[: len(TRUTH)]
        assert np.all(np.abs(values - alone.found.point.values) < SURE_95 * (errors + own))
        outside |= np.abs(values - alone.found.point.values) > SURE_95 * 3.0 * own
    assert np.all(outside[[2, 5]])  # mc and kj, which the records do not tell without the cause
