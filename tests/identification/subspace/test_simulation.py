"""Test simulation and prediction: block simulation, predictors, fit in percent."""

from __future__ import annotations

import numpy as np
import pytest

from levid.identification.records.record import IdentificationError, Record
from levid.identification.subspace.fit_percent import nrmse_fit_percent
from levid.identification.subspace.identify_innovation_model import (
    choose_past,
    innovation_model,
    state_sequence,
)
from levid.identification.subspace.simulation import (
    fit_input_matrices,
    initial_state,
    simulate,
    spectral_radius,
)
from levid.model.second_order import StateSpace

MODEL = StateSpace(
    np.array([[0.9, 0.3, 0.0], [-0.3, 0.9, 0.1], [0.0, 0.0, 0.7]]),
    np.array([[0.0, 1.0], [1.0, 0.0], [0.5, -1.0]]),
    np.array([[1.0, 0.0, 0.5], [0.0, 2.0, 0.0]]),
    np.array([[0.1, 0.0], [0.0, 0.2]]),
    0.1,
)


def _recursion(model, u, x):
    y = []
    for row in u:
        y.append(model.C @ x + model.D @ row)
        x = model.A @ x + model.B @ row
    return np.array(y)


def _record(v, y, name="r"):
    return Record(name, 0.1, v, y, ("a", "b"), ("1", "1"), ("c", "d"), ("1", "1"))


@pytest.mark.parametrize("rows", [1, 63, 64, 65, 300])
def test_simulation_in_blocks_equals_the_recursion(rows):
    rng = np.random.default_rng(rows)
    u, x0 = rng.normal(size=(rows, 2)), rng.normal(size=3)
    expected = _recursion(MODEL, u, x0)
    # Rounding of sums of at most 300 terms of order 10.
    np.testing.assert_allclose(simulate(MODEL, u, x0), expected, atol=1e-11)


def test_initial_state_and_input_matrices_follow_from_exact_data():
    rng = np.random.default_rng(1)
    u, x0 = rng.normal(size=(200, 2)), rng.normal(size=3)
    record = _record(u, _recursion(MODEL, u, x0))
    np.testing.assert_allclose(initial_state(MODEL, u, record.y), x0, atol=1e-11)
    blank = StateSpace(MODEL.A, np.zeros((3, 2)), MODEL.C, np.zeros((2, 2)), 0.1)
    found = fit_input_matrices(blank, [record, record])
    np.testing.assert_allclose(found.B, MODEL.B, atol=1e-10)
    np.testing.assert_allclose(found.D, MODEL.D, atol=1e-10)


def _innovations(rows: int, seed: int):
    """Return u, y and e of MODEL with a coloured disturbance through a known K."""
    rng = np.random.default_rng(seed)
    K = np.array([[0.3, 0.0], [0.1, 0.2], [0.0, 0.1]])
    u, e = rng.normal(size=(rows, 2)), 0.2 * rng.normal(size=(rows, 2))
    both = StateSpace(
        MODEL.A,
        np.hstack([MODEL.B, K]),
        MODEL.C,
        np.hstack([MODEL.D, np.eye(2)]),
        0.1,
    )
    return u, simulate(both, np.hstack([u, e])), e


def test_predictor_is_stable_and_its_error_is_the_innovation():
    u, y, e = _innovations(8000, seed=2)
    record = _record(u, y)
    sequence = state_sequence(choose_past([record], (10, 20, 30)), [record], 6)
    assert int(np.argmax(sequence.singular_values[:-1] / sequence.singular_values[1:])) == 2
    model = innovation_model(sequence, 3, 0.1)
    assert spectral_radius(model.predictor().A) < 1.0
    predicted = simulate(model.predictor(), np.hstack([u, y]))
    rms = np.sqrt(np.mean((y - predicted)[100:] ** 2, axis=0))
    # 8000 samples determine the innovation's rms to 0.8 %; 21 parameters cost 0.3 % more.
    np.testing.assert_allclose(rms, e.std(axis=0), rtol=0.02)
    np.testing.assert_allclose(np.sqrt(np.diag(model.e_covariance)), e.std(axis=0), rtol=0.03)
    poles = np.sort_complex(np.linalg.eigvals(model.model.A))
    # Errors of well-excited poles are about 1 / sqrt(N).
    np.testing.assert_allclose(poles, np.sort_complex(np.linalg.eigvals(MODEL.A)), atol=0.03)


def test_order_above_the_number_of_states_is_rejected():
    u, y, _ = _innovations(500, seed=3)
    sequence = state_sequence(choose_past([_record(u, y)], (4,)), [_record(u, y)], 5)
    with pytest.raises(IdentificationError, match="expected an order of 1 to 5, found 9"):
        innovation_model(sequence, 9, 0.1)


def test_linearly_dependent_inputs_are_rejected():
    u, y, _ = _innovations(500, seed=4)
    twice = np.column_stack([u[:, 0], u[:, 0]])
    with pytest.raises(IdentificationError, match="independent"):
        choose_past([_record(twice, y)], (4,))


def test_fit_percent_of_exact_mean_and_halfway_predictions():
    y = np.array([[0.0, 5.0], [2.0, 5.0], [4.0, 5.0]])
    np.testing.assert_allclose(nrmse_fit_percent(y[:, :1], y[:, :1]), [100.0])
    mean = np.full((3, 1), 2.0)
    np.testing.assert_allclose(nrmse_fit_percent(y[:, :1], mean), [0.0], atol=1e-12)
    half = mean + (y[:, :1] - 2.0) / 2
    np.testing.assert_allclose(nrmse_fit_percent(y[:, :1], half), [50.0])
    assert np.isnan(nrmse_fit_percent(y, y)[1])  # a constant output has no fit
