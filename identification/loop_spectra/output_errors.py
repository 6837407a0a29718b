"""Fit a plant to the lines of records in a loop, by the errors of its outputs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from .loop_plant import LoopPlant
from .spectral_lines import PointLines, RecordLines

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_BLOCK_LINES = 2_000
"""Lines taken at once: the memory does not grow with the records."""
_MAX_TRIES = 6
_AS_FORESEEN = 0.01
_SINGULAR = 1e-10


@dataclass(frozen=True)
class Weighted:
    """Lines of a point with the covariance (F, n, n) of each record's residual."""

    point: PointLines
    covariances: tuple[Complex, ...]

    def only(self, lines: NDArray[np.int_]) -> Weighted:
        """Return some of the lines."""
        return Weighted(self.point.only(lines), tuple(c[lines] for c in self.covariances))

    def thin(self, step: int, first: int = 0) -> Weighted:
        """Return every step-th excited line, from the one with number `first` on."""
        return self.only(self.point.excited[first::step])

    def blocks(self) -> Iterator[Weighted]:
        """Yield the lines in blocks."""
        count = len(self.point.freq_hz)
        for first in range(0, count, _BLOCK_LINES):
            yield self.only(np.arange(first, min(first + _BLOCK_LINES, count)))


def residual(plant: LoopPlant, point: PointLines) -> tuple[list[Complex], Complex, Complex]:
    """Return the residuals (F, n) of all records, the sensitivity S (F, n, n) and P (F, n, p).

    E = S (Y - P U) with S = (I + P C)^-1. Since U = V - C Y is exact, this is Y - S P V: the
    residual of the loop's response, whose noise does not depend on V. U is what was commanded after
    all limits.
    """
    P = plant.response(point)
    S = np.linalg.inv(np.eye(P.shape[1]) + P @ point.controller)
    found = [
        np.einsum("fij,fj->fi", S, r.Y - np.einsum("fij,fj->fi", P, r.U)) for r in point.records
    ]
    return found, np.asarray(S), P


def without_transients(
    plant: LoopPlant, point: PointLines, covariances: Sequence[Complex] | None
) -> list[Complex]:
    """Return the residuals (F, n) of all records less what their begin and end leave."""
    found, S, _ = residual(plant, point)
    T = S @ plant.free_motions(point)
    cleaned = []
    for k, (record, E) in enumerate(zip(point.records, found, strict=True)):
        W = _whitener(_by_power(record) if covariances is None else covariances[k])
        A, b = _stacked(W @ T), _stacked(np.einsum("fij,fj->fi", W, E))
        size = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
        Q, _ = np.linalg.qr(A / size)
        part = (Q @ (Q.T @ b)).reshape(2, *E.shape) / np.sqrt(2.0)
        whitened = part[0] + 1j * part[1]
        cleaned.append(E - np.linalg.solve(W, whitened[:, :, None])[:, :, 0])
    return cleaned


Effect = Callable[[Complex], Complex]
"""From an input U (F, p) to S dP U (F, n, N), along all directions."""

P = TypeVar("P", bound=LoopPlant)
S = TypeVar("S", bound="Slopes")


class Slopes(ABC):
    """The directions in which a plant may move, and how its response follows."""

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of directions N."""

    @abstractmethod
    def effect(self, point: PointLines, S: Complex) -> Effect:
        """Return how S dP U follows from U, for steps of a typical size."""


@dataclass(frozen=True)
class Factor(Generic[S]):
    """R (N, N) and right side (N,) of the whitened Jacobian along `slopes`."""

    slopes: S
    R: Array
    right: Array
    cost: float


class OutputErrors(ABC, Generic[P, S]):
    """The problem: weighted lines, and the directions in which the plant may move."""

    weighted: tuple[Weighted, ...]
    pool: Executor

    @abstractmethod
    def slopes(self, plant: P) -> S:
        """Return the directions at a plant."""

    @abstractmethod
    def moved(self, plant: P, slopes: S, step: Array) -> P:
        """Return the plant after a step (N,) along the directions.

        Raises ValueError or LinAlgError for a step too far.
        """

    @abstractmethod
    def known(self, plant: P, columns: int) -> Array:
        """Return rows (K, columns + 1) of what is known beforehand, over its uncertainty."""

    def factor(self, plant: P) -> Factor[S]:
        """Return the QR factor of the whitened Jacobian and residual, transients eliminated."""
        slopes = self.slopes(plant)
        rows = [self.known(plant, len(slopes))]
        for w in self.weighted:
            rows += self._reduced(plant, w, slopes)
        R = np.asarray(np.linalg.qr(np.vstack(rows), mode="r"))
        return Factor(slopes, R[:-1, :-1], R[:-1, -1], float(np.sum(R[:, -1] ** 2)))

    def cost(self, plant: P) -> float:
        """Return the sum of squared whitened residuals, transients eliminated."""
        known = self.known(plant, len(self.slopes(plant)))[:, -1]
        rows = [r for w in self.weighted for r in self._reduced(plant, w, None)]
        return float(known @ known) + sum(float(r[-1, -1] ** 2) for r in rows)

    def search(self, plant: P, steps: int, tolerance: float = 0.05) -> tuple[P, Factor[S], float]:
        """Take Gauss-Newton steps until one is below `tolerance` standard errors, or as foreseen.

        A step that lowers the cost by what the linear problem foretells ends at its minimum.
        Returns the plant, the factor before the last step, and the cost.
        """
        damping = 0.0
        for _ in range(steps):
            f = self.factor(plant)
            errors = np.linalg.norm(np.linalg.pinv(f.R, rcond=_SINGULAR), axis=1)
            for _ in range(_MAX_TRIES):
                size = np.linalg.norm(f.R, axis=0)
                damped = np.vstack([f.R, np.diag(np.sqrt(damping) * size)])
                right = np.append(f.right, np.zeros(len(size)))
                step = -np.linalg.lstsq(damped, right, rcond=_SINGULAR)[0]
                try:
                    moved = self.moved(plant, f.slopes, step)
                    cost = self.cost(moved)
                except (ValueError, np.linalg.LinAlgError):
                    cost = np.inf
                if cost <= f.cost * (1.0 + 1e-9):
                    break
                damping = max(10.0 * damping, 1e-3)
            else:
                return plant, f, f.cost
            plant = moved
            gain = float(np.sum(f.right**2) - np.sum((f.R @ step + f.right) ** 2))
            as_foreseen = damping == 0.0 and abs(f.cost - cost - gain) < _AS_FORESEEN * gain
            small = float(np.max(np.abs(step) / np.maximum(errors, 1e-300))) < tolerance
            if small or as_foreseen:
                break
            damping = 0.0 if damping < 1e-2 else damping / 10.0
        return plant, f, cost

    def _reduced(self, plant: P, w: Weighted, slopes: S | None) -> list[Array]:
        """Return for each record the R of the whitened columns [dE, E], transients eliminated."""
        found: list[Array] = [np.zeros((0, 0))] * len(w.point.records)
        for block in w.blocks():
            E, S, P = residual(plant, block.point)
            T = S @ plant.free_motions(block.point)
            effect = None if slopes is None else slopes.effect(block.point, S)
            C_S_P = block.point.controller @ S @ P

            def rows(
                record: RecordLines, E: Complex, covariance: Complex, above: Array,
                T: Complex = T, effect: Effect | None = effect, C_S_P: Complex = C_S_P,
            ) -> Array:  # fmt: skip
                columns = [T, E[:, :, None]]
                if effect is not None:
                    U = record.V - np.einsum("fij,fj->fi", C_S_P, record.V)
                    columns.insert(1, -effect(U))
                part = _stacked(_whitener(covariance) @ np.concatenate(columns, axis=2))
                if len(above):
                    part = np.vstack([above, part])
                return np.asarray(np.linalg.qr(part, mode="r"))

            found = list(self.pool.map(rows, block.point.records, E, block.covariances, found))
        return [R[T.shape[2] :, T.shape[2] :] for R in found]


def _by_power(record: RecordLines) -> Complex:
    eye = np.eye(record.power.shape[1])
    return np.asarray(np.maximum(record.power, 1e-300)[:, :, None] * eye, dtype=complex)


def _whitener(covariance: Complex) -> Complex:
    """Return W (F, n, n) with W covariance W^H = I."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def _stacked(x: Complex) -> Array:
    """Return real and imaginary parts below each other, of unit variance for a unit complex x."""
    flat = x.reshape(-1, *x.shape[2:])
    return np.asarray(np.sqrt(2.0) * np.concatenate([flat.real, flat.imag]))
