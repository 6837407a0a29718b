"""Add the best candidate that held-out blocks and other records confirm; remove idle effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ....model.effects.base import Placed
from ..force_balance.force_record import ForceModel
from ..force_regression.candidate_fit import Beside
from ..force_regression.gain_beyond_output_noise import taken_beyond_noise
from ..force_regression.gauss_newton_fit import fit_numbers
from ..force_regression.training_records import missing_share
from .compare_fitted_candidates import fitted_rivals
from .rated_candidate import Rated, confirmed, is_free, rated_beside
from .search_state import SearchState, SearchTask, ratings_of_model


def with_best(state: SearchState, ranking: Sequence[Rated], task: SearchTask) -> SearchState | None:
    """Return the state with the best confirmed candidate; None if the fits confirm no candidate.

    A fit of the whole model with a candidate has to lower the missing force as its rating predicts.
    """
    first = next((r for r in ranking if confirmed(r, task.options)), None)
    if first is None:
        return None
    kept = tuple(p for p in state.point.placed if p is not first.instead_of)
    beside = replace(state.point, placed=kept)
    rivals = fitted_rivals(beside, first, ranking, task.training, task.options, task.laws)
    for chosen, fitted in rivals:
        point = fit_numbers(task.training, fitted)  # the fit of a worse rival ended early
        if lowers_missing_force(state.point, point, task):
            rated = state.ratings_without(first)
            others = _other_choices(state, chosen, rivals, rated, point, task)
            rated[chosen.placed.effect.identity] = chosen
            by_law = ratings_of_model(rated, point)
            return SearchState(point, by_law, state.dropped, (*state.other_choices, others))
    return None


def lowers_missing_force(before: ForceModel, after: ForceModel, task: SearchTask) -> bool:
    """Return whether a fitted model lacks less force than another one by a relevant amount.

    What it lacks less because it has less of the outputs' noise does not count.
    """
    plain = task.training.plain
    lowered = missing_share(plain.at(before)) - missing_share(plain.at(after))
    beyond = taken_beyond_noise(before, after, task.training, task.options)
    return bool(np.any(beyond & (lowered > task.options.least_force)))


def without_idle(state: SearchState, task: SearchTask) -> SearchState:
    """Remove the added effects that held-out blocks no longer confirm beside the other effects.

    A law is judged without the free forms, because these contain most laws; a free form is judged
    beside all effects.
    """
    while len(state.rated) > 1:
        idle = []
        for p in state.point.placed:
            if p.effect.identity in state.rated:
                others = tuple(
                    o for o in state.point.placed if o is not p and (is_free(p) or not is_free(o))
                )
                rest = Beside.of(replace(state.point, placed=others), task.training)
                rated = rated_beside(rest, rest, p, None)
                if not confirmed(rated, task.options):
                    idle.append((rated.gain.statistic, p))
        if not idle:
            break
        _, worst = min(idle, key=lambda pair: pair[0])
        state = _without(state, worst, task)
    return state


def _without(state: SearchState, placed: Placed, task: SearchTask) -> SearchState:
    identity = placed.effect.identity
    rated = {k: r for k, r in state.rated.items() if k != identity}
    kept = tuple(p for p in state.point.placed if p is not placed)
    point = fit_numbers(task.training, replace(state.point, placed=kept))
    return SearchState(point, rated, (*state.dropped, identity), state.other_choices)


def _other_choices(
    state: SearchState,
    chosen: Rated,
    rivals: Sequence[tuple[Rated, ForceModel]],
    rated: dict[str, Rated],
    taken: ForceModel,
    task: SearchTask,
) -> tuple[SearchState, ...]:
    """Return the states with a rival in the place of the chosen effect, best first.

    Rivals whose costs differ by less than an effect has to take are one choice, represented by the
    rival with the fewest numbers. Among those that cost as much as the model `taken`, only a rival
    of another class than the chosen effect is another choice; it comes last. A law that would do
    without one of its amplitudes is represented by the simpler law that it contains.
    """
    rivals = [(r, p) for r, p in rivals if not r.as_simpler]
    cost_of = task.training.cost
    groups: list[tuple[float, list[tuple[Rated, ForceModel]]]] = [(cost_of(taken), [])]
    costs = sorted((cost_of(point), i) for i, (_, point) in enumerate(rivals))
    for cost, i in costs:
        if cost > (1.0 + task.options.least_gain) * groups[-1][0]:
            groups.append((cost, []))
        groups[-1][1].append(rivals[i])
    own = chosen.placed.effect.effect_class
    others = [(r, p) for r, p in groups[0][1] if r.placed.effect.effect_class != own]
    found = []
    for group in (*(some for _, some in groups[1:]), others):
        if group:
            rival, point = min(group, key=lambda r: r[0].numbers)
            with_it = ratings_of_model({**rated, rival.placed.effect.identity: rival}, point)
            found.append(SearchState(point, with_it, state.dropped, state.other_choices))
    return tuple(found)
