"""Find the modes of a plant above its rigid ones, by vector fitting of its measured response."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...nonparametric.frequency_response import ResponseEstimate
from .mode import Mode

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

MOST_MODES = 8
_ITERATIONS = 8
_MODEL_SHARE = 0.02
"""Errors below this share of the response do not call for a mode: a fit to all lines follows."""
_FIRST_DAMPING = 0.02
_DAMPING = (1e-3, 0.7)


def starting_modes(responses: Sequence[ResponseEstimate], above_hz: float) -> tuple[Mode, ...]:
    """Return bending modes of continuous responses P (F, n, p) of several points, without hold.

    The poles are common to all points and entries. Beside them each entry has terms in s^-2, s^-3
    and s^-4 (rigid modes below the band) and a constant (modes above), as in experimental modal
    analysis. A pole pair is added where the residual is largest, and relocated (Gustavsen and
    Semlyen 1999); the number minimises the Bayesian information criterion.
    """
    freq_hz = responses[0].freq_hz
    band = freq_hz > above_hz
    s = np.asarray(2j * np.pi * freq_hz[band])
    n, p = responses[0].H.shape[1:]
    y = np.concatenate([r.H[band].reshape(len(s), -1) for r in responses], axis=1)
    sd = np.concatenate([r.standard_deviation[band].reshape(len(s), -1) for r in responses], axis=1)
    weight = 1.0 / np.sqrt(sd**2 + (_MODEL_SHARE * np.abs(y)) ** 2)
    low = np.abs(s[0]) / s
    fixed = np.stack([low**2, low**3, low**4, np.ones(len(s))], axis=1)
    found = _fitted(s, y, weight, fixed, np.zeros(0, complex))
    while len(found.poles) < MOST_MODES:
        where = np.imag(s[int(np.argmax(found.left))])
        poles = np.append(found.poles, where * complex(-_FIRST_DAMPING, 1.0))
        for _ in range(_ITERATIONS):
            poles = _relocated(s, y, weight, fixed, poles)
        more = _fitted(s, y, weight, fixed, poles)
        if more.criterion >= found.criterion:
            break
        found = more
    coefficients = found.coefficients.reshape(len(responses), n, p, -1).mean(axis=0)
    modes = []
    for k, pole in enumerate(found.poles):
        a, b = coefficients[:, :, 2 * k], coefficients[:, :, 2 * k + 1]
        # (a + i b) / (s - pole) and its conjugate, without the numerator's term in s.
        strength = -2.0 * (a * pole.real + b * pole.imag)
        modes.append(Mode("bending", float(abs(pole)), float(-pole.real / abs(pole)), strength))
    return tuple(modes)


@dataclass(frozen=True)
class _Fitted:
    poles: Complex
    coefficients: Array
    left: Array
    criterion: float


def _pairs(s: Complex, poles: Complex) -> Complex:
    """Return the real-coefficient basis (F, 2 K) of pole pairs."""
    found = np.zeros((len(s), 2 * len(poles)), complex)
    for k, pole in enumerate(poles):
        one, other = 1.0 / (s - pole), 1.0 / (s - np.conj(pole))
        found[:, 2 * k], found[:, 2 * k + 1] = one + other, 1j * (one - other)
    return found


def _fitted(s: Complex, y: Complex, weight: Array, fixed: Complex, poles: Complex) -> _Fitted:
    basis = np.hstack([_pairs(s, poles), fixed])
    coefficients = []
    for column, w in zip(y.T, weight.T, strict=True):
        A, b = _real(basis * w[:, None]), _real(w * column)
        size = np.linalg.norm(A, axis=0)
        coefficients.append(np.linalg.lstsq(A / size, b, rcond=1e-12)[0] / size)
    found = np.array(coefficients)
    squares = np.sum(np.abs((basis @ found.T - y) * weight) ** 2, axis=1)
    unknowns = 2 * len(poles) * (1 + y.shape[1])
    criterion = 2.0 * float(squares.sum()) + unknowns * np.log(2.0 * y.size)
    return _Fitted(poles, found, np.convolve(squares, np.ones(3) / 3.0, mode="same"), criterion)


def _relocated(s: Complex, y: Complex, weight: Array, fixed: Complex, poles: Complex) -> Complex:
    """Return the zeros of the function that multiplies y in a linear fit, as the new poles."""
    pairs = _pairs(s, poles)
    own = np.hstack([pairs, fixed])
    rows, right = [], []
    for column, w in zip(y.T, weight.T, strict=True):
        A = _real(np.hstack([own, -pairs * column[:, None], column[:, None]]) * w[:, None])
        R = np.asarray(np.linalg.qr(A, mode="r"))
        k = own.shape[1]
        rows.append(R[k:-1, k:-1])
        right.append(R[k:-1, -1])
    A, b = np.vstack(rows), np.concatenate(right)
    size = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    c = np.linalg.lstsq(A / size, b, rcond=1e-12)[0] / size
    matrix, inputs = np.zeros((2 * len(poles), 2 * len(poles))), np.zeros(2 * len(poles))
    for k, pole in enumerate(poles):
        pair = slice(2 * k, 2 * k + 2)
        matrix[pair, pair] = [[pole.real, pole.imag], [-pole.imag, pole.real]]
        inputs[2 * k] = 2.0
    zeros = np.linalg.eigvals(matrix - np.outer(inputs, c)).astype(complex)
    is_real = np.abs(zeros.imag) <= 1e-6 * np.abs(zeros)
    upper = list(zeros[(zeros.imag > 0) & ~is_real])
    # Two real poles count as one overdamped pair; an odd one is left out.
    real = np.sort(np.abs(zeros[is_real].real))
    real = real[: len(real) // 2 * 2].reshape(-1, 2)
    upper += list(1j * np.sqrt(real[:, 0] * real[:, 1]))
    found = np.array(upper, complex)
    size = np.abs(found)
    damping = np.clip(np.abs(found.real) / size, *_DAMPING)
    return np.asarray(size * (-damping + 1j * np.sqrt(1.0 - damping**2)))


def _real(x: Complex) -> Array:
    return np.concatenate([x.real, x.imag])
