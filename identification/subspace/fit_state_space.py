"""Fit a state-space model to the lines of records in a loop, in local coordinates."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...model.second_order import StateSpace
from ..loop_spectra.output_errors import Effect, Factor, OutputErrors, Slopes, Weighted
from ..loop_spectra.spectral_lines import PointLines
from .local_coordinates import moved, response_directions
from .plant_from_loop import IdentifiedPlant

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class SampledPlant:
    """An identified plant, as the spectra of a loop need it."""

    plant: IdentifiedPlant

    def response(self, point: PointLines) -> Complex:
        """Return P (F, m, p) at the point's lines."""
        return self.plant.response(point.freq_hz)

    def compliance(self, point: PointLines) -> Complex:
        """Return the core's response (F, m, p): that of a force that acts at once."""
        return self.plant.core.response(point.freq_hz)

    def free_motions(self, point: PointLines) -> Complex:
        """Return columns (F, m, n + 2 m): of the states, and of rows that are on their way."""
        core = self.plant.core
        m = len(core.C)
        z = np.exp(2j * np.pi * point.freq_hz * point.Ts_s)[:, None, None]
        states = core.C @ np.linalg.inv(z * np.eye(len(core.A)) - core.A)
        eye = np.eye(m)
        return np.concatenate([z * states, np.broadcast_to(eye, (len(z), m, m)), eye / z], axis=2)

    def with_core(self, core: StateSpace) -> SampledPlant:
        """Return the plant with another core."""
        return SampledPlant(replace(self.plant, core=core))


@dataclass(frozen=True)
class Directions(Slopes):
    """Changes (r, n + m, n + p) of the core's [A B; C D] that alter the response."""

    plant: SampledPlant
    changes: Array

    def __len__(self) -> int:
        """Return the number of directions."""
        return len(self.changes)

    def effect(self, point: PointLines, S: Complex) -> Effect:
        """Return how S dP U follows from U."""
        left, right = self.plant.plant.slopes(point.freq_hz)
        S_left = S @ left
        flat = self.changes.reshape(len(self.changes), -1).T

        def along(U: Complex) -> Complex:
            x = np.einsum("fbj,fj->fb", right, U)
            each = (S_left[:, :, :, None] * x[:, None, None, :]).reshape(-1, len(flat))
            found = each.real @ flat + 1j * (each.imag @ flat)
            return np.asarray(found.reshape(*S_left.shape[:2], -1))

        return along

    def covariance(self, factor: Factor[Directions]) -> Array:
        """Return the covariance (n + m, n + p, n + m, n + p) of [A B; C D] at a minimum."""
        inverse = np.linalg.pinv(factor.R, rcond=1e-12)
        flat = inverse.T @ self.changes.reshape(len(self.changes), -1)
        shape = self.changes.shape[1:]
        return np.asarray(flat.T @ flat).reshape(*shape, *shape)


@dataclass(frozen=True)
class FitStateSpace(OutputErrors[SampledPlant, Directions]):
    """The problem: weighted lines."""

    weighted: tuple[Weighted, ...]
    pool: Executor

    def slopes(self, plant: SampledPlant) -> Directions:
        """Return the directions at a plant."""
        core = plant.plant.core
        return Directions(plant, response_directions(core, np.ones(core.B.shape[1], bool)))

    def moved(self, plant: SampledPlant, slopes: Directions, step: Array) -> SampledPlant:
        """Return the plant after a step."""
        return plant.with_core(moved(plant.plant.core, np.tensordot(step, slopes.changes, 1)))

    def known(self, plant: SampledPlant, columns: int) -> Array:  # noqa: ARG002
        """Return no rows: nothing is known beforehand."""
        return np.zeros((0, columns + 1))
