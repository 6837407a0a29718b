"""Draw signals of records over time: a panel for each signal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from ..report.plotting.min_max_envelope import envelope, plot_envelope
from ..report.plotting.panel_grid import entry, new_grid
from ..report.plotting.style import PAGE, drawing, engineering, line_of
from .notebook_figure import shown

if TYPE_CHECKING:
    from .record import Record
    from .signal_table import SignalInfo, SignalTable

_BINS = 1200
_PANEL_IN = 1.45
_MOST_ENTRIES = 8
_ROLES = ("input", "output", "excitation", "scheduling")


def flight_plot(logs: Sequence[Path]) -> Figure:
    """Draw a flight over time: states, pose, beam, forces, excitation."""
    from ..report.session.flight_data import read_session
    from ..report.session.time_plot import session_plot

    return shown(session_plot(read_session(logs)))


def signal_plot(records: Sequence[Record], columns: Iterable[str] | None) -> Figure:
    """Draw signals over time, a panel for each; default: inputs, outputs, excitation.

    All values of a signal share its panel. Records that overlap in time have their own lines.
    """
    signals = _drawn(records[0], columns)
    overlap = _overlap(records)
    values = max((s.length or 1 for s in signals), default=1)
    by_record = len(records) > 1 and overlap
    legend = []
    if by_record and len(records) <= _MOST_ENTRIES:
        legend = [entry(r.name, line_of(k)) for k, r in enumerate(records)]
    elif not by_record and 1 < values <= _MOST_ENTRIES + 1:
        legend = [entry(str(k), line_of(k)) for k in range(values)]
    with drawing(PAGE):
        grid = new_grid((len(signals), 1), PAGE, _PANEL_IN, legend)
        for signal, ax in zip(signals, grid.axes[:, 0], strict=True):
            factor, prefix = engineering(_largest(records, signal), signal.unit)
            for number, record in enumerate(records):
                for k, column in enumerate(signal.columns):
                    line = line_of(number if by_record else k)
                    drawn = envelope(record.time_s, record[column], _BINS)
                    plot_envelope(ax, drawn, line, factor)
            ax.set_title(signal.name)
            unit = "" if signal.unit == "1" else prefix + signal.unit
            ax.set_title(unit, loc="right", fontweight="normal")
            ax.margins(x=0)
            ax.tick_params(labelbottom=signal is signals[-1], length=2.5)
        grid.axes[-1, 0].set_xlabel("time [s]")
    return shown(grid.figure)


def _drawn(record: Record, columns: Iterable[str] | None) -> list[SignalInfo]:
    if columns is not None:
        return list(record.selected(columns))
    table: SignalTable = record.signals
    chosen = [s for role in _ROLES for s in table.with_role(role)]
    return chosen or [s for s in table if s.name not in ("cycle", "time_s")]


def _largest(records: Sequence[Record], signal: SignalInfo) -> float:
    values = [np.abs(r[c].astype(float)) for r in records for c in signal.columns]
    return max(float(np.nanmax(v[np.isfinite(v)], initial=0.0)) for v in values)


def _overlap(records: Sequence[Record]) -> bool:
    spans = sorted((r.time_s[0], r.time_s[-1]) for r in records if len(r))
    return any(later[0] <= earlier[1] for earlier, later in pairwise(spans))
