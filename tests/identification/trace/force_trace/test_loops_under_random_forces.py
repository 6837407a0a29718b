"""Test the trace of axes in a control loop under a random force that nothing measures.

The command follows the random force there, so that the controller turned round explains a part of
it: an actuator of negative gain, or a mass of zero, may fit better than the plant.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from levid.benchmarks.trace.random_forces_in_loops import TS_S, Axis, declared, judged
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.free_parameters import free_parameters
from levid.identification.trace.force_balance.force_record import ForceModel, ForceRecord
from levid.identification.trace.force_regression.held_out_gain import Blocks
from levid.identification.trace.force_regression.residual_whitening import Whitening
from levid.identification.trace.force_regression.training_records import Training
from levid.identification.trace.records.record_from_log import imported_trace_record


def test_what_the_equation_misses_is_the_random_force() -> None:
    drawn = Axis.drawn("nothing missing", np.random.default_rng(5))
    axis = replace(drawn, noise=0.0)
    (u, y, _), rows = axis.flown(7), slice(2, -2)
    qd, qdd = np.gradient(y[:, 0], TS_S), np.gradient(np.gradient(y[:, 0], TS_S), TS_S)
    # The mean of a held command over the rows that the differences span.
    held = np.convolve(u[:, 0], [0.125, 0.375, 0.375, 0.125])[1:-2]
    missing = (axis.m1 * qdd + axis.d1 * qd + axis.k1 * y[:, 0])[rows] - held[rows]
    # The command's own deviation is with the random force, a few per cent more than without.
    assert missing.std() / u.std() == pytest.approx(axis.random, rel=0.15)


def test_nothing_is_named_for_a_random_force() -> None:
    found = judged("nothing missing, a loop", 81_001)
    assert found.right
    assert not found.doubted


def test_a_delay_is_told_although_the_controller_turned_round_would_fit() -> None:
    # With a gain of -1.5 beside the delay, the mass went to zero, and the delay was in doubt.
    found = judged("delay, a loop", 81_006)
    assert found.right
    assert not found.doubted


def test_a_mass_of_zero_costs_more_than_any() -> None:
    rng = np.random.default_rng(1)
    axis = Axis.drawn("nothing missing", rng)
    config = declared(axis, rng)
    u, y, _ = axis.flown(1)
    experiment = Experiment("r", TS_S, u, y, {}, frozenset(), False)
    record = ForceRecord.of(
        imported_trace_record(experiment, config), config.input, 30.0, 30.0, np.array([1e-5])
    )
    flat = Whitening(np.array([0.0, 30.0]), np.ones((2, 1)), 30.0)
    training = Training.unscaled((record,), flat, Blocks.of([record.rows], 4))
    model = ForceModel(declared_model(config), free_parameters(config), ())
    values = model.values
    assert np.isfinite(training.cost(model))
    values[0] = 0.0
    assert training.cost(model.with_values(values)) == np.inf
