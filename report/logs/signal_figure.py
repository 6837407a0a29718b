"""Draw signals of logs over time, or their spectra, in the style of the reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...config.files.atomic_write import atomic_file, write_file
from ...log.errors import LogError
from ..plotting.figure_to_svg import escape_texts, svg_of
from ..plotting.min_max_envelope import plot_envelope
from ..plotting.panel_grid import entry, new_grid
from ..plotting.style import (
    PAGE,
    LineStyle,
    Sheet,
    drawing,
    engineering,
    frequency_axis,
    line_of,
    log_ticks,
)
from .signal_data import Signal, SignalOverTime, SignalSpectrum

FORMATS = (".svg", ".png", ".pdf")
_ROW_IN = 1.5
_MOST_PANELS, _MOST_LINES, _MOST_LOGS = 24, 4, 12
_DPI = 150
_DECADES_MOST = 8.0
_T = TypeVar("_T")


def time_figure(signals: Sequence[SignalOverTime], *, sheet: Sheet = PAGE) -> Figure:
    """Draw signals over time: a panel for each array and each group of a unit.

    Long signals are bands from minimum to maximum, so that no peak is lost. Units have a prefix.

    Raises:
        LogError: there are too many panels.
    """
    return _over_time(_panels(signals, lambda s: s.signal), (), "time [s]", sheet)


def time_figure_of_logs(
    logs: Mapping[str, Sequence[SignalOverTime]], *, sheet: Sheet = PAGE
) -> Figure:
    """Draw the same signals of several logs, by name, each over the time since it began.

    Each signal has a panel with a line for each log.

    Raises:
        LogError: there are too many panels or logs.
    """
    begun = {name: _since_begin(signals) for name, signals in logs.items()}
    panels = _panels_of_logs(begun, lambda s: s.signal)
    return _over_time(panels, list(logs), "time since the log began [s]", sheet)


def spectrum_figure(spectra: Sequence[SignalSpectrum], *, sheet: Sheet = PAGE) -> Figure:
    """Draw amplitude spectral densities, in unit/√Hz; raises LogError for too many panels."""
    return _spectra(_panels(spectra, lambda s: s.signal), (), sheet)


def spectrum_figure_of_logs(
    logs: Mapping[str, Sequence[SignalSpectrum]], *, sheet: Sheet = PAGE
) -> Figure:
    """Draw the densities of the same signals of several logs, by name, in a panel for each signal.

    Raises:
        LogError: there are too many panels or logs.
    """
    return _spectra(_panels_of_logs(logs, lambda s: s.signal), list(logs), sheet)


def _over_time(
    panels: Sequence[Sequence[SignalOverTime]], logs: Sequence[str], axis: str, sheet: Sheet
) -> Figure:
    with drawing(sheet):
        grid = new_grid((len(panels), 1), sheet, _ROW_IN, _legend(logs))
        for panel, ax in zip(panels, grid.axes[:, 0], strict=True):
            largest = max(_largest(s.values.low, s.values.high) for s in panel)
            factor, prefix = engineering(largest, panel[0].signal.unit)
            lines = [line_of(k) for k in range(len(panel))]
            # Draw the wider band first so that it does not cover the other.
            order = sorted(range(len(panel)), key=lambda k: -_extent(panel[k]))
            for k in order:
                plot_envelope(ax, panel[k].values, lines[k], factor)
            shown = [s.signal for s in panel[: 1 if logs else None]]
            _label(ax, shown, lines, _unit(prefix, panel[0].signal.unit))
            ax.tick_params(labelbottom=panel is panels[-1], length=2.5)
        grid.axes[-1, 0].set_xlabel(axis)
        times = [t for p in panels for s in p for t in (s.values.t[:1], s.values.t[-1:])]
        low, high = np.concatenate(times).min(), np.concatenate(times).max()
        grid.axes[-1, 0].set_xlim(low, max(high, low + 1e-9))
    return grid.figure


def _spectra(
    panels: Sequence[Sequence[SignalSpectrum]], logs: Sequence[str], sheet: Sheet
) -> Figure:
    with drawing(sheet):
        grid = new_grid((len(panels), 1), sheet, 1.2 * _ROW_IN, _legend(logs))
        for panel, ax in zip(panels, grid.axes[:, 0], strict=True):
            lines = [line_of(k) for k in range(len(panel))]
            values = np.concatenate([s.density for s in panel])
            values = values[values > 0]
            if values.size:
                top = values.max() * 2
                bottom = max(float(np.percentile(values, 0.5)) / 2, top / 10**_DECADES_MOST)
                log_ticks(ax, "y", (bottom, top))
            ends = [(float(s.freq_hz[0]), float(s.freq_hz[-1])) for s in panel]
            frequency_axis(ax, (min(e[0] for e in ends), max(e[1] for e in ends)))
            for s, line in zip(panel, lines, strict=True):
                ax.plot(s.freq_hz, np.where(s.density > 0, s.density, np.nan), **line.keywords())
            unit = panel[0].signal.unit
            unit = "" if unit in ("", "1") else f"({unit})" if " " in unit or "/" in unit else unit
            shown = [s.signal for s in panel[: 1 if logs else None]]
            _label(ax, shown, lines, f"{unit or '1'}/√Hz")
            ax.tick_params(labelbottom=panel is panels[-1], length=2.5)
        grid.axes[-1, 0].set_xlabel("frequency [Hz]")
    return grid.figure


def save_figure(figure: Figure, path: Path, *, sheet: Sheet = PAGE) -> None:
    """Write a figure as SVG, PNG or PDF by the path's suffix.

    Raises:
        LogError: another suffix. OSError: the file cannot be written.
    """
    check_format(path)
    suffix = path.suffix.lower()
    if suffix == ".svg":
        write_file(path, svg_of(figure, sheet))
        return
    with atomic_file(path) as file, drawing(sheet):
        escape_texts(figure)
        figure.savefig(file, format=suffix[1:], dpi=_DPI, facecolor="white")


def check_format(path: Path) -> None:
    """Raise LogError unless the path's suffix is that of a figure."""
    if path.suffix.lower() not in FORMATS:
        raise LogError(
            f"{path}: expected a file name that ends with .svg, .png or .pdf, found "
            f"'{path.suffix or path.name}'"
        )


def _panels(items: Sequence[_T], signal_of: Callable[[_T], Signal]) -> list[list[_T]]:
    """Group elements of an array, and up to four neighbours of one group and unit, in a panel."""
    panels: list[list[_T]] = []
    for item in items:
        signal = signal_of(item)
        before = signal_of(panels[-1][-1]) if panels else None
        is_element = signal.name != signal.field
        if before is not None and before.unit == signal.unit:
            same_array = is_element and before.field == signal.field
            scalars = (
                not is_element
                and before.name == before.field
                and before.group == signal.group != ""
            )
            if same_array or (scalars and len(panels[-1]) < _MOST_LINES):
                panels[-1].append(item)
                continue
        panels.append([item])
    return _few(panels)


def _panels_of_logs(
    logs: Mapping[str, Sequence[_T]], signal_of: Callable[[_T], Signal]
) -> list[list[_T]]:
    """Group the signals of logs by signal; raise LogError if they are not the same ones."""
    if len(logs) > _MOST_LOGS:
        raise LogError(f"expected at most {_MOST_LOGS} logs in a figure, found {len(logs)}")
    names = {name: [signal_of(s).name for s in signals] for name, signals in logs.items()}
    first = next(iter(names))
    for name, own in names.items():
        if own != names[first]:
            other = ", ".join(sorted(set(own) ^ set(names[first])))
            raise LogError(
                f"expected the same signals in all logs; only one of {first} and {name} has {other}"
            )
    return _few([list(same) for same in zip(*logs.values(), strict=True)])


def _few(panels: list[list[_T]]) -> list[list[_T]]:
    if len(panels) > _MOST_PANELS:
        raise LogError(
            f"expected signals for at most {_MOST_PANELS} panels, found {len(panels)}: name fewer"
        )
    return panels


def _since_begin(signals: Sequence[SignalOverTime]) -> list[SignalOverTime]:
    begin_s = min((float(s.values.t[0]) for s in signals if len(s.values.t)), default=0.0)
    return [
        replace(s, values=replace(s.values, t=s.values.t - begin_s, samples=())) for s in signals
    ]


def _legend(logs: Sequence[str]) -> list[Artist]:
    return [entry(name, line_of(k)) for k, name in enumerate(logs)]


def _label(ax: Axes, signals: Sequence[Signal], lines: Sequence[LineStyle], unit: str) -> None:
    array = len(signals) > 1 and signals[0].name != signals[0].field
    ax.set_title(signals[0].field if array else "" if len(signals) > 1 else signals[0].name)
    ax.set_title(unit, loc="right", fontweight="normal")
    if len(signals) == 1:
        return
    prefix = f"{signals[0].field}_" if array else ""
    handles = [
        entry(signal.name.removeprefix(prefix), line)
        for signal, line in zip(signals, lines, strict=True)
    ]
    ax.legend(
        handles=handles,
        loc="lower left" if not array else "lower center",
        bbox_to_anchor=(0.0 if not array else 0.5, 1.0),
        ncols=len(handles),
        borderaxespad=0.15,
        handlelength=1.6,
        columnspacing=1.0,
    )


def _unit(prefix: str, unit: str) -> str:
    return "" if unit in ("", "1") else f"{prefix}{unit}"


def _largest(*values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    known = np.concatenate([np.abs(v[np.isfinite(v)]) for v in values])
    return float(known.max(initial=0.0))


def _extent(signal: SignalOverTime) -> float:
    return float(np.nansum(signal.values.high - signal.values.low))
