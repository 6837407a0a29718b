"""Draw Markov parameters (the impulse response of G from v to y) of each estimator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..plotting.labelled_frequency_responses import SignalLabels
from ..plotting.min_max_envelope import envelope, plot_envelope
from ..plotting.panel_grid import entry, new_grid
from ..plotting.style import PAGE, LineStyle, Sheet, colour, drawing, engineering

Array = NDArray[np.float64]

_BINS = 400


@dataclass(frozen=True)
class Markov:
    """Markov parameters g (L, m, p) at steps of Ts_s, with label and line style."""

    label: str
    line: LineStyle
    g: Array
    Ts_s: float


def markov_parameters(
    estimates: Sequence[Markov], signals: SignalLabels, *, sheet: Sheet = PAGE
) -> Figure:
    """Draw g of every path over time, the first estimate behind the others.

    In a square system panel (i, j) is scaled to sqrt(|g_ii| |g_jj|), so that couplings and noise
    appear in proportion.
    """
    m, p = signals.shape
    reach = _reach(estimates, (m, p))
    with drawing(sheet):
        grid = new_grid((m, p), sheet, 1.45, [entry(e.label, e.line) for e in estimates])
        for (i, j), ax in grid.panels():
            factor, prefix = engineering(reach[i, j], signals.gain_unit(i, j))
            for estimate in estimates:
                t = np.arange(len(estimate.g)) * estimate.Ts_s
                signal = envelope(t, estimate.g[:, i, j], _BINS)
                plot_envelope(ax, signal, estimate.line, factor)
            ax.axhline(0, color=colour("edge"), linewidth=0.8, zorder=1)
            ax.margins(x=0)
            ax.tick_params(labelbottom=i == m - 1, length=2.5)
            ax.set_title(signals.path(i, j))
            ax.set_title(prefix + signals.gain_unit(i, j), loc="right", fontweight="normal")
            ax.set_ylim(-factor * reach[i, j], factor * reach[i, j])
            if i == m - 1:
                ax.set_xlabel("time [s]")
    return grid.figure


def _reach(estimates: Sequence[Markov], shape: tuple[int, int]) -> Array:
    reach = np.zeros(shape)
    for estimate in estimates:
        sizes = np.where(np.isfinite(estimate.g), np.abs(estimate.g), 0.0)
        reach = np.maximum(reach, sizes.max(axis=0, initial=0.0))
    if shape[0] == shape[1]:
        diagonal = np.sqrt(np.diag(reach))
        reach = np.maximum(np.outer(diagonal, diagonal), 0.0)
    return np.where(reach > 0, 1.1 * reach, 1.0)
