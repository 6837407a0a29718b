"""Draw the measured pose during beam moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..plotting.min_max_envelope import envelope, plot_envelope
from ..plotting.panel_grid import entry, new_grid
from ..plotting.style import PAGE, LineStyle, Sheet, colour, drawing

Array = NDArray[np.float64]

_BINS = 900
_MEASURED = LineStyle(colour("blue"), width=1.1)
_REFERENCE = LineStyle(colour("ink"), (2.0, 2.0), width=0.9, zorder=4)


@dataclass(frozen=True)
class BeamRecord:
    """A record with a moving beam, arrays (N,); beam_ref_m is None without a reference."""

    t_s: Array
    beam_m: Array
    theta_rad: Array
    z_m: Array
    beam_ref_m: Array | None = None


def joined(parts: Sequence[BeamRecord]) -> BeamRecord:
    """Join the parts of one record, given in order of time."""
    references = [part.beam_ref_m for part in parts if part.beam_ref_m is not None]
    return BeamRecord(
        np.concatenate([part.t_s for part in parts]),
        np.concatenate([part.beam_m for part in parts]),
        np.concatenate([part.theta_rad for part in parts]),
        np.concatenate([part.z_m for part in parts]),
        np.concatenate(references) if len(references) == len(parts) else None,
    )


def beam_trajectory(record: BeamRecord, *, sheet: Sheet = PAGE) -> Figure:
    """Draw x_b(t), theta(t) and z(t) over a common time axis."""
    legend: list[Artist] = [entry("measured", _MEASURED)]
    if record.beam_ref_m is not None:
        legend.append(entry("reference", _REFERENCE))
    rows = (
        ("beam x_b", "mm", 1e3, record.beam_m),
        ("θ", "µrad", 1e6, record.theta_rad),
        ("z", "µm", 1e6, record.z_m),
    )
    with drawing(sheet):
        grid = new_grid((3, 1), sheet, 1.45, legend)
        for ax, (title, unit, factor, values) in zip(grid.axes[:, 0], rows, strict=True):
            plot_envelope(ax, envelope(record.t_s, values, _BINS), _MEASURED, factor)
            ax.set_title(title)
            ax.set_title(unit, loc="right", fontweight="normal")
            ax.margins(x=0)
            ax.tick_params(labelbottom=False, length=2.5)
        if record.beam_ref_m is not None:
            reference = envelope(record.t_s, record.beam_ref_m, _BINS)
            plot_envelope(grid.axes[0, 0], reference, _REFERENCE, 1e3)
        grid.axes[-1, 0].tick_params(labelbottom=True)
        grid.axes[-1, 0].set_xlabel("time [s]")
    return grid.figure
