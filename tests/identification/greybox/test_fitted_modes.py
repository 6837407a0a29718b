"""Test modes of a fitted model: the eigenvalue problem's, errors as of drawn parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from levid.config.base import load_yaml
from levid.config.model import ModelConfig
from levid.config.shipped import shipped
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.fitted_modes import fitted_modes


@dataclass
class StubFit:
    """What fitted_modes reads of a fit."""

    model: object
    free: tuple[str, ...]
    covariance: np.ndarray

    @property
    def values(self):
        return self.model.values

    @property
    def errors_of(self):
        return self.free, self.covariance

    @property
    def standard_errors(self):
        return dict(zip(self.free, np.sqrt(np.diag(self.covariance)), strict=True))


def rig_fit(relative: float) -> StubFit:
    model = declared_model(load_yaml(shipped("models/rig.yaml"), ModelConfig))
    free = tuple(name for name, value in model.values.items() if value > 0 and name[0] in "mJkd")
    sizes = relative * np.array([model.values[name] for name in free])
    correlation = np.eye(len(free))
    correlation[0, 1] = correlation[1, 0] = 0.8
    return StubFit(model, free, correlation * np.outer(sizes, sizes))


def test_modes_are_those_of_the_undamped_eigenvalue_problem() -> None:
    fit = rig_fit(1e-3)
    found = fitted_modes(fit, {"x_b": 0.0})
    at = fit.model.at({"x_b": 0.0})
    squares = np.linalg.eigvals(np.linalg.solve(at.M, at.K))
    assert len(found.frequency_hz) == 3
    # Damping ratios below 0.15 do not change |s| by more than second order in couplings.
    np.testing.assert_allclose(
        found.frequency_hz, np.sqrt(np.sort(squares.real)) / (2 * np.pi), rtol=2e-3
    )
    assert np.all((found.damping > 0.03) & (found.damping < 0.2))


def test_errors_are_the_scatter_over_drawn_parameters() -> None:
    fit = rig_fit(5e-3)
    found = fitted_modes(fit, {"x_b": 0.05})
    rng = np.random.default_rng(5)
    means = np.array([fit.values[name] for name in fit.free])
    drawn = []
    for values in rng.multivariate_normal(means, fit.covariance, 800):
        model = fit.model.with_values(dict(zip(fit.free, values, strict=True)))
        other = fitted_modes(StubFit(model, (), np.zeros((0, 0))), {"x_b": 0.05})
        drawn.append(np.concatenate([other.frequency_hz, other.damping]))
    scatter = np.std(drawn, axis=0)
    # The scatter of 800 has a relative error of 1 / sqrt(1600); four of them.
    np.testing.assert_allclose(
        np.concatenate([found.frequency_se_hz, found.damping_se]), scatter, rtol=4 / 40
    )
