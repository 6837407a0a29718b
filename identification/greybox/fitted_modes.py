"""Compute natural frequencies and damping ratios of a fitted model, with standard errors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ...model.declared_model import DeclaredModel
from ...model.second_order import state_space
from ..covariance_scaling import correlation
from ..subspace.response_uncertainty import Modes
from .fit import Fit

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_DIFFERENCE = 1e-2
"""Half of a central difference, over the standard error."""


def fitted_modes(fit: Fit, schedule: Mapping[str, float]) -> Modes:
    """Return the modes of M q'' + D q' + K q at a scheduling point, without lag and delay.

    Standard errors are to first order in those of the parameters; fixed parameters count as exact.
    One pole of a complex pair is listed.
    """
    poles = _poles(fit.model, schedule)
    slopes = []
    names, covariance = fit.errors_of
    for name, error in zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True):
        if not error > 0:
            slopes.append(np.zeros(len(poles), complex))
            continue
        value, step = fit.values[name], _DIFFERENCE * error
        low, high = (
            _matched(poles, _poles(fit.model.with_values({name: x}), schedule))
            for x in (value - step, value + step)
        )
        slopes.append((high - low) / (2 * _DIFFERENCE))
    J = np.array(slopes).reshape(len(slopes), len(poles))
    scaled = correlation(covariance)
    along = np.real(np.conj(poles) * J) / np.abs(poles)  # d|s|
    damping = -J.real / np.abs(poles) + poles.real * along / np.abs(poles) ** 2
    frequency_se, damping_se = (
        np.sqrt(np.maximum(np.einsum("ak,ab,bk->k", d, scaled, d), 0.0)) for d in (along, damping)
    )
    return Modes(
        np.abs(poles) / (2 * np.pi),
        frequency_se / (2 * np.pi),
        -poles.real / np.abs(poles),
        damping_se,
    )


def natural_frequencies(model: DeclaredModel, schedule: Mapping[str, float]) -> Array:
    """Return the natural frequencies (k,) of M q'' + D q' + K q in Hz."""
    return np.asarray(np.abs(_poles(model, schedule)) / (2 * np.pi))


def _poles(model: DeclaredModel, schedule: Mapping[str, float]) -> Complex:
    """Return the poles (k,) in rad/s with imaginary part >= 0, by ascending size."""
    s = np.linalg.eigvals(state_space(model.at(schedule)).A).astype(complex)
    s = s[(s.imag >= 0) & (np.abs(s) > 0)]
    return np.asarray(s[np.argsort(np.abs(s), kind="stable")])


def _matched(poles: Complex, others: Complex) -> Complex:
    """Return the nearest of the other poles to each pole."""
    return np.asarray(others[np.argmin(np.abs(poles[:, None] - others), axis=1)])
