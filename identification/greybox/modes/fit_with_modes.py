"""Fit declared parameters and modes to the lines of records in a loop."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...loop_spectra.output_errors import Effect, OutputErrors, Slopes, Weighted
from ...loop_spectra.spectral_lines import PointLines
from ..free_parameters import FreeParameters
from .mode import Mode
from .sampled_response import LinearPlant, ParameterName, sensitivities

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_LARGEST_DAMPING = 0.7
_LEAST_DAMPING = 1e-4
_TO_BOUND = 0.8


@dataclass(frozen=True)
class ParameterSlopes(Slopes):
    """The parameters of a plant by name, and typical changes (N,) of them in SI units."""

    plant: LinearPlant
    names: tuple[ParameterName, ...]
    scales: Array

    def __len__(self) -> int:
        """Return the number of parameters."""
        return len(self.names)

    def effect(self, point: PointLines, S: Complex) -> Effect:
        """Return how S dP U follows from U, for typical changes."""
        dP = sensitivities(self.plant, point, self.names, self.scales)
        S_dP = np.moveaxis(S @ dP, 0, 3) * self.scales
        return lambda U: np.asarray(np.einsum("fikN,fk->fiN", S_dP, U))


@dataclass(frozen=True)
class FitWithModes(OutputErrors[LinearPlant, ParameterSlopes]):
    """The problem: weighted lines, free parameters, and how far they may be from declared values.

    `spread` (P,): standard deviation of the declared values, infinite for parameters that only the
    records determine.
    """

    weighted: tuple[Weighted, ...]
    parameters: FreeParameters
    spread: Array
    pool: Executor

    def slopes(self, plant: LinearPlant) -> ParameterSlopes:
        """Return all parameters, those of the model file first."""
        return ParameterSlopes(plant, self._names(plant.modes), self._scales(plant.modes))

    def moved(self, plant: LinearPlant, slopes: ParameterSlopes, step: Array) -> LinearPlant:
        """Return the plant after a step in typical changes.

        No parameter reaches a bound of the model file, it only comes nearer: a lag of 0, its bound,
        could no longer be told from a delay.
        """
        p, names, step = self.parameters, slopes.names, slopes.scales * step
        for k, name in enumerate(names):
            if isinstance(name, str):
                value = plant.model.values[name]
                room = _TO_BOUND * np.array([p.low[k] - value, p.high[k] - value])
                step[k] = np.clip(step[k], *room)
            elif name[1] == "omega":
                step[k] = max(step[k], -0.9 * plant.modes[name[0]].omega)
            elif name[1] == "damping":
                room = np.array([_LEAST_DAMPING, _LARGEST_DAMPING])
                step[k] = np.clip(step[k], *(room - plant.modes[name[0]].damping))
        return plant.moved(names, step)

    def known(self, plant: LinearPlant, columns: int) -> Array:
        """Return rows of what is known of declared values."""
        p = self.parameters
        values = np.array([plant.model.values[name] for name in p.names])
        rows = [*_rows(p.scale, values - p.prior_mean, p.prior_sd, columns)]
        rows += _rows(p.scale, values - p.prior_mean, self.spread, columns)
        return np.array(rows).reshape(-1, columns + 1)

    def _names(self, modes: Sequence[Mode]) -> tuple[ParameterName, ...]:
        """Return the names of all parameters, those of the model file first."""
        found: list[ParameterName] = list(self.parameters.names)
        for k, m in enumerate(modes):
            if m.kind != "beyond":
                found += [(k, "omega"), (k, "damping")]
            found += [(k, i, j) for i, j in m.entries()]
        return tuple(found)

    def _scales(self, modes: Sequence[Mode]) -> Array:
        """Return typical changes of all parameters."""
        found = self.parameters.scale.tolist()
        for m in modes:
            if m.kind != "beyond":
                found += [0.01 * m.omega, 0.01]
            size = np.sqrt(np.abs(np.diag(m.strength)))
            whole = max(float(np.abs(m.strength).max()), 1e-300)
            for i, j in m.entries():
                own = float(size[i] * size[j]) if max(i, j) < len(size) else 0.0
                found.append(max(own, 1e-6 * whole))
        return np.array(found)


def _rows(scale: Array, error: Array, sd: Array, columns: int) -> list[Array]:
    found = []
    for i in np.flatnonzero(np.isfinite(sd)):
        row = np.zeros(columns + 1)
        row[i], row[-1] = scale[i] / sd[i], error[i] / sd[i]
        found.append(row)
    return found
