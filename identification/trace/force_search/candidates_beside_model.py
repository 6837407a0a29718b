"""Select the candidates that may be added to a model, and rank them by their held-out gain.

Two laws of dry friction at one DOF exclude each other, and so do a law and a simpler law that it
contains: one may replace the other, but a model never has both.
"""

from __future__ import annotations

from collections.abc import Sequence

from ....model.effects.actuator_chain import delayed, same_law
from ....model.effects.base import Effect
from ..force_balance.force_record import ForceModel
from .rated_candidate import Rated, by_gain, rate
from .scale_of_equations import without_scales
from .search_state import SearchState, SearchTask

_FRICTION = "friction"
_RUBS_TOO = ("backlash.play", "damping.falling", "damping.eddy_current", "damping.root")


def ranked(state: SearchState, table: Sequence[Effect], task: SearchTask) -> list[Rated]:
    """Return the rated candidates of a table, the largest gain first.

    A candidate that excludes an effect of the model is rated in the place of that effect.
    """
    point = state.point
    kept = [e for e in table if e.identity not in state.dropped]
    fresh = with_scale_known(point, kept, task)
    ranking = rate(point, compatible(fresh, point), task.training, task.options)
    for p in point.placed:
        instead = [e for e in applicable(fresh, point) if e != p.effect and _exclude(e, p.effect)]
        ranking += rate(point, instead, task.training, task.options, p)
    return sorted(ranking, key=by_gain)


def with_scale_known(point: ForceModel, table: Sequence[Effect], task: SearchTask) -> list[Effect]:
    """Return the effects of a table that leave the scale of each equation identifiable."""
    if not any(p.effect.linear for p in point.placed):
        return list(table)
    return without_scales(point, table, task.training, task.options.told_from_model)


def compatible(table: Sequence[Effect], point: ForceModel) -> list[Effect]:
    """Return the applicable effects of a table that no effect of a model excludes."""
    some = applicable(table, point)
    return [e for e in some if not any(_exclude(e, p.effect) for p in point.placed)]


def applicable(table: Sequence[Effect], point: ForceModel) -> list[Effect]:
    """Return the effects of a table that have a meaning beside the effects of a model.

    A law acts before or behind a lag if there is one: behind a slow lag it is another force.
    """
    placed, lagging = point.placed, point.model.lagging
    there = {(p.effect.key, p.effect.where) for p in placed}
    some = [e for e in table if not e.before_lag or delayed(e, placed, lagging)]
    return [e for e in some if not e.beside or (e.beside, e.where) in there]


def _exclude(one: Effect, other: Effect) -> bool:
    """Return whether two effects are the same, two dry frictions, or a law and a simpler one."""
    if one.where != other.where:
        return False
    nested = one.key in other.contains or other.key in one.contains or same_law(one, other)
    return nested or (_rubs(one) and _rubs(other))


def _rubs(effect: Effect) -> bool:
    """Return whether an effect is a dry friction.

    A spring that is dragged along is one: the force of a Maxwell-slip element. So is a damping
    that levels off: it contains friction.
    """
    return effect.effect_class == _FRICTION or effect.key.startswith(_RUBS_TOO)
