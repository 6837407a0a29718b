"""Search for effects in the missing force: add the effects that held-out data confirm.

One criterion decides whether an effect stays: the squared error that it removes from blocks that
did not fit it exceeds its standard error by far, is relevant, and no other record contradicts it.
Among effects that the records cannot separate, the one with the fewest numbers is added; the others
are its alternatives. A richer law replaces a simpler one if held-out data confirm what it adds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ....model.effects.base import Effect
from ..force_balance.force_record import ForceModel
from ..force_regression.gauss_newton_fit import fit_numbers
from ..force_regression.training_records import Training, missing_share
from ..search_options import SearchOptions
from .add_confirmed_candidate import with_best, without_idle
from .add_unconfirmed_candidate import (
    contradicted,
    scattered,
    with_narrow_resonance,
    with_two_at_once,
)
from .candidates_beside_model import ranked
from .compare_with_rivals import against_rivals
from .free_form_of_law_signal import described_laws
from .rated_candidate import Rated, by_gain, confirmed, is_free
from .search_state import SearchState, SearchTask

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Searched:
    """The model with the added effects, their ratings, the nearest candidates, removed effects."""

    point: ForceModel
    rated: tuple[Rated, ...]
    nearest: tuple[Rated, ...]
    dropped: tuple[str, ...]


def search(
    point: ForceModel,
    laws: Sequence[Effect],
    free_forms: Sequence[Effect],
    training: Training,
    options: SearchOptions,
    progress: Progress,
    begun: Searched | None = None,
) -> Searched:
    """Add effects to a fitted model until held-out data confirm no further one.

    laws: effects with a name. free_forms: effects to try where no law is confirmed. begun: the
    result of a search with other weights, from which this one continues.
    """
    task = SearchTask(laws, training, options)
    state = SearchState(point, {}, ())
    if begun is not None:
        rated = {r.placed.effect.identity: r for r in begun.rated}
        state = SearchState(fit_numbers(training, begun.point.freed()), rated, ())
        if len(rated) == 1:  # several effects are compared with their rivals at the end
            state = against_rivals(state, list(rated), task)
    state, nearest = _grown(state, task, progress)
    other = _with_another_choice(state, task, progress)
    if other is not state:
        state, nearest = _grown(other, task, progress)
    while len(state.rated) < options.most_effects:
        ranking = ranked(state, free_forms, task)
        nearest = sorted([*nearest, *ranking], key=by_gain)
        fresh = [r for r in ranking if not described_laws(r.placed, state.point, training)]
        after = with_best(state, fresh, task)
        if after is None:
            break
        state, nearest = _grown(without_idle(after, task), task, progress)
    return _result(state, nearest, options)


def compared(
    found: Searched, laws: Sequence[Effect], training: Training, options: SearchOptions
) -> Searched:
    """Compare each effect of a finished search with all laws at its place."""
    if len(found.rated) < 2:
        return found
    rated = {r.placed.effect.identity: r for r in found.rated}
    state = SearchState(found.point, rated, found.dropped)
    task = SearchTask(laws, training, options)
    state = against_rivals(state, list(rated), task, at_place=True)
    return _result(state, found.nearest, options)


def _result(state: SearchState, nearest: Sequence[Rated], options: SearchOptions) -> Searched:
    last = {p.effect.identity: p for p in state.point.placed}
    final = [replace(r, placed=last[key]) for key, r in state.rated.items()]
    final.sort(key=lambda r: (is_free(r.placed), bool(r.placed.effect.beside), -r.force))
    gone = tuple(name for name in state.dropped if name not in last)
    return Searched(state.point, tuple(final), tuple(nearest[: options.patience]), gone)


def _grown(
    state: SearchState, task: SearchTask, progress: Progress
) -> tuple[SearchState, list[Rated]]:
    """Return the state with laws added, and the candidates of the last round."""
    options, nearest = task.options, list[Rated]()
    while len(state.rated) < options.most_effects:
        number = len(state.rated) + 1
        progress(f"search, effect {number}", options.share_done(number))
        nearest = ranked(state, task.laws, task)
        pair = with_two_at_once(state, contradicted(nearest, options), task)
        if pair is not None:
            state = pair
            continue
        before = state
        after = with_narrow_resonance(state, nearest, task) or with_best(state, nearest, task)
        if after is None:
            # A candidate that blocks confirm and the fit of the whole model rejects is none.
            others = [r for r in nearest if not confirmed(r, options)]
            first = contradicted(others, options) if len(others) < len(nearest) else None
            after = with_two_at_once(state, first or scattered(others, options), task)
            if after is None:
                break
        state = without_idle(after, task)
        undecided = [k for k, r in state.rated.items() if r.alternatives and k in before.rated]
        chosen = against_rivals(state, undecided, task)
        if set(chosen.rated) != set(state.rated):  # the last effect was added beside others
            chosen = against_rivals(chosen, list(chosen.rated), task)
        state = chosen
    return state, nearest


def _with_another_choice(state: SearchState, task: SearchTask, progress: Progress) -> SearchState:
    """Return the state that another choice of an earlier effect leads to, if it leaves little and
    the present state leaves much.

    Effects are added one by one, and a candidate that resembles two effects together can keep both
    out: dry friction and an actuator whose force grows faster than its command resemble a friction
    that is elastic before it slips. The other state may have one effect more. It may not lack more
    force: of effects that together cancel most of a command, weighed errors are rounding.
    """
    training, options = task.training, task.options
    missing = missing_share(training.plain.at(state.point))
    most = options.much_left**2 * training.expected
    others = [other for some in state.other_choices for other in some]
    if not training.cost(state.point) > most:
        return state
    fewer = replace(
        options,
        most_effects=min(len(state.rated) + 1, options.most_effects),
        fitted=options.patience,  # the next effect stands out if a choice leads far
    )
    for chosen in others[: options.detours]:
        begin = replace(chosen, point=fit_numbers(training, chosen.point))
        other, _ = _grown(begin, replace(task, options=fewer), progress)
        more = missing_share(training.plain.at(other.point)) - missing
        if training.cost(other.point) < most and not np.any(more > options.least_force):
            return other
    return state
