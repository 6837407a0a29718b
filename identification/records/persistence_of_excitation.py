"""Check persistence of excitation: whether the records determine all Markov parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from .record import IdentificationError, Record

Array = NDArray[np.float64]

MIN_POWER = 1e-3
"""Smallest excitation spectrum over its mean; below, the noise is amplified more than 30 times."""
SEGMENTS = 8
"""Segments in the shortest record; they overlap by half, to average the spectrum's scatter."""
MIN_REPETITION = 0.9
"""Autocorrelation (of either sign) from which the excitation counts as periodic."""
_LINES_A_SINE = 3
"""Fewest spectral lines of a sine wave in a Hann window."""
REMEDY = (
    "fly white noise (signal white_noise without band_hz), or multisines with 'orthogonal' at all "
    "inputs"
)


class PoorExcitationError(IdentificationError):
    """Excitation that does not determine the Markov parameters; other methods may still work."""


def check_inputs(records: Sequence[Record]) -> None:
    """Check that the records together excite every input; raises PoorExcitationError."""
    first = records[0]
    excited = np.any([r.excited for r in records], axis=0)
    missing = [name for name, yes in zip(first.input_names, excited, strict=True) if not yes]
    if missing:
        names = ", ".join(f"'{r.name}'" for r in records)
        raise PoorExcitationError(
            f"expected records that excite {', '.join(first.input_names)}, found no excitation of "
            f"{', '.join(missing)} in {names}"
        )


def check_excitation(records: Sequence[Record], length: int) -> None:
    """Check that the records excite all inputs, independently and at every frequency.

    The check uses the spectral density matrix of v from 1 / segment to half the sampling rate, each
    input divided by its mean power. Its smallest eigenvalue must be at least MIN_POWER at every
    frequency. A signal that repeats within `length` rows does not determine so many Markov
    parameters either.

    Raises PoorExcitationError, which names the band covered and the excitation to use instead.
    """
    Ts_s = records[0].Ts_s
    repeats = repetition(records, length)
    if repeats is not None:
        raise PoorExcitationError(
            f"expected excitation that does not repeat within the impulse response of "
            f"{length * Ts_s:.3g} s, found a period of {repeats * Ts_s:.3g} s: {REMEDY}"
        )
    segment = max(min(length, min(len(r.v) for r in records) // SEGMENTS), 8)
    power = _smallest_power(records, segment)
    freq_hz = np.arange(1, len(power) + 1) / (segment * Ts_s)
    if power.min() >= MIN_POWER:
        return
    covered = freq_hz[power > np.sqrt(MIN_POWER)]
    found = (
        f"{covered[0]:.3g} to {covered[-1]:.3g} Hz covered"
        if len(covered)
        else "fully correlated inputs"
    )
    weakest_hz = freq_hz[power.argmin()]
    raise PoorExcitationError(
        f"Markov parameters: expected excitation at every frequency up to {0.5 / Ts_s:g} Hz, found "
        f"{found} (weakest at {weakest_hz:.3g} Hz): {REMEDY}"
    )


def repetition(records: Sequence[Record], length: int) -> int | None:
    """Return after how many rows, below `length`, an excitation repeats (or repeats negated)."""
    for record in records:
        for v in record.v[:, record.excited].T:
            rows = min(length, len(v) // 2)
            size = fft.next_fast_len(2 * len(v), real=True)
            spectrum = fft.rfft(v, size)
            lags = fft.irfft(spectrum * spectrum.conj(), size)[:rows]
            # The sum at lag k has k terms fewer.
            correlation = np.abs(lags / lags[0] * len(v) / (len(v) - np.arange(rows)))
            low = correlation < 0.5
            first_low = int(np.argmax(low)) if np.any(low) else rows
            repeats = np.flatnonzero(correlation[first_low:] > MIN_REPETITION)
            if len(repeats):
                return first_low + int(repeats[0])
    return None


def _smallest_power(records: Sequence[Record], segment: int) -> Array:
    """Return the smallest eigenvalue (F,) of the spectral density of v, from bin 1 up."""
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


@dataclass(frozen=True)
class DependentInput:
    """An input that is a linear combination of others, up to `share` of its RMS.

    `factors`: of the other inputs by name, in units of the signals.
    """

    name: str
    factors: Mapping[str, float]
    share: float


def dependent_inputs(records: Sequence[Record]) -> list[DependentInput]:
    """Return the inputs that the others explain in the same row, the last ones of each set first.

    An input is dependent if less than MIN_POWER of its power is left. Constant inputs do not count.
    """
    names = records[0].input_names
    stacked = np.vstack([r.v - r.v.mean(axis=0) for r in records])
    R: Array = np.asarray(np.linalg.qr(stacked, mode="r"))
    size = np.linalg.norm(R, axis=0)
    others = np.flatnonzero(np.any([r.excited for r in records], axis=0)).tolist()
    found = []
    for j in reversed(list(others)):
        rest = [i for i in others if i != j]
        unit = R[:, rest] / size[rest]
        factors = np.linalg.lstsq(unit, R[:, j] / size[j], rcond=1e-12)[0]
        share = float(np.linalg.norm(R[:, j] / size[j] - unit @ factors))
        if rest and share**2 < MIN_POWER:
            by_name = dict(
                zip((names[i] for i in rest), size[j] * factors / size[rest], strict=True)
            )
            found.append(DependentInput(names[j], by_name, share))
            others.remove(j)
    return found


def sine_waves(records: Sequence[Record]) -> NDArray[np.int64]:
    """Return for each input (p,) how many sine waves have all but MIN_POWER of its power.

    Each determines two numbers of a model (its order of persistent excitation is 2; Ljung, System
    Identification, 1999, sec. 13.2). 0 for a constant input. The count is of spectral lines of the
    longest record, whose Hann window spreads a sine over three or four.
    """
    size = max(len(r.v) for r in records)
    total = np.zeros((size // 2 + 1, records[0].v.shape[1]))
    for r in records:
        window = signal.windows.hann(len(r.v), sym=False)[:, None]
        total += np.abs(fft.rfft(window * (r.v - r.v.mean(axis=0)), size, axis=0)) ** 2
    ordered = np.sort(total, axis=0)[::-1]
    power = ordered.sum(axis=0)
    rest = power - np.cumsum(ordered, axis=0)
    lines = np.sum(rest > MIN_POWER * power, axis=0) + 1
    excited = np.any([r.excited for r in records], axis=0)
    return np.where(excited, np.maximum(lines // _LINES_A_SINE, 1), 0)
