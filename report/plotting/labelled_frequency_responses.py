"""Frequency responses with names and units, as drawn in figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from .style import DOTS, LineStyle

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class SignalLabels:
    """Names and SI units of a system's p inputs and m outputs, as in its log."""

    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]

    @property
    def output_symbols(self) -> tuple[str, ...]:
        """The outputs' names as symbols."""
        return tuple(symbol(name) for name in self.output_names)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of outputs m and inputs p."""
        return len(self.output_names), len(self.input_names)

    def path(self, i: int, j: int) -> str:
        """Return the label of the path from input j to output i, such as 'τψ → ψ'."""
        return f"{symbol(self.input_names[j])} → {symbol(self.output_names[i])}"

    def gain_unit(self, i: int, j: int) -> str:
        """Return the unit of the gain from input j to output i, such as 'rad/(N m)', or ''."""
        output, given = self.output_units[i] or "1", self.input_units[j]
        if given in ("", "1") or given == output:
            return "" if output in ("1", given) else output
        return f"{output}/({given})" if " " in given or "/" in given else f"{output}/{given}"


RIG_SIGNALS = SignalLabels(
    ("tau_psi", "tau_theta", "tau_z"),
    ("N m", "N m", "N"),
    ("psi", "theta", "z"),
    ("rad", "rad", "m"),
)


@dataclass(frozen=True)
class Curve:
    """A frequency response (F, m, p) at freq_hz (F,) with its label and line style.

    `deviation` (F, m, p), if given, is the standard deviation of the complex entries; CONFIDENCE
    times it is drawn as a band. The band of the phase uses `phase_deviation_rad` if given. A curve
    of DOTS is `doubtful`.
    """

    label: str
    line: LineStyle
    freq_hz: Array
    response: Complex
    deviation: Array | None = None
    phase_deviation_rad: Array | None = None

    @property
    def doubtful(self) -> bool:
        """Whether the curve has the line style of unreliable results."""
        return self.line.dashes == DOTS


@dataclass(frozen=True)
class Range:
    """Frequency range of a figure, and limits of the frequencies that are evaluated, in Hz.

    beyond: what a figure says of frequencies above `valid_to_hz`.
    """

    low_hz: float
    high_hz: float
    valid_to_hz: float | None = None
    valid_from_hz: float | None = None
    beyond: str = "not compared"

    @property
    def bottom_hz(self) -> float:
        """Lowest frequency that is evaluated."""
        return self.low_hz if self.valid_from_hz is None else max(self.valid_from_hz, self.low_hz)

    @property
    def top_hz(self) -> float:
        """Highest frequency that is evaluated."""
        return self.high_hz if self.valid_to_hz is None else min(self.valid_to_hz, self.high_hz)


_AROUND = 10.0
"""A figure shows a decade on both sides of the resonances."""
_DETERMINED = 0.02
"""Standard deviation over the response (0.17 dB) up to which a comparison tells something."""
_NEIGHBOURS, _GAP = 5, 3.0
"""Frequencies that are judged together, and ratio of two beyond which there is a gap."""


def shown_range(low_hz: float, high_hz: float, modes_hz: Sequence[float] = ()) -> Range:
    """Return a decade below and above the modes, within the data; the data without modes."""
    known = [f for f in modes_hz if np.isfinite(f) and f > 0]
    if not known:
        return Range(low_hz, high_hz)
    low, high = max(low_hz, min(known) / _AROUND), min(high_hz, _AROUND * max(known))
    return Range(low, high) if low < high else Range(low_hz, high_hz)


def determined(shown: Range, measured: Sequence[Curve], top_hz: float = np.inf) -> Range:
    """Return the range, evaluated where all measured responses are clear of their noise.

    That is from the first to the last frequency at which the diagonal is determined, without wide
    gaps between; all of the range if there is none. top_hz: a limit that is known.
    """
    low, high = shown.low_hz, min(shown.high_hz, top_hz)
    for curve in measured:
        f = curve.freq_hz
        part = (f >= shown.low_hz) & (f <= shown.high_hz)
        if curve.deviation is None or np.sum(part) < _NEIGHBOURS:
            continue
        own = np.arange(min(curve.response.shape[1:]))
        share = curve.deviation[:, own, own] / np.abs(curve.response[:, own, own])
        worst = median_filter(np.max(share[part], axis=1), _NEIGHBOURS, mode="nearest")
        clear = f[part][worst <= _DETERMINED]
        if len(clear):
            runs = np.split(clear, np.flatnonzero(clear[1:] > _GAP * clear[:-1]) + 1)
            longest = max(runs, key=lambda run: run[-1] / run[0])
            low, high = max(low, float(longest[0])), min(high, float(longest[-1]))
    if not low < high:
        return shown
    return replace(
        shown,
        valid_from_hz=low if low > shown.low_hz else None,
        valid_to_hz=high if high < shown.high_hz else None,
    )


_MOST_POINTS = 400
_PER_DECADE = 60

CONFIDENCE = 1.73
"""95 % of circular complex Gaussian errors are within sqrt(-ln 0.05) standard deviations."""

_SYMBOLS = {"psi": "ψ", "theta": "θ", "tau": "τ", "v": "v", "phi": "φ"}


def symbol(name: str) -> str:
    """Return a signal's name with Greek letters, such as τψ for tau_psi; other names unchanged."""
    parts = name.split("_")
    greek = any(_SYMBOLS.get(part, part) != part for part in parts)
    if greek and all(part in _SYMBOLS or len(part) == 1 for part in parts):
        return "".join(_SYMBOLS.get(part, part) for part in parts)
    return name


def inside(curve: Curve, shown: Range, most: int = _MOST_POINTS) -> Curve:
    """Return the part of a curve within the range, at `most` frequencies at most.

    If there are more, those nearest to a logarithmic grid are kept. With 400 over two decades the
    spacing is 1 %, finer than any resonance that is visible in a figure.
    """
    f = curve.freq_hz
    part = np.flatnonzero((f >= shown.low_hz) & (f <= shown.high_hz) & (f > 0))
    if part.size > most:
        wanted = np.geomspace(f[part[0]], f[part[-1]], most)
        middle = (f[part[1:]] + f[part[:-1]]) / 2
        part = part[np.unique(np.searchsorted(middle, wanted))]
    return Curve(
        curve.label,
        curve.line,
        curve.freq_hz[part],
        curve.response[part],
        *(
            None if errors is None else errors[part]
            for errors in (curve.deviation, curve.phase_deviation_rad)
        ),
    )


def pooled(freq_hz: Array, values: Array, shown: Range) -> tuple[Array, Array]:
    """Return frequencies and the RMS of values (K, ...) over 60 logarithmic bins per decade.

    Only bins within the range that contain a line are returned. More bins would not be visible.
    """
    order = np.argsort(freq_hz)
    order = order[(freq_hz[order] >= shown.low_hz) & (freq_hz[order] <= shown.high_hz)]
    f, x = freq_hz[order], values[order]
    if not f.size:
        return f, x
    number = np.rint(_PER_DECADE * np.log10(f / shown.low_hz))
    starts = np.flatnonzero(np.diff(number, prepend=-1.0))
    count = np.diff(np.append(starts, len(f)))
    power = np.add.reduceat(x**2, starts) / count.reshape(-1, *[1] * (x.ndim - 1))
    return np.add.reduceat(f, starts) / count, np.sqrt(power)


def decibels(response: Complex) -> Array:
    """Return 20 log10 |response|, NaN where it is zero or missing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        level = 20 * np.log10(np.abs(response))
    return np.where(np.isfinite(level), level, np.nan)


def ratio(estimate: Curve, reference: Curve) -> Complex:
    """Return estimate / reference (F, m, p) at the estimate's frequencies.

    If the reference has other frequencies, its log magnitude and unwrapped phase are interpolated;
    outside of its range the ratio is NaN.
    """
    if np.array_equal(estimate.freq_hz, reference.freq_hz):
        other = reference.response
    else:
        other = _interpolated(reference, estimate.freq_hz)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(estimate.response / other)


def _interpolated(curve: Curve, freq_hz: Array) -> Complex:
    usable = (curve.freq_hz > 0) & np.isfinite(curve.response).all(axis=(1, 2))
    f, H = np.log(curve.freq_hz[usable]), curve.response[usable]
    out = np.full((len(freq_hz), *curve.response.shape[1:]), np.nan, complex)
    if len(f) < 2:
        return out
    level, phase = np.log(np.abs(H)), np.unwrap(np.angle(H), axis=0)
    with np.errstate(divide="ignore"):
        x = np.log(freq_hz)
    for i in range(out.shape[1]):
        for j in range(out.shape[2]):
            real = np.interp(x, f, level[:, i, j], np.nan, np.nan)
            out[:, i, j] = np.exp(real + 1j * np.interp(x, f, phase[:, i, j], np.nan, np.nan))
    return out
