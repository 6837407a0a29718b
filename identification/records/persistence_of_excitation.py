"""Whether the excitation can tell all Markov parameters apart: a check before the work is done."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from .record import IdentificationError, Record

Array = NDArray[np.float64]

LEAST_POWER = 1e-3
"""Share of its mean that the spectrum may sink to: below, noise is amplified 30 times."""
SEGMENTS = 8
"""Shortest record over longest segment; half-overlapping ones average the spectrum's scatter."""
REPEATS = 0.9
"""Correlation (of either sign) of the excitation with itself from which on it repeats."""
REMEDY = (
    "fly white noise (signal white_noise without band_hz), or multisines with 'orthogonal' at all "
    "inputs"
)


class PoorExcitationError(IdentificationError):
    """Records that excite too little of the band for Markov parameters; other methods may do."""


def check_inputs(records: Sequence[Record]) -> None:
    """Check that every input is excited by some of the records; raises PoorExcitationError."""
    first = records[0]
    excited = np.any([r.excited for r in records], axis=0)
    missing = [name for name, yes in zip(first.input_names, excited, strict=True) if not yes]
    if missing:
        names = ", ".join(f"'{r.name}'" for r in records)
        raise PoorExcitationError(
            f"expected records that excite {', '.join(first.input_names)}; {', '.join(missing)} is "
            f"excited by none of {names}"
        )


def check_excitation(records: Sequence[Record], length: int) -> None:
    """Check that the records together excite all inputs, at every frequency, independently.

    Judged is the spectral density matrix of v from 1 / segment to half the rate, each input by its
    mean power: its smallest eigenvalue must nowhere sink below LEAST_POWER. A signal that repeats
    within `length` rows cannot tell so many Markov parameters apart either.

    Raises PoorExcitationError, which says what is covered and what to fly instead.
    """
    Ts_s = records[0].Ts_s
    repeats = repetition(records, length)
    if repeats is not None:
        raise PoorExcitationError(
            f"expected excitation for an impulse response of {length * Ts_s:.3g} s, found one that "
            f"repeats after {repeats * Ts_s:.3g} s: {REMEDY}"
        )
    segment = max(min(length, min(len(r.v) for r in records) // SEGMENTS), 8)
    power = _least_power(records, segment)
    freq_hz = np.arange(1, len(power) + 1) / (segment * Ts_s)
    if power.min() >= LEAST_POWER:
        return
    covered = freq_hz[power > np.sqrt(LEAST_POWER)]
    found = (
        f"{covered[0]:.3g} to {covered[-1]:.3g} Hz covered"
        if len(covered)
        else "inputs that move as one"
    )
    gap_hz = freq_hz[power.argmin()]
    raise PoorExcitationError(
        f"expected excitation at every frequency up to {0.5 / Ts_s:g} Hz, which Markov parameters "
        f"need, found {found} (next to nothing at {gap_hz:.3g} Hz): {REMEDY}"
    )


def repetition(records: Sequence[Record], length: int) -> int | None:
    """Return the rows below `length` after which an input's excitation repeats (or turns over)."""
    for record in records:
        for v in record.v[:, record.excited].T:
            rows = min(length, len(v) // 2)
            size = fft.next_fast_len(2 * len(v), real=True)
            spectrum = fft.rfft(v, size)
            lags = fft.irfft(spectrum * spectrum.conj(), size)[:rows]
            # Of finite rows, a lag has that many fewer terms.
            like = np.abs(lags / lags[0] * len(v) / (len(v) - np.arange(rows)))
            apart = int(np.argmax(like < 0.5)) if np.any(like < 0.5) else rows
            again = np.flatnonzero(like[apart:] > REPEATS)
            if len(again):
                return apart + int(again[0])
    return None


def _least_power(records: Sequence[Record], segment: int) -> Array:
    """Return (F,): smallest eigenvalue of the spectral density of v, at bins 1 and up."""
    window = signal.windows.hann(segment, sym=False)
    total = 0.0
    for record in records:
        starts = range(0, len(record.v) - segment + 1, max(segment // 2, 1))
        for start in starts:
            part = record.v[start : start + segment].T * window
            x = fft.rfft(part)[:, 1 : (segment + 1) // 2]  # neither 0 Hz nor half the rate
            total = total + np.einsum("if,jf->fij", x, x.conj())
    density = np.asarray(total)
    scale = np.sqrt(np.einsum("fii->fi", density).real.mean(axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    return np.asarray(np.linalg.eigvalsh(density / (scale[:, None] * scale))[:, 0])
