"""Try the candidate that gains most where the ratings do not confirm it yet.

A rating holds the shapes of the model's effects and predicts the gain by a linear fit. With a large
effect missing, the model's numbers are far off, and a record may contradict the right candidate
only because of them. So such a candidate is fitted with the whole model, and is kept if the same
criterion confirms it there, alone or together with one other effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ....model.effects.actuator_chain import same_law
from ..force_balance.force_record import ForceModel
from ..force_regression.gauss_newton_fit import fit_numbers
from ..search_options import SearchOptions
from .add_confirmed_candidate import lowers_missing_force, with_best, without_idle
from .candidates_beside_model import ranked
from .rated_candidate import Rated, confirmed, confirmed_here, matters
from .search_state import SearchState, SearchTask


def contradicted(ranking: Sequence[Rated], options: SearchOptions) -> Rated | None:
    """Return the candidate that gains most, if it is significant but a record contradicts it."""
    first = ranking[0] if ranking else None
    if first is None or first.gain.elsewhere or not confirmed_here(first, options):
        return None
    return first


def scattered(ranking: Sequence[Rated], options: SearchOptions) -> Rated | None:
    """Return the candidate that gains most, if it is relevant but its gain differs over blocks."""
    first = ranking[0] if ranking else None
    if first is None or not first.gain.elsewhere or not matters(first, options):
        return None
    return first


def with_two_at_once(
    state: SearchState, first: Rated | None, task: SearchTask
) -> SearchState | None:
    """Return the state with an unconfirmed candidate that the fit of the whole model confirms,
    alone or beside one other effect; None if the fit does not confirm it.

    While two effects are missing, the gain of one may be mostly due to the other. Each counts if
    the criterion that holds for all effects confirms it in the end.
    """
    if first is None or len(state.rated) + 2 > task.options.most_effects:
        return None
    kept = tuple(p for p in state.point.placed if p is not first.instead_of)
    with_it = replace(state.point, placed=(*kept, first.placed))
    alone = SearchState(
        fit_numbers(task.training, with_it),
        {**state.ratings_without(first), first.placed.effect.identity: first},
        state.dropped,
        (*state.other_choices, ()),
    )
    by_itself = _confirmed_at_fit(state, alone.point, first, task)
    if by_itself is not None:
        return by_itself
    after = with_best(alone, ranked(alone, task.laws, task), task)
    if after is None:
        return None
    both = without_idle(after, task)
    more = len(both.rated) == len(after.rated) > len(state.rated) + 1
    return both if more and lowers_missing_force(state.point, both.point, task) else None


def with_narrow_resonance(
    state: SearchState, ranking: Sequence[Rated], task: SearchTask
) -> SearchState | None:
    """Return the state with a candidate that blocks do not confirm, but that leaves next to nothing
    of what the best confirmed candidate leaves; None if the fit of the whole model rejects it.

    A lightly damped resonance is narrow: from the numbers of a model without it, a linear fit does
    not predict what it takes of a held-out block.
    """
    best = next((r for r in ranking if confirmed(r, task.options)), None)
    if best is None:
        return None
    least = 1.0 - task.options.least_gain * (1.0 - best.share)
    narrow = [r for r in ranking if r.share > least and not confirmed_here(r, task.options)]
    first = max(narrow, key=lambda r: r.share, default=None)
    if first is None or not (first.gain.elsewhere and matters(first, task.options)):
        return None
    kept = tuple(p for p in state.point.placed if p is not first.instead_of)
    point = fit_numbers(task.training, replace(state.point, placed=(*kept, first.placed)))
    return _confirmed_at_fit(state, point, first, task)


def _confirmed_at_fit(
    state: SearchState, fitted: ForceModel, first: Rated, task: SearchTask
) -> SearchState | None:
    """Return the state with a candidate that is confirmed beside the numbers that fit with it, or
    with a better rival there; None if it is not confirmed.

    fitted: the model with the candidate as its last effect.
    """
    rest = replace(fitted, placed=fitted.placed[:-1])
    there = replace(state, point=rest, rated=state.ratings_without(first))
    ranking = ranked(there, task.laws, task)
    own = (r for r in ranking if same_law(r.placed.effect, first.placed.effect))
    if not any(confirmed(r, task.options) for r in own):
        return None
    after = with_best(there, ranking, task)
    if after is None:
        return None
    return after if lowers_missing_force(state.point, after.point, task) else None
