"""Compare added effects with their rivals once more, beside all other effects of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ....model.effects.actuator_chain import same_law
from ....model.effects.base import Placed
from ..force_balance.force_record import ForceModel
from ..force_regression.candidate_fit import Beside
from ..force_regression.gauss_newton_fit import fit_numbers
from ..search_options import SearchOptions
from .candidates_beside_model import applicable, compatible, with_scale_known
from .compare_fitted_candidates import fitted_rivals
from .rated_candidate import Rated, by_gain, confirmed, is_free, rate, rated_beside
from .search_state import SearchState, SearchTask, ratings_of_model


def against_rivals(
    state: SearchState, identities: Sequence[str], task: SearchTask, at_place: bool = False
) -> SearchState:
    """Return the state with the best of each effect and its rivals, or the simplest of equals.

    An effect was added while others were missing, and these hid what separates it from its rivals.

    identities: the effects to compare. at_place: whether all laws at the place of an effect are its
    rivals, also laws that gained nothing while other effects were missing.
    """
    for identity in identities:
        own = next((p for p in state.point.placed if p.effect.identity == identity), None)
        if own is None or is_free(own):
            continue
        rated = state.rated[identity]
        kept = tuple(p for p in state.point.placed if p is not own)
        bare = replace(state.point, placed=kept)
        contenders = [e for r in state.rated.values() for e in r.contenders]
        known = {(e.key, e.where) for e in contenders}
        contenders += [e for e in task.laws if (e.beside, e.where) in known]
        if at_place:
            contenders += [e for e in applicable(task.laws, bare) if e.where == own.effect.where]
        rest = fit_numbers(task.training, bare)
        others = {
            e.identity: e for e in compatible(contenders, bare) if not same_law(e, own.effect)
        }
        rivals = [own.effect, *with_scale_known(rest, list(others.values()), task)]
        ranking = _with_present_numbers(
            rate(rest, rivals, task.training, task.options), own, rest, task
        )
        ranking = contradicted_no_more(ranking, own, task.options)
        first = next((r for r in ranking if confirmed(r, task.options)), None)
        if first is None:
            continue
        if not any(confirmed(r, task.options) for r in ranking if r.placed.effect == own.effect):
            # The linear fit from other numbers does not predict it, but here it was confirmed.
            ranking = [replace(rated, placed=own, instead_of=None), *ranking]
        best, point = fitted_rivals(rest, first, ranking, task.training, task.options, task.laws)[0]
        now = {k: r for k, r in state.rated.items() if k != identity}
        now[best.placed.effect.identity] = best
        state = replace(state, point=point, rated=ratings_of_model(now, point))
    return state


def contradicted_no_more(
    ranking: Sequence[Rated], own: Placed, options: SearchOptions
) -> list[Rated]:
    """Return a ranking that asks of the rivals of an added effect no more than of the effect.

    A record that contradicts the effect, beside the numbers that the model has without it, is no
    evidence against a rival that it contradicts no more.
    """
    mine = next(r for r in ranking if r.placed.effect == own.effect).gain.others
    found = []
    for r in ranking:
        others = r.gain.others
        as_much = (mine <= 0.0) & (others > mine - options.agreement)
        counted = np.where(as_much & (r.placed.effect != own.effect), np.nan, others)
        found.append(replace(r, gain=replace(r.gain, others=counted)))
    return found


def _with_present_numbers(
    ranking: Sequence[Rated], own: Placed, rest: ForceModel, task: SearchTask
) -> list[Rated]:
    """Return a ranking beside the model `rest` in which an added effect keeps its fitted numbers,
    if these gain more than a fit from its start values."""
    beside = Beside.of(rest, task.training)
    now = rated_beside(beside, beside, own, None)
    afresh = [r for r in ranking if r.placed.effect == own.effect]
    best = min([now, *afresh], key=by_gain)
    others = [r for r in ranking if r.placed.effect != own.effect]
    return sorted([best, *others], key=by_gain)
