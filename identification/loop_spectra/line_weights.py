"""Hold the lines of all points with what a plant leaves of them, by which they weigh."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .loop_plant import LoopPlant
from .measured_noise import LoopNoise, measured_noise, noise_spectrum
from .output_errors import Weighted, without_transients
from .residual_spectrum import (
    ResidualSpectrum,
    excess_of_bands,
    split_residual,
    with_model_error,
)
from .spectral_lines import PointLines

Array = NDArray[np.float64]

ALL_LINES = 1, 2
"""Steps on all lines in the end of a search, before and after they are weighed anew."""


@dataclass(frozen=True)
class LineWeights:
    """Lines of all points; `correlations` of forces (p, p) and outputs (n, n) of their noise.

    `residuals`, one for each point, and `noise` are of the last plant; `weighted` are the lines
    with the covariances of the last `by_frequency` or `by_misfit`.
    """

    points: tuple[PointLines, ...]
    correlations: tuple[Array, Array]
    pool: Executor
    residuals: tuple[ResidualSpectrum, ...] = ()
    weighted: tuple[Weighted, ...] = ()
    noise: LoopNoise | None = None

    def split(self, plant: LoopPlant) -> LineWeights:
        """Return them with noise and model error measured anew, of what a plant leaves."""

        def residual(k: int) -> ResidualSpectrum:
            point = self.points[k]
            known = self.weighted[k].covariances if self.weighted else None
            shape = None if self.noise is None else noise_spectrum(plant, point, self.noise)
            return split_residual(point, without_transients(plant, point, known), shape)

        residuals = tuple(self.pool.map(residual, range(len(self.points))))
        noise = measured_noise(plant, self.points, residuals, self.correlations)
        return replace(self, residuals=residuals, noise=noise)

    def by_frequency(self) -> LineWeights:
        """Return them weighted by noise and model error at each frequency."""
        return self._weighed([r.relative_error for r in self.residuals])

    def by_misfit(self) -> LineWeights:
        """Return them weighted by noise and one relative model error at all frequencies."""
        share = self.misfit**2
        return self._weighed([np.full(r.relative_error.shape, share) for r in self.residuals])

    @property
    def misfit(self) -> float:
        """The model error over the output, root mean square over all bands."""
        squares, count = np.sum([r.misfit for r in self.residuals], axis=0)
        return float(np.sqrt(max(squares, 0.0) / max(count, 1)))

    @property
    def worst(self) -> tuple[float, float]:
        """Largest excess of a band in standard deviations of chance, and its frequency in Hz."""
        z, freq_hz = excess_of_bands(self.residuals)
        k = int(np.argmax(z))
        return float(z[k]), float(freq_hz[k])

    def thin(self, step: int) -> tuple[Weighted, ...]:
        """Return every step-th line of the points with an excitation.

        Points have different ones, so that narrow modes are not between them.
        """
        excited = [w for w in self.weighted if any(r.excited for r in w.point.records)]
        return tuple(w.thin(step, k % step) for k, w in enumerate(excited))

    def _weighed(self, relative_errors: Sequence[Array]) -> LineWeights:
        weighted = tuple(
            Weighted(point, with_model_error(point, r, share))
            for point, r, share in zip(self.points, self.residuals, relative_errors, strict=True)
        )
        return replace(self, weighted=weighted)
