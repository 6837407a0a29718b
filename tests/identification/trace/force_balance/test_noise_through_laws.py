"""Test what the noise of the outputs gives of the missing force: by matrices, and through laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.free_parameters import free_parameters
from levid.identification.trace.force_balance.force_record import ForceModel, force_records
from levid.identification.trace.force_balance.noise_through_laws import noise_with_laws
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects

CONFIG = parse_text(
    """
levid: model
name: mass
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
M: [[2.0]]
D: [[3.0]]
K: [[50.0]]
""",
    ModelConfig,
    "mass",
)
TS, ROWS, SD, LIMIT_HZ = 0.002, 20_000, 1e-5, 10.0


def test_a_friction_passes_on_the_noise_of_its_turns_and_a_linear_model_what_is_computed() -> None:
    t, rng = np.arange(ROWS) * TS, np.random.default_rng(1)
    still = 0.01 * (np.sin(2 * np.pi * 0.7 * t) + np.sin(2 * np.pi * 1.9 * t))[:, None]
    once = still + SD * rng.normal(size=still.shape)
    twice = once + SD * rng.normal(size=still.shape)
    records = [
        imported_trace_record(
            Experiment("r", TS, np.zeros((ROWS, 1)), y, {}, frozenset(), False), CONFIG
        )
        for y in (still, once, twice)
    ]
    clean, noisy, noisier = force_records(records, "zoh", LIMIT_HZ, [50.0] * 3, np.array([SD]))
    effects = {e.key: e for e in all_effects(records[0].places)}
    friction = Placed(effects["friction.coulomb"], (1e-4,), (5.0,))
    plain = ForceModel(declared_model(CONFIG), free_parameters(CONFIG), ())
    for point, through_law in ((plain, 1.0), (replace(plain, placed=(friction,)), 2.0)):
        truth = (noisy.missing_force(point) - clean.missing_force(point)).std(axis=0)
        (found,) = noise_with_laws(point, [noisy], [noisier])
        # 800 independent values tell each RMS to 3 %, turns less well: half of it.
        np.testing.assert_allclose(found, truth, rtol=0.5 if point.placed else 0.1)
        assert found >= through_law * noisy.noise_force(plain)
