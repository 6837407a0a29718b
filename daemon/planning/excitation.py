"""Generate excitation signals: seeded Gaussian white noise and random-phase multisines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...config.base import ConfigError
from ...config.session import Excitation

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_GROUP = 4  # a random grid omits one of each group of consecutive odd lines


def signal(excitation: Excitation, cycles: int, rate_hz: float, rng: np.random.Generator) -> Array:
    """Return `cycles` samples (n,) of the excitation, in N m or N, without fading.

    Raises:
        ConfigError: the band exceeds half the rate, or contains no line of the multisine.
    """
    band = excitation.band_hz
    if band is not None and band[1] > rate_hz / 2:
        raise ConfigError(
            f"band_hz: expected at most half the rate, {rate_hz / 2:g} Hz, found {band[1]:g} Hz"
        )
    if excitation.signal == "multisine":
        return _multisine(excitation, cycles, rate_hz, rng)
    noise = excitation.level * rng.standard_normal(cycles)
    return noise if band is None else _band_pass(noise, band, rate_hz, excitation.level)


def fade(cycles: int, fade_s: float, rate_hz: float) -> Array:
    """Return a window (n,): half-cosine from 0 to 1 over fade_s, then 1, then back to 0."""
    window = np.ones(cycles)
    n = min(round(fade_s * rate_hz), cycles // 2)
    if n:
        window[:n] = 0.5 - 0.5 * np.cos(np.pi * np.arange(n) / n)
        window[-n:] = window[:n][::-1]
    return window


def excited_lines(
    excitation: Excitation, rate_hz: float, rng: np.random.Generator
) -> NDArray[np.int_]:
    """Return the excited lines of a multisine as multiples of 1 / period_s, ascending.

    `rng` draws the omitted lines of a random grid. Raises ConfigError if the band contains no line.
    """
    assert excitation.period_s is not None
    assert excitation.band_hz is not None
    n = round(excitation.period_s * rate_hz)
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


def _multisine(
    excitation: Excitation, cycles: int, rate_hz: float, rng: np.random.Generator
) -> Array:
    assert excitation.period_s is not None
    n = round(excitation.period_s * rate_hz)
    phases = 2 * np.pi * rng.random(n // 2 + 1)
    lines = excited_lines(excitation, rate_hz, rng)
    period = one_period(excitation, lines, np.exp(1j * phases[lines]), rate_hz)
    return np.asarray(np.resize(period, cycles))
