"""Draw the platform from above with the coils, sensors and axes at which effects were found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...model.effects.base import Effect, Places, in_words
from ..plotting.labelled_frequency_responses import symbol
from ..plotting.style import PAGE, Sheet, colour, drawing, new_figure

_WIDTH_IN, _HEIGHT_IN = 3.6, 3.6
_MOST_MARKED = 4
"""Effects of more coils or sensors than this are of all of them, and mark none."""
_COIL = 17.0
_MOTIONS = {
    "psi": "ψ (tilt about x)",
    "theta": "θ (tilt about −y)",
    "z": "z (up and down)",
}


def can_be_drawn(places: Places) -> bool:
    """Return whether the positions of coils and sensors are known."""
    return bool(places.beam and len(places.coil_xy_m) and len(places.sensor_xy_m))


def affected_places(places: Places, effects: Sequence[Effect], *, sheet: Sheet = PAGE) -> Figure:
    """Draw coils and sensors of a rig; those of effects are marked."""
    sheet = replace(sheet, width_in=_WIDTH_IN)
    coils = _marked(effects, "coil")
    sensors = _marked(effects, "sensor")
    carried = any(c in e.where for e in effects for c in ("beam", "rotor"))
    with drawing(sheet):
        figure = new_figure(sheet, _HEIGHT_IN)
        ax = figure.add_axes((0.2, 0.16, 0.78, 0.82))
        ax.set_aspect("equal")
        ax.margins(0.22)
        for number, (x, y) in enumerate(1e3 * places.coil_xy_m):
            marked = number in coils
            ax.plot(
                x, y, marker="s", markersize=_COIL, linestyle="none", zorder=2,
                markerfacecolor=colour("vermillion" if marked else "shade"),
                markeredgecolor=colour("vermillion" if marked else "edge"),
            )  # fmt: skip
            ax.annotate(
                str(number), (x, y), ha="center", va="center",
                color=colour("paper" if marked else "ink"),
                fontweight="bold" if marked else "normal",
            )  # fmt: skip
        for number, (x, y) in enumerate(1e3 * places.sensor_xy_m):
            marked = number in sensors
            ax.annotate(
                f"s{number}", (x, y), (13, -13), textcoords="offset points", ha="center",
                fontsize=sheet.font_pt - 2, color=colour("vermillion" if marked else "muted"),
                fontweight="bold" if marked else "normal",
            )  # fmt: skip
        _beam(ax, places, marked=carried)
        ax.set_xlabel("x in mm")
        ax.set_ylabel("y in mm")
    return figure


def places_in_words(places: Places, effects: Sequence[Effect]) -> str:
    """Return the caption of the drawing: what is marked, which motions effects act on, the key."""
    there = list(dict.fromkeys(w for e in effects for w in e.where))
    marked = [w for w in there if w not in places.dof]
    moved = [_MOTIONS.get(w, symbol(w)) for w in places.dof if w in there]
    parts = [f"Marked: {in_words(marked)}."] if marked else []
    parts += [f"Effects on the motion of the whole platform: {', '.join(moved)}."] if moved else []
    return " ".join([*parts, "From above: squares are coils, s their sensors, the strip the beam."])


def _marked(effects: Sequence[Effect], kind: str) -> set[int]:
    found: set[int] = set()
    for effect in effects:
        own = [int(w.partition(":")[2]) for w in effect.where if w.startswith(f"{kind}:")]
        found.update(own if len(own) <= _MOST_MARKED else ())
    return found


def _beam(ax: Axes, places: Places, *, marked: bool) -> None:
    reach = 1e3 * float(abs(places.coil_xy_m[:, 1]).max())
    ax.plot(
        [0, 0], [-1.25 * reach, 1.25 * reach], zorder=1, solid_capstyle="butt",
        color=colour("vermillion" if marked else "grid"), linewidth=7 if marked else 5,
    )  # fmt: skip
