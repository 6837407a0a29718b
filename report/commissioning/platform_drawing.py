"""Draw the platform from above with the channel that was found at each place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..plotting.style import PAGE, Sheet, colour, drawing, new_figure

_HEIGHT_IN = 3.6
_LOOKS = {
    "right": ("muted", "o", "as RIG.yaml says"),
    "corrected": ("orange", "s", "corrected"),
    "problem": ("vermillion", "X", "problem"),
}
"""Colour, marker and words of each state: the marker tells them apart without colour."""


@dataclass(frozen=True)
class Drawn:
    """A channel: its number, its place in m, and whether it is right, corrected or a problem."""

    channel: int
    x_m: float
    y_m: float
    state: str


def platform_drawing(
    sensors: Sequence[Drawn], coils: Sequence[Drawn], *, sheet: Sheet = PAGE
) -> Figure:
    """Draw sensors and coils side by side, each channel's number at the place that was found."""
    with drawing(sheet):
        figure = new_figure(sheet, _HEIGHT_IN)
        left, right = figure.subplots(1, 2)
        _panel(left, "sensor channels", sensors)
        _panel(right, "coil channels", coils)
        used = {d.state for d in (*sensors, *coils)}
        handles = [
            left.plot([], [], marker=marker, color=colour(role), linestyle="", label=words)[0]
            for state, (role, marker, words) in _LOOKS.items()
            if state in used
        ]
        figure.subplots_adjust(left=0.1, right=0.97, top=0.9, bottom=0.27, wspace=0.25)
        figure.legend(handles=handles, loc="lower center", ncols=len(handles))
    return figure


def _panel(ax: Axes, title: str, channels: Sequence[Drawn]) -> None:
    for d in channels:
        role, marker, _ = _LOOKS[d.state]
        ax.plot(1e3 * d.x_m, 1e3 * d.y_m, marker=marker, color=colour(role), markersize=16)
        ax.annotate(
            str(d.channel), (1e3 * d.x_m, 1e3 * d.y_m), color=colour("paper"),
            ha="center", va="center", fontweight="bold",
        )  # fmt: skip
    ax.set_title(title)
    ax.set_aspect("equal")
    ax.margins(0.2)
    ax.set_xlabel("x in mm")
    ax.set_ylabel("y in mm")
