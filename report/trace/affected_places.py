"""Draw the platform from above with the coils, sensors and axes at which effects were found."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...model.effects.base import Effect, Places
from ..plotting.labelled_frequency_responses import symbol
from ..plotting.style import PAGE, Sheet, colour, drawing, new_figure

_HEIGHT_IN = 3.3
_MOST_MARKED = 4
"""Effects of more coils or sensors than this are of all of them, and mark none."""
_COIL = 17.0
_LETTERS, _MOST_LINES = 62, 9
_MOTIONS = {
    "psi": "ψ: the platform tilts about x",
    "theta": "θ: the platform tilts about −y",
    "z": "z: the platform moves up and down",
}


def can_be_drawn(places: Places) -> bool:
    """Return whether the positions of coils and sensors are known."""
    return bool(places.beam and len(places.coil_xy_m) and len(places.sensor_xy_m))


def affected_places(
    places: Places, effects: Sequence[Effect], words: Sequence[str], *, sheet: Sheet = PAGE
) -> Figure:
    """Draw coils and sensors of a rig; those of effects are marked. words: a clause of each."""
    coils = _marked(effects, "coil")
    sensors = _marked(effects, "sensor")
    carried = any(c in e.where for e in effects for c in ("beam", "rotor"))
    with drawing(sheet):
        figure = new_figure(sheet, _HEIGHT_IN)
        ax = figure.add_axes((0.06, 0.16, 0.36, 0.82))
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
        _list(figure, places, effects, words, sheet)
    return figure


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


def _list(
    figure: Figure,
    places: Places,
    effects: Sequence[Effect],
    words: Sequence[str],
    sheet: Sheet,
) -> None:
    """Write the effects and the motions that they act on beside the drawing."""
    lines = [(f"{n}. {wrapped(text)}", "vermillion") for n, text in enumerate(words, start=1)]
    acted_on = [d for d in places.dof if any(d in e.where for e in effects)]
    lines += [(_MOTIONS.get(d, symbol(d)), "muted") for d in acted_on]
    lines.append(("squares: coils; s: the sensor below a coil; strip: the beam", "muted"))
    y = 0.93
    for text, role in lines[:_MOST_LINES]:
        figure.text(
            0.47, y, text, color=colour(role), fontsize=sheet.font_pt, va="top", linespacing=1.35
        )
        y -= 0.075 * (text.count("\n") + 1) + 0.03


def wrapped(text: str) -> str:
    """Return a text in lines that fit beside the drawing."""
    return "\n    ".join(textwrap.wrap(text, _LETTERS))
