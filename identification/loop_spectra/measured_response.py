"""Measure the plant's response at one point of the schedule, without a model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..nonparametric.frequency_response import ResponseEstimate
from ..nonparametric.joint_input_output import plant_from_joint_response
from ..nonparametric.local_polynomial import local_polynomial
from ..records.record import IdentificationError
from .spectral_lines import LoopSignals

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_POINTS = 700
_SPARSE = 0.5
"""Share of excited lines below which an excitation is periodic."""
_EXCITED = 1e-8
_BESIDE = 20
"""Lines on either side of an excited one whose power, where not excited, is the noise."""


def measured_response(
    records: Sequence[LoopSignals], Ts_s: float, top_hz: float, rows: int | None = None
) -> ResponseEstimate:
    """Return P (F, n, p) up to top_hz, from records of one point.

    Both the outputs' and the inputs' responses to the excitation are measured, so feedback does not
    bias P: by local polynomials for noise, line by line for periodic excitation. rows: length to
    whose lines the frequencies belong, None for that of the shortest record.

    Raises IdentificationError if the records do not excite every input on its own, or are periodic
    and of different lengths.
    """
    v = [r.v - r.v.mean(axis=0) for r in records]
    p = v[0].shape[1]
    if set().union(*(r.excited for r in records)) != set(range(p)):
        raise IdentificationError("expected an excitation of every input")
    signals = [np.hstack([r.y, r.u - r.v]) for r in records]
    lengths = {len(x) for x in v}
    rows = rows or min(lengths)
    excited = [_excited_lines(x, int(top_hz * len(x) * Ts_s)) for x in v]
    dense = [len(e) >= _SPARSE * top_hz * len(x) * Ts_s for x, e in zip(v, excited, strict=True)]
    if any(dense) and not all(dense):  # noise alone, or the periodic records alone
        of_noise = [r for r, is_dense in zip(records, dense, strict=True) if is_dense]
        others = [r for r, is_dense in zip(records, dense, strict=True) if not is_dense]
        enough = set().union(*(r.excited for r in of_noise)) == set(range(p))
        return measured_response(of_noise if enough else others, Ts_s, top_hz, rows)
    if all(dense):
        last = int(top_hz * rows * Ts_s)
        step = max(1, round(last / _POINTS))
        loop = local_polynomial(v, signals, Ts_s, np.arange(3 * step, last, step) / (rows * Ts_s))
    elif len(records) < p:
        raise IdentificationError(
            f"expected a periodic record for each of {p} inputs, found {len(records)}"
        )
    elif len(lengths) > 1:
        raise IdentificationError(
            f"expected periodic records of one length, found {sorted(lengths)} rows"
        )
    else:
        lines = np.unique(np.concatenate(excited))
        loop = _line_by_line(v, signals, lines, int(top_hz * rows * Ts_s), Ts_s)
    return plant_from_joint_response(loop, records[0].y.shape[1])


def _excited_lines(v: Array, last: int) -> NDArray[np.int_]:
    power = np.sum(np.abs(fft.rfft(v, axis=0)[:last]) ** 2, axis=1)
    lines = np.flatnonzero(power > _EXCITED * np.max(power, initial=0.0))
    return np.asarray(lines[lines >= 1])


def last_significant(responses: Sequence[ResponseEstimate], top_hz: float) -> float:
    """Return the frequency up to which some entry of the response is above its noise."""
    if not responses:
        return top_hz
    clear = np.any([np.abs(r.H) > 3.0 * r.standard_deviation for r in responses], axis=(0, 2, 3))
    # By chance 1 in 8000 is above three: the last of several in a row counts.
    runs = np.convolve(clear, np.ones(5), mode="same") >= 4
    where = np.flatnonzero(runs)
    return top_hz if not len(where) else min(1.1 * float(responses[0].freq_hz[where[-1]]), top_hz)


def _line_by_line(
    v: Sequence[Array],
    signals: Sequence[Array],
    excited: NDArray[np.int_],
    lines: int,
    Ts_s: float,
) -> ResponseEstimate:
    """Return the response (F, m, p) at the excited ones of the first lines of all records."""
    rows = len(signals[0])
    V = np.array([fft.rfft(x, axis=0)[:lines] for x in v])
    Y = np.array([fft.rfft(x - x.mean(axis=0), axis=0)[:lines] for x in signals])
    quiet = np.setdiff1d(np.arange(1, lines), excited)
    beside = np.zeros((lines, Y.shape[2]))
    beside[quiet] = np.mean(np.abs(Y[:, quiet]) ** 2, axis=0)
    box = np.ones(2 * _BESIDE + 1)
    count = np.convolve(np.isin(np.arange(lines), quiet), box, mode="same")
    noise = np.array([np.convolve(x, box, mode="same") for x in beside.T]).T
    noise = noise[excited] / np.maximum(count[excited], 1.0)[:, None]
    X = V[:, excited].transpose(1, 0, 2)
    inverse = np.linalg.pinv(X, rcond=1e-6)
    H = (inverse @ Y[:, excited].transpose(1, 0, 2)).transpose(0, 2, 1)
    spread = inverse @ inverse.conj().transpose(0, 2, 1)
    eye = np.eye(noise.shape[1])
    return ResponseEstimate(
        excited / (rows * Ts_s),
        H,
        np.ones(H.shape),
        np.asarray(np.einsum("fi,ik,fjl->fijkl", noise, eye, spread)),
        Ts_s,
    )
