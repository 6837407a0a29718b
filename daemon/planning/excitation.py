"""Generate excitation signals: seeded Gaussian white noise and random-phase multisines."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from ...config.base import ConfigError
from ...config.session import Excitation

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_WHITE_ROWS = 1 << 16
_MOST_ROWS = 1 << 20
"""Longest period of a multisine, and longest record whose noise is band-limited as a whole: a
quarter of an hour at 1 kHz. A Fourier transform takes 40 MB for it."""
_GROUP = 4  # a random grid omits one of each group of consecutive odd lines


def signal(
    excitation: Excitation, cycles: int, rate_hz: float, rng: np.random.Generator
) -> Iterator[Array]:
    """Yield consecutive blocks (m,) of at least `cycles` samples, in N m or N, without fading.

    A block is computed when it is asked for: a record of hours is never in memory as a whole.

    Raises:
        ConfigError: the band exceeds half the rate, or contains no line of the multisine.
    """
    band = excitation.band_hz
    if band is not None and band[1] > rate_hz / 2:
        raise ConfigError(
            f"band_hz: expected at most half the rate, {rate_hz / 2:g} Hz, found {band[1]:g} Hz"
        )
    if excitation.signal == "multisine":
        yield from repeat(_multisine_period(excitation, rate_hz, rng))
    elif band is not None:
        yield from _band_limited(excitation.level, band, cycles, rate_hz, rng)
    else:
        for at in range(0, cycles, _WHITE_ROWS):
            yield excitation.level * rng.standard_normal(min(_WHITE_ROWS, cycles - at))


def fade(first: int, end: int, cycles: int, fade_s: float, rate_hz: float) -> Array:
    """Return samples `first` to `end` of a window of `cycles` samples.

    It rises from 0 to 1 over fade_s (half of a cosine), stays there, and falls back to 0.
    """
    window = np.ones(end - first)
    n = min(round(fade_s * rate_hz), cycles // 2)
    rising, falling = np.arange(first, min(end, n)), np.arange(max(first, cycles - n), end)
    if rising.size:
        window[: rising.size] = 0.5 - 0.5 * np.cos(np.pi * rising / n)
    if falling.size:
        window[-falling.size :] = 0.5 - 0.5 * np.cos(np.pi * (cycles - 1 - falling) / n)
    return window


def excited_lines(
    excitation: Excitation, rate_hz: float, rng: np.random.Generator
) -> NDArray[np.int_]:
    """Return the excited lines of a multisine as multiples of 1 / period_s, ascending.

    `rng` draws the omitted lines of a random grid.

    Raises:
        ConfigError: the period is too long, or the band contains no line.
    """
    assert excitation.period_s is not None
    assert excitation.band_hz is not None
    n = round(excitation.period_s * rate_hz)
    if n > _MOST_ROWS:
        raise ConfigError(
            f"period_s: expected at most {_MOST_ROWS / rate_hz:.0f} s at {rate_hz:g} Hz, found "
            f"{excitation.period_s:g} s"
        )
    lines = np.arange(1, (n + 1) // 2)  # without the Nyquist line, whose phase is fixed
    freq_hz = lines * rate_hz / max(n, 1)
    lines = lines[(freq_hz >= excitation.band_hz[0]) & (freq_hz <= excitation.band_hz[1])]
    if excitation.lines != "all":
        lines = lines[lines % 2 == 1]
    if excitation.lines == "odd_random_grid":
        groups = np.arange(0, len(lines) - _GROUP + 1, _GROUP)
        lines = np.delete(lines, groups + rng.integers(0, _GROUP, len(groups)))
    if not lines.size:
        kind = "" if excitation.lines == "all" else "odd "
        raise ConfigError(
            f"band_hz: expected a band with at least one {kind}multiple of "
            f"{rate_hz / max(n, 1):g} Hz below {rate_hz / 2:g} Hz, found none in "
            f"{excitation.band_hz} Hz"
        )
    return lines


def one_period(
    excitation: Excitation, lines: NDArray[np.int_], phasors: Complex, rate_hz: float
) -> Array:
    """Return one period (n,) of the multisine, in N m or N, from unit phasors at its lines."""
    assert excitation.period_s is not None
    n = round(excitation.period_s * rate_hz)
    spectrum = np.zeros(n // 2 + 1, complex)
    spectrum[lines] = phasors
    if excitation.rise_hz is not None:
        spectrum[lines] *= np.maximum(lines * rate_hz / n / excitation.rise_hz, 1.0)
    period = np.fft.irfft(spectrum, n)
    return np.asarray(period * (excitation.level / np.sqrt(np.mean(period**2))))


def _band_pass(noise: Array, band: tuple[float, float], rate_hz: float, rms: float) -> Array:
    spectrum = np.fft.rfft(noise)
    freq_hz = np.fft.rfftfreq(len(noise), 1 / rate_hz)
    spectrum[(freq_hz < band[0]) | (freq_hz > band[1])] = 0.0
    filtered = np.fft.irfft(spectrum, len(noise))
    size = np.sqrt(np.mean(filtered**2))
    if size == 0.0:
        raise ConfigError(f"band_hz: the record is too short for a band of {band} Hz")
    return np.asarray(filtered * (rms / size))


def _band_limited(
    rms: float, band: tuple[float, float], cycles: int, rate_hz: float, rng: np.random.Generator
) -> Iterator[Array]:
    """Yield white noise without its lines outside of a band.

    What is longer than a block is joined of independent blocks. Each fades into the next one with
    weights whose squares add up to 1, so that the expected power is the same everywhere.
    """
    if cycles <= _MOST_ROWS:
        yield _band_pass(rms * rng.standard_normal(cycles), band, rate_hz, rms)
        return
    joint = _MOST_ROWS // 4
    rise = np.sin(np.pi / 2 * (np.arange(joint) + 0.5) / joint)
    ending: Array | None = None
    for _ in range(0, cycles, _MOST_ROWS - joint):
        block = _band_pass(rms * rng.standard_normal(_MOST_ROWS), band, rate_hz, rms)
        if ending is not None:
            block[:joint] = rise * block[:joint] + rise[::-1] * ending
        ending = block[-joint:].copy()
        yield block[:-joint]


def _multisine_period(excitation: Excitation, rate_hz: float, rng: np.random.Generator) -> Array:
    assert excitation.period_s is not None
    n = min(round(excitation.period_s * rate_hz), _MOST_ROWS)
    phases = 2 * np.pi * rng.random(n // 2 + 1)
    lines = excited_lines(excitation, rate_hz, rng)  # refuses a period that is longer
    return one_period(excitation, lines, np.exp(1j * phases[lines]), rate_hz)
