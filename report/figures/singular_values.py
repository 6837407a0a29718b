"""Draw singular values of the Hankel matrix and the chosen order: the paper's Fig. 9."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from ..plotting.panel_grid import new_grid
from ..plotting.style import PAGE, LineStyle, Sheet, colour, drawing, log_ticks

Array = NDArray[np.float64]

SHOWN = 20


@dataclass(frozen=True)
class SingularValues:
    """Singular values (k,) of one beam position, descending, with label and line style.

    noise_level: the largest that noise alone has, nan if unknown.
    """

    label: str
    line: LineStyle
    values: Array
    noise_level: float = float("nan")

    @property
    def significant(self) -> int:
        """The number of singular values above the level of noise."""
        return int(np.sum(self.values > self.noise_level))


@dataclass(frozen=True)
class Spectrum:
    """Singular values of every beam position by one estimator, and the order chosen from them.

    The order is None if it was chosen by another criterion.
    """

    title: str
    positions: tuple[SingularValues, ...]
    order: int | None


def singular_values(spectra: Sequence[Spectrum], *, sheet: Sheet = PAGE) -> Figure:
    """Draw one panel per estimator on a common scale; mark the order and the noise."""
    everything = [s.values[:SHOWN] for spectrum in spectra for s in spectrum.positions]
    finite = np.concatenate([v[np.isfinite(v) & (v > 0)] for v in everything] or [np.ones(1)])
    top = finite.max(initial=1e-12)
    # For exact data the values after the order are rounding errors and need not be visible.
    limits = (max(finite.min(initial=top), 1e-7 * top) / 2.5, top * 2.5)
    first = spectra[0].positions if spectra else ()
    with drawing(sheet):
        legend: list[Artist] = [
            Line2D([], [], label=s.label, **_markers(k, s.line)) for k, s in enumerate(first)
        ]
        if len(legend) == 1 and len(spectra) == 1:
            legend = []
        grid = new_grid((1, max(len(spectra), 1)), sheet, 2.7, legend)
        for (_, column), ax in grid.panels():
            log_ticks(ax, "y", limits, every=1 if limits[1] / limits[0] < 1e6 else None)
            ax.set_xlim(0, SHOWN + 1)
            ax.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=10))
            ax.set_xlabel("number n of the singular value")
            if column < len(spectra):
                _draw(ax, spectra[column])
        grid.axes[0, 0].set_ylabel("σₙ (scaled)")
    return grid.figure


def _draw(ax: Axes, spectrum: Spectrum) -> None:
    ax.set_title(spectrum.title)
    for k, position in enumerate(spectrum.positions):
        values = np.where(position.values > 0, position.values, np.nan)[:SHOWN]
        ax.plot(np.arange(1, len(values) + 1), values, **_markers(k, position.line))
        if np.isfinite(position.noise_level):
            ax.axhline(position.noise_level, color=position.line.colour, lw=0.8, ls="--")
    if spectrum.order is None:
        return
    ax.axvline(spectrum.order + 0.5, color=colour("ink"), linewidth=0.8, linestyle=(0, (2, 2)))
    ax.annotate(
        f"{spectrum.order} states",
        (spectrum.order + 0.5, 1.0),
        xytext=(6, -2),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        va="top",
    )


def _markers(index: int, line: LineStyle) -> dict[str, Any]:
    return {
        "color": line.colour,
        "marker": "osD^vP"[index % 6],
        "markersize": 4.5,
        "markerfacecolor": line.colour if index == 0 else colour("paper"),
        "markeredgewidth": 1.1,
        "linewidth": 0.6,
        "alpha": 0.9,
    }
