"""Draw noise and nonlinear distortion separately: with the plant's response, and of its outputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ...identification.nonparametric.robust_multisine import BestLinearApproximation
from ..plotting.labelled_frequency_responses import Curve, Range, SignalLabels, inside, pooled
from ..plotting.panel_grid import entry, name_panel, new_grid, plot_curve
from ..plotting.style import PAGE, LineStyle, Sheet, colour, drawing, log_ticks

Array = NDArray[np.float64]

PLANT = LineStyle(colour("blue"), width=1.4)
NOISE = LineStyle(colour("muted"), width=0.9, zorder=2.5)
_ROW_IN = 1.95
_DECADES_MOST = 7.0


@dataclass(frozen=True)
class Dots:
    """Marker style of levels at single lines; colour and shape both identify it."""

    colour: str
    marker: str
    size: float

    def keywords(self) -> dict[str, Any]:
        """Return the keywords of Axes.plot."""
        return {
            "color": self.colour,
            "marker": self.marker,
            "markersize": self.size,
            "markeredgewidth": 0.8,
            "linestyle": "none",
            "zorder": 3.0,
        }


EXCITED = Dots(colour("blue"), ".", 3.0)
ODD = Dots(colour("vermillion"), "+", 3.6)
EVEN = Dots(colour("green"), "x", 2.8)
ALL_ERRORS = Dots(colour("vermillion"), "+", 3.6)


@dataclass(frozen=True)
class Response:
    """|P| (F, m, p) at freq_hz (F,), and its standard deviations: from noise, and total."""

    freq_hz: Array
    magnitude: Array
    noise: Array
    all_errors: Array

    @classmethod
    def of(cls, bla: BestLinearApproximation) -> Response:
        """Return the values to draw of a best linear approximation."""
        return cls(bla.freq_hz, np.abs(bla.H), bla.noise_deviation, bla.standard_deviation)


@dataclass(frozen=True)
class Levels:
    """Levels (K, m) of the outputs at lines freq_hz (K,), rms in the outputs' units."""

    freq_hz: Array
    level: Array


@dataclass(frozen=True)
class OutputLevels:
    """Output spectra at excited, unexcited odd and unexcited even lines, and noise."""

    excited: Levels
    odd: Levels
    even: Levels
    noise: Levels

    @classmethod
    def of(cls, bla: BestLinearApproximation) -> OutputLevels:
        """Return the values to draw of a best linear approximation."""
        parts = (
            (bla.freq_hz, bla.noise_level),
            (bla.odd.freq_hz, bla.odd.noise),
            (bla.even.freq_hz, bla.even.noise),
        )
        return cls(
            Levels(bla.freq_hz, bla.output_level),
            Levels(bla.odd.freq_hz, bla.odd.level),
            Levels(bla.even.freq_hz, bla.even.level),
            Levels(*(np.concatenate(x) for x in zip(*parts, strict=True))),
        )


def response_with_distortion(
    response: Response, signals: SignalLabels, *, shown: Range, sheet: Sheet = PAGE
) -> Figure:
    """Draw |P| in m x p panels with the standard deviations of its estimate.

    The grey line is the deviation from noise, the crosses that from noise and distortion: where
    they differ, the plant is nonlinear at this amplitude. More than 60 lines per decade are pooled
    by their RMS.
    """
    plant = inside(Curve("", PLANT, response.freq_hz, response.magnitude.astype(complex)), shown)
    pooled_hz, noise = pooled(response.freq_hz, response.noise, shown)
    _, all_errors = pooled(response.freq_hz, response.all_errors, shown)
    with drawing(sheet):
        legend = [
            entry("best linear approximation", PLANT),
            _legend_of("standard deviation, noise and distortion", ALL_ERRORS),
            entry("noise alone", NOISE),
        ]
        grid = new_grid(signals.shape, sheet, _ROW_IN, legend)
        for (i, j), ax in grid.panels():
            name_panel(ax, signals.path(i, j), signals.gain_unit(i, j))
            magnitude = plant.response[:, i, j].real
            plot_curve(ax, plant, _positive(magnitude))
            ax.plot(pooled_hz, _positive(noise[:, i, j]), **NOISE.keywords())
            ax.plot(pooled_hz, _positive(all_errors[:, i, j]), **ALL_ERRORS.keywords())
            drawn = np.concatenate([magnitude, noise[:, i, j], all_errors[:, i, j]])
            _scale(ax, drawn)
        grid.finish_frequency(shown)
    return grid.figure


def detection_levels(
    levels: OutputLevels, signals: SignalLabels, *, shown: Range, sheet: Sheet = PAGE
) -> Figure:
    """Draw every output's spectrum at excited, unexcited odd and unexcited even lines.

    A linear plant responds at excited lines only; the other lines have noise. An odd nonlinearity
    (a hardening spring) shows at odd lines, an even one (an asymmetry) at even lines. More than 60
    lines per decade are pooled by their RMS.
    """
    parts = [
        (label, pooled(part.freq_hz, part.level, shown), dots)
        for label, part, dots in (
            ("excited lines", levels.excited, EXCITED),
            ("odd lines left out", levels.odd, ODD),
            ("even lines left out", levels.even, EVEN),
        )
    ]
    noise_hz, floor = pooled(levels.noise.freq_hz, levels.noise.level, shown)
    with drawing(sheet):
        legend: list[Artist] = [_legend_of(label, dots) for label, _, dots in parts]
        legend.append(entry("noise", NOISE))
        grid = new_grid((1, len(signals.output_names)), sheet, 2.5, legend)
        for (_, i), ax in grid.panels():
            ax.set_title(signals.output_symbols[i])
            unit = signals.output_units[i]
            ax.set_title(
                f"{unit} rms" if unit not in ("", "1") else "rms", loc="right", fontweight="normal"
            )
            for _, (freq_hz, level), dots in parts:
                ax.plot(freq_hz, _positive(level[:, i]), **dots.keywords())
            ax.plot(noise_hz, _positive(floor[:, i]), **NOISE.keywords())
            drawn = [floor[:, i], *(level[:, i] for _, (_, level), _ in parts)]
            _scale(ax, np.concatenate(drawn))
        grid.finish_frequency(shown)
    return grid.figure


def _scale(ax: Axes, drawn: Array) -> None:
    """Scale the vertical axis to the values."""
    values = drawn[np.isfinite(drawn) & (drawn > 0)]
    top = float(values.max()) if values.size else 1.0
    bottom = float(values.min()) if values.size else 0.1
    log_ticks(ax, "y", (max(bottom / 2, top / 10**_DECADES_MOST), 2 * top))


def _legend_of(label: str, dots: Dots) -> Line2D:
    return Line2D([], [], label=label, **dots.keywords())


def _positive(values: Array) -> Array:
    return np.where(np.isfinite(values) & (values > 0), values, np.nan)
