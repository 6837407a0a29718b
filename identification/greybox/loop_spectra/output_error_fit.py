"""Fit declared parameters and modes to the lines of records in a loop, by output errors."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ....model.declared_model import DeclaredModel, ModelError
from ..free_parameters import FreeParameters
from .mode import Mode
from .sampled_response import LinearPlant, ParameterName, response, sensitivities
from .spectral_lines import PointLines, RecordLines
from .transients import transient_columns

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_BLOCK_LINES = 2_000
_LARGEST_DAMPING = 0.7
_LEAST_DAMPING = 1e-4
_MAX_TRIES = 6
_AS_FORESEEN = 0.01
_TO_BOUND = 0.8
_SINGULAR = 1e-10


@dataclass(frozen=True)
class Weighted:
    """Lines of a point with the covariance (F, n, n) of each record's residual."""

    point: PointLines
    covariances: tuple[Complex, ...]

    def thin(self, step: int, first: int = 0) -> Weighted:
        """Return every step-th excited line, from the one with number `first` on."""
        some = self.point.excited[first::step]
        return Weighted(self.point.only(some), tuple(c[some] for c in self.covariances))


@dataclass(frozen=True)
class Factor:
    """R (N, N) and right side (N,) of the whitened Jacobian by parameters over their scale."""

    names: tuple[ParameterName, ...]
    scales: Array
    R: Array
    right: Array
    cost: float


def residual(plant: LinearPlant, point: PointLines) -> tuple[list[Complex], Complex, Complex]:
    """Return the residuals (F, n) of all records, the sensitivity S (F, n, n) and P (F, n, p).

    E = S (Y - P U) with S = (I + P C)^-1. Since U = V - C Y is exact, this is Y - S P V: the
    residual of the loop's response, whose noise does not depend on V. U is what was commanded after
    all limits.
    """
    P = response(plant, point)
    S = np.linalg.inv(np.eye(P.shape[1]) + P @ point.controller)
    found = [
        np.einsum("fij,fj->fi", S, r.Y - np.einsum("fij,fj->fi", P, r.U)) for r in point.records
    ]
    return found, np.asarray(S), P


def without_transients(
    plant: LinearPlant, point: PointLines, covariances: Sequence[Complex] | None
) -> list[Complex]:
    """Return the residuals (F, n) of all records less what their begin and end leave."""
    found, S, _ = residual(plant, point)
    T = S @ transient_columns(plant, point)
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


def _by_power(record: RecordLines) -> Complex:
    eye = np.eye(record.power.shape[1])
    return np.asarray(np.maximum(record.power, 1e-300)[:, :, None] * eye, dtype=complex)


@dataclass(frozen=True)
class OutputErrorFit:
    """The problem: weighted lines, free parameters, and how far they may be from declared values.

    `spread` (P,): standard deviation of the declared values, infinite for parameters that only the
    records determine.
    """

    weighted: tuple[Weighted, ...]
    parameters: FreeParameters
    spread: Array
    pool: Executor

    def names(self, modes: Sequence[Mode]) -> tuple[ParameterName, ...]:
        """Return the names of all parameters, those of the model file first."""
        found: list[ParameterName] = list(self.parameters.names)
        for k, m in enumerate(modes):
            if m.kind != "beyond":
                found += [(k, "omega"), (k, "damping")]
            found += [(k, i, j) for i, j in m.entries()]
        return tuple(found)

    def scales(self, modes: Sequence[Mode]) -> Array:
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

    def factor(self, plant: LinearPlant) -> Factor:
        """Return the QR factor of the whitened Jacobian and residual, transients eliminated."""
        names, scales = self.names(plant.modes), self.scales(plant.modes)
        rows = [self._prior_rows(plant.model, len(names))]
        for w in self.weighted:
            found, S, P = residual(plant, w.point)
            T = S @ transient_columns(plant, w.point)
            dP = sensitivities(plant, w.point, names, scales)
            S_dP = np.moveaxis(S @ dP, 0, 3) * scales
            C_S_P = w.point.controller @ S @ P

            def reduced(
                record: RecordLines, E: Complex, covariance: Complex,
                T: Complex = T, S_dP: Complex = S_dP, C_S_P: Complex = C_S_P,
            ) -> Array:  # fmt: skip
                U = record.V - np.einsum("fij,fj->fi", C_S_P, record.V)
                J = -np.einsum("fikN,fk->fiN", S_dP, U)
                columns = np.concatenate([T, J, E[:, :, None]], axis=2)
                return _reduced(_whitener(covariance), columns, T.shape[2])

            rows += self.pool.map(reduced, w.point.records, found, w.covariances)
        R = np.asarray(np.linalg.qr(np.vstack(rows), mode="r"))
        return Factor(names, scales, R[:-1, :-1], R[:-1, -1], float(np.sum(R[:, -1] ** 2)))

    def cost(self, plant: LinearPlant) -> float:
        """Return the sum of squared whitened residuals, transients eliminated."""
        prior = self._prior_rows(plant.model, len(self.parameters.names))[:, -1]
        total = float(prior @ prior)
        for w in self.weighted:
            found, S, _ = residual(plant, w.point)
            T = S @ transient_columns(plant, w.point)

            def squares(E: Complex, covariance: Complex, T: Complex = T) -> float:
                rows = np.concatenate([T, E[:, :, None]], axis=2)
                return float(_reduced(_whitener(covariance), rows, T.shape[2])[-1, -1] ** 2)

            total += sum(self.pool.map(squares, found, w.covariances))
        return total

    def search(
        self, plant: LinearPlant, steps: int, tolerance: float = 0.05
    ) -> tuple[LinearPlant, Factor, float]:
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
                moved = self._moved(plant, f.names, f.scales * step)
                try:
                    cost = self.cost(moved)
                except (ModelError, np.linalg.LinAlgError):
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

    def _moved(
        self, plant: LinearPlant, names: Sequence[ParameterName], step: Array
    ) -> LinearPlant:
        """Return the plant after a step in SI units.

        No parameter reaches a bound of the model file, it only comes nearer: a lag of 0, its bound,
        could no longer be told from a delay.
        """
        p, step = self.parameters, step.copy()
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

    def _prior_rows(self, model: DeclaredModel, columns: int) -> Array:
        p = self.parameters
        values = np.array([model.values[name] for name in p.names])
        rows = [*_rows(p.scale, values - p.prior_mean, p.prior_sd, columns)]
        rows += _rows(p.scale, values - p.prior_mean, self.spread, columns)
        return np.array(rows).reshape(-1, columns + 1)


def _rows(scale: Array, error: Array, sd: Array, columns: int) -> list[Array]:
    found = []
    for i in np.flatnonzero(np.isfinite(sd)):
        row = np.zeros(columns + 1)
        row[i], row[-1] = scale[i] / sd[i], error[i] / sd[i]
        found.append(row)
    return found


def _whitener(covariance: Complex) -> Complex:
    """Return W (F, n, n) with W covariance W^H = I."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def _reduced(W: Complex, columns: Complex, eliminated: int) -> Array:
    """Return R of the whitened columns (F, n, N) without the first ones."""
    R: Array = np.zeros((0, columns.shape[2]))
    for first in range(0, len(W), _BLOCK_LINES):
        block = slice(first, first + _BLOCK_LINES)
        R = np.asarray(np.linalg.qr(np.vstack([R, _stacked(W[block] @ columns[block])]), mode="r"))
    return R[eliminated:, eliminated:]


def _stacked(x: Complex) -> Array:
    """Return real and imaginary parts below each other, of unit variance for a unit complex x."""
    flat = x.reshape(-1, *x.shape[2:])
    return np.asarray(np.sqrt(2.0) * np.concatenate([flat.real, flat.imag]))
