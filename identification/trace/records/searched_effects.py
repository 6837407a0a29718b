"""Choose the effects that records can show: named ones and free forms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from ....model.effects.base import Effect, Placed, Places
from ....model.effects.freeform import freeform_effects
from ....model.effects.operating_range import Extent
from .check_common_session_time import timeless


@dataclass(frozen=True)
class SearchedEffects:
    """Named effects and free forms that are searched, and a note on those that are not."""

    named: tuple[Effect, ...]
    free: tuple[Effect, ...]
    notes: tuple[str, ...]


def searched_effects(
    effects: Callable[[Places, Extent], Sequence[Effect]],
    placed: Sequence[Placed],
    places: Places,
    covered: Extent,
    overlapping: str,
) -> SearchedEffects:
    """Return the effects of a table that are not placed yet and that the records can show.

    Sensor effects need more sensors than DOF: otherwise a gain error is a change of units, and the
    fit would shrink readings and errors together. If records overlap in time (`overlapping` names
    two), effects that depend on session time are left out.
    """
    known = {p.effect.identity for p in placed}
    named = [e for e in effects(places, covered) if e.identity not in known]
    if places.sensors <= len(places.dof):
        named = [e for e in named if not any(w.startswith("sensor") for w in e.where)]
    free = list(freeform_effects(places, covered))
    notes: tuple[str, ...] = ()
    lasting, timed = timeless(named, places, covered)
    lasting_free, timed_free = timeless(free, places, covered)
    if not overlapping:
        return SearchedEffects(_marked(named, timed), _marked(free, timed_free), notes)
    if timed:
        kinds = ", ".join(dict.fromkeys(e.effect_class for e in timed))
        what = "effects that depend on session time"
        remedy = "" if places.beam else "; state begins_s in each SIGNALS.yaml"
        notes = (f"{overlapping} overlap: {what} are not searched ({kinds}){remedy}",)
    return SearchedEffects(tuple(lasting), tuple(lasting_free), notes)


def _marked(effects: Sequence[Effect], timed: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return the effects, those that depend on session time marked."""
    of_time = {e.identity for e in timed}
    return tuple(replace(e, of_session_time=e.identity in of_time) for e in effects)
