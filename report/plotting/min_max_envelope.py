"""Reduce long signals to minimum-maximum envelopes, which keep every peak in a small SVG."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from .min_max_bins import Samples, attach, min_max_bins
from .style import LineStyle

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Envelope:
    """Minimum and maximum of a signal in bins: t, low, high (B,); NaN where it is missing.

    `samples` is the same signal in full, or in finer bins, for interactive charts.
    """

    t: Array
    low: Array
    high: Array
    samples: Samples = field(default=(), repr=False)

    @property
    def is_line(self) -> bool:
        """Whether the bins hold one sample each."""
        return bool(np.array_equal(self.low, self.high, equal_nan=True))


def envelope(
    t: NDArray[np.floating],
    x: NDArray[np.floating],
    bins: int,
    *,
    most: int | None = None,
    keep: Sequence[tuple[int, int]] = (),
) -> Envelope:
    """Return minimum and maximum of x (n,), or of all columns of (n, k), in bins of equal count.

    NaN and infinite samples are ignored; a bin without other samples is NaN. A signal of up to
    `bins` samples is returned unchanged. `most` and `keep` are those of min_max_bins.
    """
    x = np.where(np.isfinite(x), x, np.nan)
    low, high = (np.fmin.reduce(x, 1), np.fmax.reduce(x, 1)) if x.ndim > 1 else (x, x)
    n = len(low)
    samples = min_max_bins(t, low, high, most=most, keep=keep)
    if n <= bins:
        return Envelope(
            np.asarray(t, float), np.asarray(low, float), np.asarray(high, float), samples
        )
    starts = np.linspace(0, n, bins, endpoint=False).astype(int)
    return Envelope(
        np.asarray(t[starts], float),
        np.asarray(np.fmin.reduceat(low, starts), float),
        np.asarray(np.fmax.reduceat(high, starts), float),
        samples,
    )


def over_time(parts: Sequence[Envelope], bins: int) -> Envelope:
    """Join envelopes that follow one another, in `bins` bins of equal time.

    A bin has the minimum and maximum of all its samples. A NaN interrupts the band where time is
    missing between two parts.
    """
    parts = [part for part in parts if len(part.t)]
    if not parts:
        return Envelope(np.zeros(0), np.zeros(0), np.zeros(0))
    t, low, high = (np.concatenate([getattr(p, a) for p in parts]) for a in ("t", "low", "high"))
    width = (t[-1] - t[0]) / bins
    if len(t) > bins and width > 0:
        number = np.floor((t - t[0]) / width)
        starts = np.concatenate([[0], np.flatnonzero(np.diff(number) > 0) + 1])
        low, high = np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)
        t = t[starts]
    # Parts have different bin widths: time is missing if the distance exceeds the widest bin.
    steps = [float(np.median(np.diff(p.t))) for p in parts if len(p.t) > 1]
    breaks = np.flatnonzero(np.diff(t) > 3 * max([width, *steps])) + 1
    nothing = np.full(len(breaks), np.nan)
    return Envelope(
        np.insert(t, breaks, t[breaks - 1]),
        np.insert(low, breaks, nothing),
        np.insert(high, breaks, nothing),
        tuple(run for part in parts for run in part.samples),
    )


def plot_envelope(
    ax: Axes, signal: Envelope, line: LineStyle, scale: float = 1.0, label: str = ""
) -> None:
    """Draw an envelope: as a line if bins hold single samples, else as a band with thin edges."""
    samples = tuple(run.scaled(scale) for run in signal.samples)
    if signal.is_line:
        [drawn] = ax.plot(signal.t, scale * signal.low, label=label, **line.keywords())
        if samples:
            attach(drawn, samples)
        return
    band = ax.fill_between(
        signal.t,
        scale * signal.low,
        scale * signal.high,
        facecolor=line.colour,
        edgecolor=line.colour,
        linewidth=0.5,
        alpha=line.alpha,
        zorder=line.zorder,
        label=label,
    )
    if samples:
        attach(band, samples)
