"""Propagate the covariance of a state-space model to its frequency response and modes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...model.second_order import StateSpace
from .plant_from_loop import IdentifiedPlant

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

SURE_95 = 1.96
"""Half width of a Gaussian 95 % confidence interval, in standard deviations."""


@dataclass(frozen=True)
class ModelResponse:
    """Frequency response H (F, m, p) of a model at freq_hz (F,), with its uncertainty.

    `covariance` (F, m, p, m, p) is E dH[i,j] dH[k,l]^*; `relation` (F, m, p) is E dH[i,j]^2. The
    few parameters of a model make its confidence regions ellipses in the complex plane, not
    circles, which `covariance` alone would describe.
    """

    freq_hz: Array
    H: Complex
    covariance: Complex
    relation: Complex
    Ts_s: float

    @property
    def standard_deviation(self) -> Array:
        """Root mean square error (F, m, p) of the complex entries."""
        return np.asarray(np.sqrt(np.abs(np.einsum("fijij->fij", self.covariance))))

    @property
    def magnitude_deviation(self) -> Array:
        """Standard deviation (F, m, p) of |H|; the 95 % interval is 1.96 times it."""
        return self._along(1.0)

    @property
    def phase_deviation_rad(self) -> Array:
        """Standard deviation (F, m, p) of H's phase; the 95 % interval is 1.96 times it."""
        return np.asarray(self._along(-1.0) / np.abs(self.H))

    def _along(self, sign: float) -> Array:
        """Return the standard deviation along H (sign 1), or perpendicular to it (sign -1)."""
        power = np.einsum("fijij->fij", self.covariance).real
        with np.errstate(divide="ignore", invalid="ignore"):
            relation = np.real(self.relation * (self.H.conj() / np.abs(self.H)) ** 2)
        return np.asarray(np.sqrt(np.maximum(power + sign * relation, 0.0) / 2))


@dataclass(frozen=True)
class Modes:
    """Poles (k,) of a model as natural frequency in Hz and damping, with standard errors.

    They are sorted by frequency, with one of each complex pair. A real pole has damping 1
    (unstable: -1) and frequency |s| / 2 pi. Real poles z <= 0 have no continuous counterpart and
    are left out.
    """

    frequency_hz: Array
    frequency_se_hz: Array
    damping: Array
    damping_se: Array


def response_with_errors(
    plant: IdentifiedPlant, covariance: Array, freq_hz: Array
) -> ModelResponse:
    """Return the response of P with errors, from the covariance of its core's [A B; C D].

    `covariance` is (n + m, n + p, n + m, n + p). dP = z^-d lag(z) [C (zI - A)^-1, I] d[A B; C D]
    [(zI - A)^-1 B; I].
    """
    core = plant.core
    n, m, p = len(core.A), len(core.C), len(core.B[0])
    left, right = plant.slopes(freq_hz)
    slope = np.einsum("fia,fbj->fijab", left, right)
    flat = slope.reshape(len(slope), m * p, -1)
    half = flat @ covariance.reshape((n + m) * (n + p), -1)
    return ModelResponse(
        np.asarray(freq_hz, dtype=np.float64),
        plant.response(freq_hz),
        (half @ flat.conj().transpose(0, 2, 1)).reshape(-1, m, p, m, p),
        np.einsum("fax,fax->fa", half, flat).reshape(-1, m, p),
        core.Ts_s,
    )


def modes(model: StateSpace, covariance: Array) -> Modes:
    """Return the modes of the model, with errors to first order in those of [A B; C D].

    The derivative of a pole is w^H dA v / (w^H v); that of s = ln(pole) / Ts is this over pole Ts.
    For double poles it does not exist, and the standard errors are nan.
    """
    n = len(model.A)
    poles, v = np.linalg.eig(model.A)
    poles, v = poles.astype(complex), v.astype(complex)
    listed = (poles.imag >= 0) & ~((poles.imag == 0) & (poles.real <= 0))
    poles, v = poles[listed], v[:, listed]
    s = np.log(poles) / model.Ts_s
    order = np.argsort(np.abs(s))
    poles, s, v = poles[order], s[order], v[:, order]
    cov = covariance[:n, :n, :n, :n].reshape(n * n, n * n)
    frequency_se, damping_se = np.full((2, len(poles)), np.nan)
    for k, (pole, right) in enumerate(zip(poles, v.T, strict=True)):
        # The left eigenvector, as the null vector of (A - pole I)^T.
        left = np.linalg.svd((model.A - pole * np.eye(n)).T)[2][-1].conj()
        product = left @ right
        if abs(product) < _MIN_EIGENVECTOR_PRODUCT:
            continue
        ds = (np.outer(left, right) / (product * pole * model.Ts_s)).ravel()
        size = abs(s[k])
        along = np.real(np.conj(s[k]) * ds) / size  # d|s|
        frequency_se[k] = np.sqrt(max(along @ cov @ along, 0.0)) / (2 * np.pi)
        damping = -ds.real / size + s[k].real * along / size**2
        damping_se[k] = np.sqrt(max(damping @ cov @ damping, 0.0))
    return Modes(np.abs(s) / (2 * np.pi), frequency_se, -s.real / np.abs(s), damping_se)


def disagreements(one: Modes, other: Modes, names: tuple[str, str]) -> tuple[str, ...]:
    """Return a sentence for each mode of the smaller model whose 95 % intervals do not overlap.

    Each mode is compared with the other model's nearest one in frequency and damping.
    """
    if len(one.frequency_hz) > len(other.frequency_hz):
        one, other, names = other, one, (names[1], names[0])
    texts = []
    for f, f_se, d, d_se in zip(
        one.frequency_hz, one.frequency_se_hz, one.damping, one.damping_se, strict=True
    ):
        apart = np.hypot(np.log(other.frequency_hz / f), other.damping - d)
        if not np.any(np.isfinite(apart)):
            continue
        k = int(np.nanargmin(apart))
        pairs = (
            (f, f_se, other.frequency_hz[k], other.frequency_se_hz[k]),
            (d, d_se, other.damping[k], other.damping_se[k]),
        )
        if any(abs(a - b) > SURE_95 * (a_se + b_se) for a, a_se, b, b_se in pairs):
            found = [
                f"{name} {v[0]:.4g} ± {SURE_95 * v[1]:.2g} Hz, damping {w[0]:.3g} ± "
                f"{SURE_95 * w[1]:.2g}"
                for name, v, w in zip(
                    names, (pairs[0][:2], pairs[0][2:]), (pairs[1][:2], pairs[1][2:]), strict=True
                )
            ]
            texts.append(f"two methods disagree on a mode: {found[0]}; {found[1]}")
    return tuple(texts)


_MIN_EIGENVECTOR_PRODUCT = 1e-10
"""Least product of left and right eigenvector; below, the pole counts as double."""
