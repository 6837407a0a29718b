"""Filter a record below a frequency limit: derivatives of the outputs, the input as it acts.

All signals of a record pass the same zero-phase low-pass, so that an equation that is linear in
them stays true. Derivatives, delay, lag and hold are exact in the frequency domain.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.signal import detrend, welch

from ...records.record import IdentificationError
from ..experiment.experiment_from_log import Experiment
from ..experiment.intersample_input import Hold

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

DERIVATIVES = 4
"""Derivatives 0 .. 3 of the outputs: an equation of second order, and one order more."""
BAND_STEPS = (2.4, 1.55, 1.0)
"""The upper limits of three bands, as divisors of the highest limit."""
SHORTEST_ROWS = 50
_STEEPNESS = 8
"""Exponent of the low-pass 1 / (1 + (f/fc)^8): a Butterworth filter of fourth order both ways."""
_ABOVE_NOISE = 10.0
"""Ratio of an output's power density to its noise at the upper end of the band."""
_MOST_OF_RATE: dict[Hold, float] = {"zoh": 0.177, "foh": 0.24, "band_limited": 0.35}
"""Highest limit over the rate. At f the alias of a mass is (f / (rate - f))^3 with a zero-order
hold, which is 1 % at 0.177, and ^4 with a first-order hold. A band-limited input has none."""
_NOISE_SHARE = 0.01
"""Largest part of noise in the power of an acceleration."""
_NOISE_SHARE_OF_VELOCITY = 1e-4
"""The same of a velocity: laws of it turn where it is small."""
_WIDEST = 0.4
"""Highest limit of positions and velocities over the rate."""
_EDGE = 2.0
"""Rows left out at each end of a record, in periods of the upper limit."""
_MOST_EDGE = 0.1
_OVERSAMPLED = 8.0
"""Rate of the rows that are kept, over the upper limit."""


@dataclass(frozen=True)
class Line:
    """A straight line over the extended record: value (c,) at its begin, slope (c,) per second."""

    value: Array
    slope: Array


@dataclass(frozen=True)
class BandLimited:
    """One record below `cutoff_hz`.

    derivatives: 0 .. 3 of the outputs, each (N, n), at every row. `kept`: the rows that count,
    without the ends. spectrum (F, p) and line: the extended
    input before the low-pass. schedule: mean of each scheduling variable.
    """

    derivatives: tuple[Array, ...]
    spectrum: Complex
    line: Line
    freq_hz: Array
    low_pass: Array
    kept: slice
    before: int
    length: int
    cutoff_hz: float
    hold: Hold
    Ts_s: float
    own_delay_s: float
    schedule: Mapping[str, float]

    @classmethod
    def of(
        cls, e: Experiment, hold: Hold, cutoff_hz: float, oversampled: float = _OVERSAMPLED
    ) -> BandLimited:
        """Return a record below a limit.

        oversampled: rate of the rows that are kept, over the limit, at least.
        """
        Ts_s, rows = e.Ts_s, len(e.y)
        before = min(rows - 1, math.ceil(4.0 / (cutoff_hz * Ts_s)))
        length = next_fast_len(rows + 2 * before, real=True)
        freq_hz = rfftfreq(length, Ts_s)
        low_pass = 1.0 / (1.0 + (freq_hz / cutoff_hz) ** _STEEPNESS)
        y, line_y = _spectrum(e.y, before, length, Ts_s)
        u, line_u = _spectrum(e.u, before, length, Ts_s)
        edge = min(math.ceil(_EDGE / (cutoff_hz * Ts_s)), int(_MOST_EDGE * rows))
        stride = max(int(1.0 / (oversampled * cutoff_hz * Ts_s)), 1)
        t = np.arange(length) * Ts_s
        derivatives = []
        for k in range(DERIVATIVES):
            found = irfft(y * (low_pass * (2j * np.pi * freq_hz) ** k)[:, None], length, axis=0)
            if k == 0:
                found = found + line_y.value + line_y.slope * t[:, None]
            elif k == 1:
                found = found + line_y.slope
            derivatives.append(np.asarray(found[before : before + rows]))
        return cls(
            tuple(derivatives), u, line_u, freq_hz, low_pass, slice(edge, rows - edge, stride),
            before, length, cutoff_hz, hold, Ts_s, e.delay_cycles * Ts_s,
            {name: float(v.mean()) for name, v in e.schedule.items()},
        )  # fmt: skip

    @property
    def row_s(self) -> float:
        """Time between the rows that are kept."""
        return float(self.kept.step * self.Ts_s)

    def kept_derivatives(self) -> tuple[Array, ...]:
        """Return the derivatives at the rows that are kept, each (rows, n)."""
        return tuple(x[self.kept] for x in self.derivatives)

    def smoothed(self, values: Array) -> Array:
        """Return signals (N, c) after the low-pass, at the rows that are kept."""
        spectrum, line = _spectrum(values, self.before, self.length, self.Ts_s)
        return self._back(spectrum * self.low_pass[:, None], line, 0.0)

    def smoothed_derivatives(self, values: Array) -> tuple[Array, Array, Array]:
        """Return signals (N, c) and two derivatives after the low-pass, at the rows kept."""
        spectrum, line = _spectrum(values, self.before, self.length, self.Ts_s)
        found = []
        none = Line(np.zeros_like(line.value), np.zeros_like(line.value))
        for k, own in enumerate((line, Line(line.slope, none.slope), none)):
            slope = self.low_pass * (2j * np.pi * self.freq_hz) ** k
            found.append(self._back(spectrum * slope[:, None], own, 0.0))
        return found[0], found[1], found[2]

    def input(self, delay_s: float, lag_s: float, given: Array | None = None) -> Array:
        """Return the input (rows, p) after delay, lag, hold and low-pass, as the plant sees it.

        given (N, p): other commands than the record's.
        """
        f = self.freq_hz
        spectrum, line = self.spectrum, self.line
        if given is not None:
            spectrum, line = _spectrum(given, self.before, self.length, self.Ts_s)
        total_s = delay_s + self.own_delay_s
        shape = np.exp(-2j * np.pi * f * total_s) / (1.0 + 2j * np.pi * f * lag_s)
        shift_s = total_s + lag_s
        if self.hold == "zoh":
            shape = shape * np.sinc(f * self.Ts_s) * np.exp(-1j * np.pi * f * self.Ts_s)
            shift_s += 0.5 * self.Ts_s
        elif self.hold == "foh":
            shape = shape * np.sinc(f * self.Ts_s) ** 2
        return self._back(spectrum * (self.low_pass * shape)[:, None], line, shift_s)

    def _back(self, spectrum: Complex, line: Line, shift_s: float) -> Array:
        """Return the rows that are kept of a filtered spectrum and its line, `shift_s` later."""
        rows = len(self.derivatives[0])
        whole = irfft(spectrum, self.length, axis=0)[self.before : self.before + rows][self.kept]
        t = (np.arange(rows)[self.kept] + self.before) * self.Ts_s - shift_s
        return np.asarray(whole + line.value + line.slope * t[:, None])


def upper_limit(experiment: Experiment, hold: Hold) -> float:
    """Return the frequency in Hz up to which every output is ten times above its noise.

    The noise is the least power density of the output. The limit is lower if the steps of a held
    input reach it: above half the rate a held input has images, of which the sampled outputs of a
    mass contain an alias. Below the limit it is at most 1 % of the output.
    """
    Ts_s, rows = experiment.Ts_s, len(experiment.y)
    if rows < SHORTEST_ROWS:
        raise IdentificationError(
            f"record '{experiment.name}': expected at least {SHORTEST_ROWS} rows, found {rows}"
        )
    segment = max(rows // 12, min(rows, SHORTEST_ROWS))
    freq_hz, psd = welch(detrend(experiment.y, axis=0), 1 / Ts_s, nperseg=segment, axis=0)
    width = max(len(freq_hz) // 32, 1)
    kernel = np.ones(width) / width
    limit = _MOST_OF_RATE[hold] / Ts_s
    for density in psd[1:, moves(experiment)].T:
        smooth = np.convolve(density, kernel, mode="same")
        inside = smooth[width : len(smooth) - width] if len(smooth) > 4 * width else smooth
        above = smooth > _ABOVE_NOISE * inside.min()
        last = len(above) if above.all() else max(int(np.argmin(above)), 1)
        limit = min(limit, float(freq_hz[1:][last - 1]))
    return max(limit, 4.0 / (rows * Ts_s))


def rises_above_noise(experiment: Experiment, sd: Array) -> NDArray[np.bool_]:
    """Return whether each output (n,) is ten times above its noise, of deviation sd (n,), at some
    frequency."""
    _, power, noise = _derivative_spectra(experiment, sd, 0)
    return np.asarray(np.any(power > _ABOVE_NOISE * noise, axis=0))


def moves(experiment: Experiment) -> NDArray[np.bool_]:
    """Return whether each output (n,) is not constant."""
    return np.asarray(np.ptp(experiment.y, axis=0) > 0.0)


def acceleration_limit(experiment: Experiment, sd: Array) -> float:
    """Return the frequency in Hz below which noise is 1 % of the power of every acceleration.

    sd (n,): white noise of the outputs. Noise in a regressor lowers its coefficient by this share.
    """
    return _derivative_limit(experiment, sd, 2, _NOISE_SHARE)


def quiet_velocity_limit(experiment: Experiment, sd: Array) -> float:
    """Return the frequency in Hz below which noise is 1 % of the RMS of every velocity.

    It is 0.4 of the rate at most.
    """
    limit_hz = _derivative_limit(experiment, sd, 1, _NOISE_SHARE_OF_VELOCITY)
    return min(limit_hz, _WIDEST / experiment.Ts_s)


def velocity_limit(experiment: Experiment, sd: Array) -> float:
    """Return the frequency in Hz up to which every velocity is worth its noise.

    Below it noise is 1 % of the RMS of the velocity, or what is added to the velocity is more than
    its noise: a velocity that lacks what is above is wrong by that. It is 0.4 of the rate at most.
    """
    found = max(_worth_its_noise(experiment, sd, 1), quiet_velocity_limit(experiment, sd))
    return min(found, _WIDEST / experiment.Ts_s)


def position_limit(experiment: Experiment, sd: Array) -> float:
    """Return the frequency in Hz up to which every position is worth its noise.

    What is added to the position is more than its noise. It is infinite from 0.4 of the rate on: no
    frequency is to be left out then.
    """
    limit_hz = _worth_its_noise(experiment, sd, 0)
    return limit_hz if limit_hz < _WIDEST / experiment.Ts_s else math.inf


def _worth_its_noise(experiment: Experiment, sd: Array, order: int) -> float:
    """Return the frequency in Hz up to which every derivative of an order is worth its noise.

    What is left out and the noise that is let in are least together, as by Wiener's filter.
    """
    freq_hz, power, noise = _derivative_spectra(experiment, sd, order)
    best = np.argmax(np.cumsum(power - 2.0 * noise, axis=0), axis=0)[moves(experiment)]
    return float(freq_hz[best.min(initial=len(freq_hz) - 1)])


def _derivative_limit(experiment: Experiment, sd: Array, order: int, share: float) -> float:
    """Return the frequency in Hz below which noise is a share of the power of a derivative."""
    freq_hz, power, noise = _derivative_spectra(experiment, sd, order)
    less = np.cumsum(noise, axis=0) <= share * np.cumsum(power, axis=0)
    good = np.all(less[:, moves(experiment)], axis=1)
    found = freq_hz[good][-1] if np.any(good) else 0.0
    return max(float(found), 4.0 / (len(experiment.y) * experiment.Ts_s))


def _derivative_spectra(
    experiment: Experiment, sd: Array, order: int
) -> tuple[Array, Array, Array]:
    """Return frequencies (F,), and the power of a derivative and of its noise (F, n)."""
    Ts_s, rows = experiment.Ts_s, len(experiment.y)
    segment = max(rows // 4, min(rows, SHORTEST_ROWS))
    freq_hz, psd = welch(detrend(experiment.y, axis=0), 1 / Ts_s, nperseg=segment, axis=0)
    squared = freq_hz[:, None] ** (2 * order)
    return freq_hz, squared * psd, squared * 2.0 * Ts_s * sd**2 * np.ones_like(psd)


def middle_limit(experiments: Sequence[Experiment], hold: Hold) -> float:
    """Return the upper limit in Hz of the middle band of several records."""
    highest = min(upper_limit(e, hold) for e in experiments)
    return highest / BAND_STEPS[len(BAND_STEPS) // 2]


def _spectrum(x: Array, before: int, length: int, Ts_s: float) -> tuple[Complex, Line]:
    """Return the spectrum of the record, extended at both ends, without a line, and the line.

    The extension is odd, as in scipy's filtfilt; without the line the ends join.
    """
    after = length - len(x) - before
    with np.errstate(invalid="ignore"):  # a law may be infinite along this motion
        return _extended_spectrum(x, before, after, length, Ts_s)


def _extended_spectrum(
    x: Array, before: int, after: int, length: int, Ts_s: float
) -> tuple[Complex, Line]:
    head = 2.0 * x[0] - x[before:0:-1]
    reflected = x[-2 : -min(after, len(x) - 1) - 2 : -1]
    tail = 2.0 * x[-1] - reflected
    whole = np.concatenate([head, x, tail])
    whole = np.concatenate([whole, np.broadcast_to(whole[-1], (length - len(whole), x.shape[1]))])
    value, slope = whole[0], (whole[-1] - whole[0]) / ((length - 1) * Ts_s)
    t = np.arange(length) * Ts_s
    return rfft(whole - value - slope * t[:, None], axis=0), Line(value, slope)
