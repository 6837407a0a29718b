"""Realise a state-space model from a measured frequency response.

McKelvey, Akcay and Ljung, "Subspace-based multivariable system identification from frequency
response data", IEEE Transactions on Automatic Control 41 (1996) 960. Any frequencies will do, and
the response's own uncertainty tells which singular values are more than noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...model.second_order import StateSpace
from ..nonparametric.frequency_response import ResponseEstimate
from ..records.record import IdentificationError
from .ho_kalman import SINGULAR_VALUES, level_of_chance

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_BLOCK_ROWS = 60
"""Rows of the extended observability matrix, over the number of outputs: twice as many as the
states of a model of the highest order have modes."""
_TOP_ANGLE = 0.8 * np.pi
"""Angle on the unit circle to which the highest frequency is mapped."""


@dataclass(frozen=True)
class FrequencySubspace:
    """The observability matrix of all models, and the response from which the rest follows.

    `singular_values` (k,), descending; `noise_level`: the largest one that noise alone has.
    """

    singular_values: Array
    noise_level: float
    observability: Array
    response: ResponseEstimate
    warp: float

    @property
    def significant(self) -> int:
        """The number of singular values above the level of noise."""
        return int(np.sum(self.singular_values > self.noise_level))

    def realise(self, order: int) -> StateSpace:
        """Return the model of `order` states.

        Raises IdentificationError for an order above that of the singular values.
        """
        available = len(self.singular_values)
        if not 1 <= order <= available:
            raise IdentificationError(f"expected an order of 1 to {available}, found {order}")
        H, Ts_s = self.response.H, self.response.Ts_s
        m, p = H.shape[1:]
        rows = self.observability[:, :order]
        warped = np.linalg.lstsq(rows[:-m], rows[m:], rcond=None)[0]
        # z' = (a z - b) / (a - b z), so A = (a I + b A')^-1 (b I + a A'), C = C' (a I - b A).
        a, b, eye = 1.0 + self.warp, 1.0 - self.warp, np.eye(order)
        A = np.linalg.solve(a * eye + b * warped, b * eye + a * warped)
        C = rows[:m] @ (a * eye - b * A)
        z = np.exp(2j * np.pi * self.response.freq_hz * Ts_s)
        states = C @ np.linalg.inv(z[:, None, None] * eye - A)
        columns = np.concatenate([states, np.broadcast_to(np.eye(m), (len(z), m, m))], axis=2)
        weight = 1.0 / np.sqrt(np.mean(self.response.standard_deviation**2, axis=2))
        M = (columns * weight[:, :, None]).reshape(-1, order + m)
        right = (H * weight[:, :, None]).reshape(-1, p)
        size = np.linalg.norm(M, axis=0)
        BD = np.linalg.lstsq(
            np.concatenate([M.real, M.imag]) / size,
            np.concatenate([right.real, right.imag]),
            rcond=None,
        )[0]
        BD /= size[:, None]
        return StateSpace(A, BD[:order], C, BD[order:], Ts_s)


def frequency_subspace(response: ResponseEstimate) -> FrequencySubspace:
    """Decompose a response H (F, m, p), its signals of comparable size.

    Each frequency counts by its noise. The frequencies are spread over the unit circle by a
    bilinear map, which keeps the order, so that the sampling rate does not matter.
    """
    H, f = response.H, response.freq_hz
    m, p = H.shape[1:]
    # Of m rows each block has at most 2 F p columns.
    rows = min(_BLOCK_ROWS, 2 * len(f) * p // (m + p) - 1)
    w = np.tan(np.pi * f * response.Ts_s)
    warp = float(w.max() / np.tan(0.5 * _TOP_ANGLE))
    z = np.exp(2j * np.arctan(w / warp))
    sd = response.standard_deviation
    powers = z[:, None] ** np.arange(rows) / np.sqrt(np.mean(sd**2, axis=(1, 2)))[:, None]
    inputs = np.linalg.qr(_stacked(powers, np.broadcast_to(np.eye(p), (len(f), p, p))).T)[0]

    def decomposed(found: Complex) -> tuple[Array, Array]:
        outputs = _stacked(powers, found)
        outputs = outputs - (outputs @ inputs) @ inputs.T
        U, s, _ = np.linalg.svd(np.asarray(np.linalg.qr(outputs.T, mode="r")).T)
        return U, s

    rng = np.random.default_rng(0)
    values, vectors = np.linalg.eigh(response.covariance.reshape(len(f), m * p, m * p))
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]

    def drawn() -> float:
        draw = rng.normal(size=(2, len(f), m * p)) / np.sqrt(2.0)
        noise = np.einsum("fij,fj->fi", root, draw[0] + 1j * draw[1]).reshape(H.shape)
        return float(decomposed(noise)[1][0])

    level = level_of_chance(drawn)
    U, s = decomposed(H)
    count = min(SINGULAR_VALUES, len(s) - m)
    return FrequencySubspace(s[:count], level, U[:, :count], response, warp)


def _stacked(powers: Complex, H: Complex) -> Array:
    """Return [H; z H; z^2 H; ...] of all frequencies side by side, real and imaginary parts."""
    F, m, p = H.shape
    found = np.einsum("fq,fij->qifj", powers, H).reshape(powers.shape[1] * m, F * p)
    return np.hstack([found.real, found.imag])
