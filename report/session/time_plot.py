"""Draw a whole session over time: states, pose, beam, coil forces, excitation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ...daemon.control.states import State
from ..plotting.min_max_envelope import Envelope, plot_envelope
from ..plotting.panel_grid import Grid, entry, new_grid
from ..plotting.style import DOF, PAGE, LineStyle, Sheet, colour, drawing
from .flight_data import Session, Span

_STATE_COLOURS = {
    State.OFF: "edge",
    State.IDLE: "edge",
    State.LEVITATING: "truth",
    State.EXCITING: "blue",
    State.MOVING: "green",
    State.LANDING: "muted",
    State.FAULT: "vermillion",
    State.SELF_TEST: "edge",
}
_WORKING = (State.EXCITING, State.MOVING)


@dataclass(frozen=True)
class _Trace:
    field: str
    label: str
    line: LineStyle


@dataclass(frozen=True)
class _Panel:
    title: str
    unit: str
    factor: float
    traces: tuple[_Trace, ...]


_PANELS = (
    _Panel(
        "tilt",
        "µrad",
        1e6,
        (_Trace("psi_rad", "ψ", DOF["psi"]), _Trace("theta_rad", "θ", DOF["theta"])),
    ),
    _Panel("height z", "µm", 1e6, (_Trace("z_m", "z", DOF["z"]),)),
    _Panel("beam x_b", "mm", 1e3, (_Trace("beam_m", "x_b", LineStyle(colour("ink"))),)),
    _Panel(
        "coil forces, all coils", "N", 1.0, (_Trace("coil_n", "coils", LineStyle(colour("muted"))),)
    ),
    _Panel(
        "excitation torque",
        "N m",
        1.0,
        (_Trace("v_psi_n_m", "v ψ", DOF["psi"]), _Trace("v_theta_n_m", "v θ", DOF["theta"])),
    ),
    _Panel("excitation force", "N", 1.0, (_Trace("v_z_n", "v z", DOF["z"]),)),
    _Panel(
        "coil excitation, all coils",
        "N",
        1.0,
        (_Trace("coil_excitation_n", "coils", LineStyle(colour("muted"))),),
    ),
)


def session_plot(session: Session, *, sheet: Sheet = PAGE) -> Figure:
    """Draw the session's signals over time below a strip of its states and records.

    Signals of long sessions are bands from minimum to maximum. Pose panels show the range of the
    working states (exciting, moving); lift-off and landing, about 0.9 mm, exceed it. Signals that
    are missing or zero in all logs have no panel.
    """
    shown = [panel for panel in _PANELS if any(_used(session, t) for t in panel.traces)]
    states = sorted({span.state for span in session.spans if span.state is not None})
    legend: list[Artist] = [
        Patch(color=colour(_STATE_COLOURS[s]), label=s.name.lower()) for s in states
    ]
    with drawing(sheet):
        flat = _names_fit(session, sheet)
        strip_in = 0.72 if flat else 1.2
        grid = new_grid((len(shown) + 1, 1), sheet, [strip_in, *[1.15] * len(shown)], legend)
        _strip(grid.axes[0, 0], session, sheet, flat)
        for panel, ax in zip(shown, grid.axes[1:, 0], strict=True):
            _draw(ax, panel, session)
        last = grid.axes[-1, 0]
        last.set_xlabel("time [s]")
        last.set_xlim(session.steps[0].start_s, max(session.steps[-1].end_s, 1e-9))
        _labels_at_bottom_only(grid)
    return grid.figure


def _draw(ax: Axes, panel: _Panel, session: Session) -> None:
    for span in session.spans:
        if span.state in _WORKING:
            ax.axvspan(span.start_s, span.end_s, color=colour("shade"), zorder=0, linewidth=0)
    traces = [t for t in panel.traces if _used(session, t)]
    # Draw the wider band first so that it does not cover the other.
    for trace in sorted(traces, key=lambda t: -_extent(session, t)):
        plot_envelope(ax, session.signals[trace.field], trace.line, panel.factor)
    ax.set_title(panel.title)
    ax.set_title(panel.unit, loc="right", fontweight="normal")
    if len(traces) > 1:
        ax.legend(
            handles=[entry(t.label, t.line) for t in traces],
            loc="lower center",
            bbox_to_anchor=(0.5, 1.0),
            ncols=2,
            borderaxespad=0.15,
        )
    limits = _limits([session.signals[t.field] for t in traces], session.spans)
    if limits is not None:
        ax.set_ylim(panel.factor * limits[0], panel.factor * limits[1])


def _names_fit(session: Session, sheet: Sheet) -> bool:
    """Return whether the records' names fit side by side."""
    point_s = max(session.duration_s, 1e-9) / (72 * 0.9 * sheet.width_in)
    letter_s = 0.62 * sheet.font_pt * point_s
    return all(
        letter_s * len(step.name) < step.end_s - step.start_s
        for step in session.steps
        if step.kind == "record"
    )


def _strip(ax: Axes, session: Session, sheet: Sheet, flat: bool) -> None:
    """Draw states as a coloured bar and, above it, the names of the records."""
    bar = 0.45 if flat else 0.17
    for span in session.spans:
        if span.state is not None:
            ax.axvspan(
                span.start_s,
                span.end_s,
                ymax=bar,
                color=colour(_STATE_COLOURS[span.state]),
                linewidth=0,
            )
    for step in session.steps:
        if step.kind == "record":
            ax.annotate(
                step.name,
                ((step.start_s + step.end_s) / 2, bar),
                xytext=(0, 2.5),
                textcoords="offset points",
                ha="center",
                va="bottom",
                rotation=0 if flat else 90,
                fontsize=sheet.font_pt if flat else sheet.font_pt - 1.5,
                annotation_clip=False,
            )
    ax.set_ylim(0, 1)
    ax.set_yticks([])
    ax.grid(visible=False)
    ax.spines[["left", "bottom"]].set_visible(False)
    ax.tick_params(bottom=False)


def _limits(signals: Sequence[Envelope], spans: Sequence[Span]) -> tuple[float, float] | None:
    """Return the range in the working states, or of all rows without these, with a margin."""
    low, high = np.inf, -np.inf
    for signal in signals:
        working = np.zeros(len(signal.t), bool)
        for span in spans:
            if span.state in _WORKING:
                working |= (signal.t >= span.start_s) & (signal.t <= span.end_s)
        part = working if working.any() else np.ones(len(signal.t), bool)
        low = min(low, float(np.nanmin(signal.low[part], initial=np.inf)))
        high = max(high, float(np.nanmax(signal.high[part], initial=-np.inf)))
    if not low < high:
        return None
    return low - 0.08 * (high - low), high + 0.08 * (high - low)


def _used(session: Session, trace: _Trace) -> bool:
    signal = session.signals.get(trace.field)
    return signal is not None and bool(np.any(np.nan_to_num([signal.low, signal.high])))


def _extent(session: Session, trace: _Trace) -> float:
    signal = session.signals[trace.field]
    return float(np.nansum(signal.high - signal.low))


def _labels_at_bottom_only(grid: Grid) -> None:
    for (row, _), ax in grid.panels():
        ax.tick_params(labelbottom=row == grid.axes.shape[0] - 1, length=2.5)
