"""Draw ratios of frequency responses on the diagonal in dB and degrees, with error bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..plotting.labelled_frequency_responses import (
    Curve,
    Range,
    SignalLabels,
    decibels,
    inside,
)
from ..plotting.panel_grid import entry, new_grid, plot_curve
from ..plotting.style import BOUND, PAGE, Sheet, colour, drawing

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Bounds:
    """Bounds of errors on the diagonal within a frequency range."""

    decibel: float
    degree: float


_FAR = 0.1
"""Errors below this share of the bounds are drawn on their own scale."""

AGREEMENT = Bounds(2.0, 15.0)
"""Bounds of both methods' errors against the simulated truth up to 64 Hz."""
ACCURACY = Bounds(0.5, 3.0)
"""Bounds for a fitted model, and for periodic records, which have no leakage."""


@dataclass(frozen=True)
class Worst:
    """Largest errors of one path over a range in dB and degrees, and their frequencies."""

    decibel: float
    degree: float
    decibel_at_hz: float
    degree_at_hz: float

    def within(self, bounds: Bounds) -> bool:
        """Return whether both errors are within the bounds; NaN is not."""
        return self.decibel <= bounds.decibel and self.degree <= bounds.degree


def worst_on_diagonal(curve: Curve, shown: Range) -> tuple[Worst, ...]:
    """Return the largest error of each diagonal path of a ratio within the valid range.

    It is NaN if the ratio is missing at all frequencies.
    """
    part = (curve.freq_hz >= shown.bottom_hz) & (curve.freq_hz <= shown.top_hz)
    out = []
    for i in range(min(curve.response.shape[1:])):
        f, H = curve.freq_hz[part], curve.response[part, i, i]
        level, phase = np.abs(decibels(H)), np.abs(np.degrees(np.angle(H)))
        known = np.isfinite(level)
        if not known.any():
            out.append(Worst(np.nan, np.nan, np.nan, np.nan))
            continue
        f, level, phase = f[known], level[known], phase[known]
        a, b = int(np.argmax(level)), int(np.argmax(phase))
        out.append(Worst(float(level[a]), float(phase[b]), float(f[a]), float(f[b])))
    return tuple(out)


def largest(ratios: Sequence[Curve], shown: Range) -> tuple[float, float]:
    """Return the largest error in dB, and in degrees, on the diagonals of all ratios."""
    worst = [w for curve in ratios for w in worst_on_diagonal(curve, shown)]
    # np.max propagates NaN: an unknown error must not count as a small one.
    return float(np.max([w.decibel for w in worst])), float(np.max([w.degree for w in worst]))


def error_text(error: tuple[float, float], joint: str = " and ") -> str:
    """Return an error in dB and degrees as text, small ones with one digit."""
    decibel, degree = (
        f"{x:.{digits}f}" if not x < 10.0**-digits else f"{x:.1g}"
        for x, digits in zip(error, (2, 1), strict=True)
    )
    return f"{decibel} dB{joint}{degree}°"


def bounds_text(ratios: Sequence[Curve], bounds: Bounds, shown: Range) -> str:
    """Return a caption sentence about the bounds in the figure of these ratios."""
    values = f"{bounds.decibel:g} dB and {bounds.degree:g}°"
    if _far_within(ratios, bounds, shown):
        return f"the bounds, {values}, lie far outside of the panels"
    return f"the dotted lines are at {values}"


def _far_within(ratios: Sequence[Curve], bounds: Bounds, shown: Range) -> bool:
    worst = [w for curve in ratios for w in worst_on_diagonal(curve, shown)]
    return bool(worst) and all(
        w.decibel < _FAR * bounds.decibel and w.degree < _FAR * bounds.degree for w in worst
    )


def deviation(
    ratios: Sequence[Curve],
    signals: SignalLabels,
    *,
    bounds: Bounds = AGREEMENT,
    shown: Range,
    sheet: Sheet = PAGE,
) -> Figure:
    """Draw ratios estimate / reference: dB in the upper row, degrees in the lower, a column a DOF.

    The curves' responses are the ratios. The axes extend to slightly beyond the bounds, or to the
    errors within the valid range, up to four times the bounds. Errors far below the bounds have
    their own scale without the bounds.
    """
    columns = min(signals.shape)
    drawn = [inside(curve, shown) for curve in ratios]
    with drawing(sheet):
        legend: list[Artist] = [entry(c.label, c.line) for c in ratios]
        near = not _far_within(ratios, bounds, shown)
        if near:
            legend.append(entry(f"±{bounds.decibel:g} dB, ±{bounds.degree:g}°", BOUND))
        grid = new_grid((2, columns), sheet, 1.7, legend)
        worst = [w for c in ratios for w in worst_on_diagonal(c, shown)]
        for (row, j), ax in grid.panels():
            bound = (bounds.decibel, bounds.degree)[row]
            errors = [(w.decibel, w.degree)[row] for w in worst]
            largest_error = max((e for e in errors if np.isfinite(e)), default=0.0)
            reach = min(max(1.3 * bound, 1.15 * largest_error), 4 * bound)
            if not near:
                reach = max(1.3 * largest_error, 1e-6 * bound)
            ax.set_ylim(-reach, reach)
            ax.axhline(0, color=colour("edge"), linewidth=0.8, zorder=1)
            if near:
                _draw_bound(ax, bound, shown)
            for curve in drawn:
                H = curve.response[:, j, j]
                values = decibels(H) if row == 0 else np.degrees(np.angle(H))
                plot_curve(ax, curve, values)
            ax.set_title(signals.path(j, j))
            ax.set_title(("dB", "degrees")[row], loc="right", fontweight="normal")
        grid.finish_frequency(shown, drawn)
    return grid.figure


def _draw_bound(ax: Axes, bound: float, shown: Range) -> None:
    for sign in (-1, 1):
        ax.plot([shown.bottom_hz, shown.top_hz], [sign * bound] * 2, **BOUND.keywords())
