"""Predictions over several rows: exact without noise, for stable and unstable plants."""

from __future__ import annotations

import numpy as np
import pytest

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.prediction.multistep_prediction import horizon_rows, predict_ahead
from levid.identification.greybox.prediction.noise_model import Noise
from levid.identification.greybox.prediction.prediction_errors import predict
from levid.model.second_order import discretise

TS, ROWS = 0.005, 600
NOISE = Noise.independent(np.array([1e-6]), np.array([1e-12]))


def model(stiffness: float):
    text = f"""
levid: model
name: mass
dof: [{{name: x, unit: m}}]
inputs: [{{name: f, unit: N}}]
M: [[1.0]]
D: [[0.5]]
K: [[{stiffness}]]
"""
    return declared_model(parse_text(text, ModelConfig, "mass"))


def record(stiffness: float, noise_m: float = 0.0) -> Experiment:
    """Return a record of the model with a constant force; feedback holds an unstable one."""
    plant, rng = discretise(model(stiffness).at(), TS), np.random.default_rng(2)
    x, u, y = np.zeros(2), np.empty((ROWS, 1)), np.empty((ROWS, 1))
    for k in range(ROWS):
        y[k] = plant.C @ x + noise_m * rng.normal()
        rate = (y[k] - y[k - 1]) / TS if k else 0.0
        u[k] = rng.normal() - max(-3.0 * stiffness, 0.0) * y[k] - 8.0 * rate
        x = plant.A @ x + plant.B @ (u[k] + 0.2)
    return Experiment("r", TS, u, y, {}, frozenset(), False, feedback=True)


@pytest.mark.parametrize("stiffness", [60.0, -40.0])
@pytest.mark.parametrize("rows", [1, 7])
def test_true_model_predicts_without_noise(stiffness: float, rows: int) -> None:
    e = record(stiffness)
    found = predict_ahead(model(stiffness), e, "zoh", NOISE, rows)
    assert np.isnan(found[:rows]).all()
    assert np.abs(found[rows:] - e.y[rows:]).max() < 1e-6 * np.abs(e.y).max()


def test_one_row_ahead_is_the_prediction_of_the_fit() -> None:
    e = record(60.0, 1e-4)
    prediction = predict(model(60.0), e, "zoh", NOISE)
    errors = (e.y - predict_ahead(model(60.0), e, "zoh", NOISE, 1))[1:]
    innovation = prediction.errors[1:] * np.sqrt(prediction.filter.covariance[0])
    np.testing.assert_allclose(errors[20:], innovation[20:], rtol=0, atol=1e-9)


def test_horizon_is_at_most_a_time_constant_of_an_unstable_model() -> None:
    slow = record(60.0)
    # Its outputs are correlated for longer than a twentieth of the record.
    assert horizon_rows(model(60.0), slow, "zoh") == ROWS // 20
    pole = np.log(np.abs(np.linalg.eigvals(discretise(model(-4000.0).at(), TS).A)).max())
    assert horizon_rows(model(-4000.0), slow, "zoh") == max(int(1.0 / pole), 2)
