"""Test the trace of plants whose matrices move with a scheduling variable within a record."""

from __future__ import annotations

import numpy as np

from levid.benchmarks.trace.scheduled_plants import NAMES, TS_S, Beam, declared, judged
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.free_parameters import free_parameters
from levid.identification.trace.force_balance.force_record import ForceModel, ForceRecord
from levid.identification.trace.records.record_from_log import imported_trace_record

SEED = 86_100
LIMIT_HZ, LAW_HZ = 20.0, 80.0


def test_what_the_true_model_misses_is_noise() -> None:
    rng = np.random.default_rng(SEED)
    beam = Beam.drawn("nothing missing", rng)
    config = declared(beam, rng)
    u, y, s = beam.flown(SEED)
    moving = Experiment("r", TS_S, u, y, {"s": s}, frozenset(), True)
    record = ForceRecord.of(
        imported_trace_record(moving, config), "zoh", LIMIT_HZ, LAW_HZ, np.array([beam.noise_rad])
    )
    true = dict(zip(NAMES, beam.numbers, strict=True))
    point = ForceModel(declared_model(config).with_values(true), free_parameters(config))
    missing = record.varying(record.missing_force(point))
    freq_hz, density = record.noise_density(point)
    of_noise = np.sqrt(np.sum(density[:, 0]) * freq_hz[1])
    acting = record.acting_force(point).std()
    # The density is of the mean schedule, along which inertia and stiffness are up to 60 % more.
    assert missing.std() < max(1.6 * of_noise, 1e-3 * acting)
    # Without the part of one of them that moves, far more is missing.
    for name in ("j_s", "k_s", "g_s"):
        less = ForceModel(point.model.with_values({name: 0.0}), point.parameters)
        assert record.varying(record.missing_force(less)).std() > 5.0 * missing.std()


def test_effect_of_a_plant_along_a_schedule_is_named() -> None:
    found = judged("hardening spring", SEED)
    assert found.right, str(found)
    assert not found.doubted
    assert found.force[1] < 1.0
