"""List the free parameters of a declared model: scale, bounds, priors, largest useful error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...config.model import ModelConfig, ModelParameter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FreeParameters:
    """Parameters to fit, all arrays (F,) in SI units.

    scale: size of a typical change. low, high: bounds. worth: standard error above which a
    parameter is held at its declared value: half the value if it cannot change sign, else the
    standard deviation of a uniform distribution between its bounds. prior_mean, prior_sd: the sd is
    infinite without a prior.
    """

    names: tuple[str, ...]
    scale: Array
    low: Array
    high: Array
    worth: Array
    prior_mean: Array
    prior_sd: Array

    def only(self, indices: Sequence[int]) -> FreeParameters:
        """Return the parameters at `indices`, in this order."""
        pick = list(indices)
        return FreeParameters(
            tuple(self.names[i] for i in pick),
            *(
                getattr(self, field)[pick]
                for field in ("scale", "low", "high", "worth", "prior_mean", "prior_sd")
            ),
        )

    def at_bound(self, values: Array) -> tuple[str, ...]:
        """Return the names of the parameters whose values (F,) are at a bound."""
        edge = 1e-9 * self.scale
        bound = (values <= self.low + edge) | (values >= self.high - edge)
        return tuple(np.array(self.names)[bound].tolist())

    def prior_rows(self, values: Array) -> Array:
        """Return the rows (., F + 1) of the priors for [scaled Jacobian, errors]."""
        rows = []
        for i in np.flatnonzero(np.isfinite(self.prior_sd)):
            row = np.zeros(len(values) + 1)
            row[i] = self.scale[i] / self.prior_sd[i]
            row[-1] = (values[i] - self.prior_mean[i]) / self.prior_sd[i]
            rows.append(row)
        return np.array(rows).reshape(-1, len(values) + 1)


def free_parameters(config: ModelConfig) -> FreeParameters:
    """Return the free parameters of a model file."""
    chosen = {name: p for name, p in config.parameters.items() if not p.is_fixed}
    listed = list(chosen.values())
    return FreeParameters(
        tuple(chosen),
        np.array([_scale(p) for p in listed]),
        np.array([-np.inf if p.min is None else p.min for p in listed]),
        np.array([np.inf if p.max is None else p.max for p in listed]),
        np.array([_worth(p) for p in listed]),
        np.array([p.value for p in listed]),
        np.array([np.inf if p.prior_sd is None else p.prior_sd for p in listed]),
    )


def _scale(parameter: ModelParameter) -> float:
    if parameter.value != 0.0:
        return abs(parameter.value)
    bounds = [abs(b) for b in (parameter.min, parameter.max) if b]
    return min(bounds) if bounds else 1.0


def _worth(parameter: ModelParameter) -> float:
    low, high = parameter.min, parameter.max
    if low is not None and low >= 0.0 and parameter.value > 0.0:
        return 0.5 * parameter.value
    if low is not None and high is not None:
        return (high - low) / math.sqrt(12.0)
    return 10.0 * _scale(parameter)
