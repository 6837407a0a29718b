"""Search for effects in the missing force: add what blocks and other records confirm.

One criterion decides whether an effect stays: the squared error that it takes of blocks that did
not fit it is larger than its standard error by far, matters, and is not contradicted by another
record. Among effects that the records do not tell apart the one with the fewest numbers is taken;
the others are its alternatives. The laws of friction of one DOF exclude each other, and so do a law
and a simpler one that it contains: a richer one takes the place of a simpler one if it is confirmed
beside the model with the simpler one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ....model.effects.actuator_chain import delayed, same_law
from ....model.effects.base import Effect, Placed
from ..search_options import SearchOptions
from .candidate_fit import Beside
from .compare_fitted_candidates import fitted_rivals
from .force_record import ForceModel
from .free_form_of_law_signal import described_laws
from .gain_beyond_output_noise import taken_beyond_noise
from .gauss_newton_fit import fit_numbers
from .rated_candidate import (
    Rated,
    by_gain,
    confirmed,
    confirmed_here,
    is_free,
    matters,
    rate,
    rated_beside,
)
from .scale_of_equations import without_scales
from .training_records import Training, missing_share

Progress = Callable[[str, float], None]

_FRICTION = "friction"
_ALSO = ("backlash.play", "damping.falling", "damping.eddy_current", "damping.root")


@dataclass(frozen=True)
class Searched:
    """The model with the effects found, how each was rated, what came nearest, what was dropped."""

    point: ForceModel
    rated: tuple[Rated, ...]
    nearest: tuple[Rated, ...]
    dropped: tuple[str, ...]


def search(
    point: ForceModel,
    named: Sequence[Effect],
    free_forms: Sequence[Effect],
    training: Training,
    options: SearchOptions,
    progress: Progress,
    begun: Searched | None = None,
) -> Searched:
    """Add effects to a fitted model until none is confirmed; free forms where no named one is.

    begun: what a search with other weights found, from which this one goes on.
    """
    state = _State(point, {}, ())
    if begun is not None:
        rated = {r.placed.effect.identity: r for r in begun.rated}
        state = _State(fit_numbers(training, begun.point.freed()), rated, ())
        if len(rated) == 1:  # of several, rivals are compared at the end
            state = _against_rivals(state, list(rated), named, training, options)
    state, nearest = _grown(state, named, training, options, progress)
    other = _with_another_choice(state, named, training, options, progress)
    if other is not state:
        state, nearest = _grown(other, named, training, options, progress)
    while len(state.rated) < options.most_effects:
        ranking = _ranking(state, free_forms, training, options)
        nearest = sorted([*nearest, *ranking], key=by_gain)
        fresh = [r for r in ranking if not described_laws(r.placed, state.point, training)]
        after = _with_best(state, fresh, named, training, options)
        if after is None:
            break
        state = _without_idle(after, training, options)
        state, nearest = _grown(state, named, training, options, progress)
    return _found(state, nearest, options)


def compared(
    found: Searched, named: Sequence[Effect], training: Training, options: SearchOptions
) -> Searched:
    """Compare the effects of a search with all laws at their places, once all others are found."""
    if len(found.rated) < 2:
        return found
    rated = {r.placed.effect.identity: r for r in found.rated}
    state = _State(found.point, rated, found.dropped)
    state = _against_rivals(state, list(rated), named, training, options, at_place=True)
    return _found(state, found.nearest, options)


def _found(state: _State, nearest: Sequence[Rated], options: SearchOptions) -> Searched:
    last = {p.effect.identity: p for p in state.point.placed}
    final = [replace(r, placed=last[key]) for key, r in state.rated.items()]
    final.sort(key=lambda r: (is_free(r.placed), bool(r.placed.effect.beside), -r.force))
    gone = tuple(name for name in state.dropped if name not in last)
    return Searched(state.point, tuple(final), tuple(nearest[: options.patience]), gone)


@dataclass(frozen=True)
class _State:
    """The model so far, the ratings of its found effects by identity, and dropped ones.

    not_taken: for each effect that was added, the states with another one in its place, best first.
    """

    point: ForceModel
    rated: dict[str, Rated]
    dropped: tuple[str, ...]
    not_taken: tuple[tuple[_State, ...], ...] = ()


def _grown(
    state: _State,
    named: Sequence[Effect],
    training: Training,
    options: SearchOptions,
    progress: Progress,
) -> tuple[_State, list[Rated]]:
    """Return the state with named effects added, and the candidates of the last round."""
    nearest: list[Rated] = []
    while len(state.rated) < options.most_effects:
        number = len(state.rated) + 1
        progress(f"search, effect {number}", options.share_done(number))
        nearest = _ranking(state, named, training, options)
        pair = _with_two_at_once(state, _contradicted(nearest, options), named, training, options)
        if pair is not None:
            state = pair
            continue
        before, after = state, _with_narrow(state, nearest, named, training, options)
        if after is None:
            after = _with_best(state, nearest, named, training, options)
        if after is None:
            # What blocks confirm, and the fit of the whole model does not, is no candidate.
            others = [r for r in nearest if not confirmed(r, options)]
            first = _contradicted(others, options) if len(others) < len(nearest) else None
            first = first or _scattered(others, options)
            after = _with_two_at_once(state, first, named, training, options)
            if after is None:
                break
        state = _without_idle(after, training, options)
        undecided = [k for k, r in state.rated.items() if r.alternatives and k in before.rated]
        told = _against_rivals(state, undecided, named, training, options)
        if set(told.rated) != set(state.rated):  # what was found last was found beside others
            told = _against_rivals(told, list(told.rated), named, training, options)
        state = told
    return state, nearest


def _with_two_at_once(
    state: _State,
    first: Rated | None,
    named: Sequence[Effect],
    training: Training,
    options: SearchOptions,
) -> _State | None:
    """Return the state with an effect that is not confirmed yet, if it is at the numbers that the
    fit of the whole model with it gives, or beside another one that it needs.

    With a large effect missing, the model's numbers are far off, and so is what they let a record
    say. While two effects are missing, what one record or block says of one of them may be mostly
    the other. Each counts if it is confirmed in the end, by the same criterion as all.
    """
    if first is None or len(state.rated) + 2 > options.most_effects:
        return None
    beside = replace(
        state.point, placed=tuple(p for p in state.point.placed if p is not first.instead_of)
    )
    alone = _State(
        fit_numbers(training, replace(beside, placed=(*beside.placed, first.placed))),
        {**_without_replaced(state, first), first.placed.effect.identity: first},
        state.dropped,
        (*state.not_taken, ()),
    )
    by_itself = _confirmed_where_it_fits(state, alone.point, first, named, training, options)
    if by_itself is not None:
        return by_itself
    after = _with_best(alone, _ranking(alone, named, training, options), named, training, options)
    if after is None:
        return None
    both = _without_idle(after, training, options)
    more = len(both.rated) == len(after.rated) > len(state.rated) + 1
    return both if more and _takes_force(state.point, both.point, training, options) else None


def _contradicted(ranking: Sequence[Rated], options: SearchOptions) -> Rated | None:
    """Return the effect that gains most, if it is no chance but a record contradicts it."""
    first = ranking[0] if ranking else None
    if first is None or first.gain.elsewhere or not confirmed_here(first, options):
        return None
    return first


def _scattered(ranking: Sequence[Rated], options: SearchOptions) -> Rated | None:
    """Return the effect that gains most, if it matters but what blocks say of it scatters."""
    first = ranking[0] if ranking else None
    if first is None or not first.gain.elsewhere or not matters(first, options):
        return None
    return first


def _with_narrow(
    state: _State,
    ranking: Sequence[Rated],
    named: Sequence[Effect],
    training: Training,
    options: SearchOptions,
) -> _State | None:
    """Return the state with an effect that blocks do not confirm, but that leaves next to nothing
    of what the best confirmed one leaves, if it is confirmed where the whole model fits with it.

    A resonance with little damping is narrow: from the model's numbers without it a line does not
    foretell what a block takes of it.
    """
    best = next((r for r in ranking if confirmed(r, options)), None)
    if best is None:
        return None
    least = 1.0 - options.least_gain * (1.0 - best.share)
    narrow = [r for r in ranking if r.share > least and not confirmed_here(r, options)]
    first = max(narrow, key=lambda r: r.share, default=None)
    if first is None or not (first.gain.elsewhere and matters(first, options)):
        return None
    kept = tuple(p for p in state.point.placed if p is not first.instead_of)
    point = fit_numbers(training, replace(state.point, placed=(*kept, first.placed)))
    return _confirmed_where_it_fits(state, point, first, named, training, options)


def _confirmed_where_it_fits(
    state: _State,
    fitted: ForceModel,
    first: Rated,
    named: Sequence[Effect],
    training: Training,
    options: SearchOptions,
) -> _State | None:
    """Return the state with an effect that is confirmed beside the numbers that fit with it, or
    with a rival that is better there.

    fitted: the model with the effect, the last one.
    """
    rest = replace(fitted, placed=fitted.placed[:-1])
    there = replace(state, point=rest, rated=_without_replaced(state, first))
    ranking = _ranking(there, named, training, options)
    own = (r for r in ranking if same_law(r.placed.effect, first.placed.effect))
    if not any(confirmed(r, options) for r in own):
        return None
    after = _with_best(there, ranking, named, training, options)
    if after is None:
        return None
    return after if _takes_force(state.point, after.point, training, options) else None


def _takes_force(
    before: ForceModel, after: ForceModel, training: Training, options: SearchOptions
) -> bool:
    """Return whether a fitted model lacks less force than another one, by what matters, and not
    only as it has less of the outputs' noise."""
    plain = training.plain
    lowered = missing_share(plain.at(before)) - missing_share(plain.at(after))
    beyond = taken_beyond_noise(before, after, training, options)
    return bool(np.any(beyond & (lowered > options.least_force)))


def _with_another_choice(
    state: _State,
    named: Sequence[Effect],
    training: Training,
    options: SearchOptions,
    progress: Progress,
) -> _State:
    """Return the state that another choice led to, if the choices left much and this does not.

    Effects are taken one by one, and what looks most like two of them together bars the way to
    both: of dry friction and an actuator whose force grows faster than its command it is a friction
    that is elastic before it slips. It may have one effect more. It may not miss more force: with
    effects that together leave next to nothing of a command, weighed errors are rounding.
    """
    plain = training.plain
    missing = missing_share(plain.at(state.point))
    most = options.much_left**2 * training.expected
    others = [other for some in state.not_taken for other in some]
    if not training.cost(state.point) > most:
        return state
    fewer = replace(
        options,
        most_effects=min(len(state.rated) + 1, options.most_effects),
        fitted=options.patience,  # of a choice that leads far, the next effect stands out
    )
    for chosen in others[: options.detours]:
        begin = replace(chosen, point=fit_numbers(training, chosen.point))
        other, _ = _grown(begin, named, training, fewer, progress)
        more = missing_share(plain.at(other.point)) - missing
        if training.cost(other.point) < most and not np.any(more > options.least_force):
            return other
    return state


def _ranking(
    state: _State, table: Sequence[Effect], training: Training, options: SearchOptions
) -> list[Rated]:
    point = state.point
    fresh = _telling(
        point, [e for e in table if e.identity not in state.dropped], training, options
    )
    ranking = rate(point, _new(fresh, point), training, options)
    for p in point.placed:
        instead = [e for e in _asked(fresh, point) if e != p.effect and _exclude(e, p.effect)]
        ranking += rate(point, instead, training, options, p)
    return sorted(ranking, key=by_gain)


def _telling(
    point: ForceModel, table: Sequence[Effect], training: Training, options: SearchOptions
) -> list[Effect]:
    """Return the effects of a table beside which the scale of each equation stays told."""
    if not any(p.effect.linear for p in point.placed):
        return list(table)
    return without_scales(point, table, training, options.told_from_model)


def _with_best(
    state: _State,
    ranking: Sequence[Rated],
    named: Sequence[Effect],
    training: Training,
    options: SearchOptions,
) -> _State | None:
    """Return the state with the best confirmed candidate whose fit does what was foretold."""
    first = next((r for r in ranking if confirmed(r, options)), None)
    if first is None:
        return None
    kept = tuple(p for p in state.point.placed if p is not first.instead_of)
    beside = replace(state.point, placed=kept)
    rivals = fitted_rivals(beside, first, ranking, training, options, named)
    for chosen, stayed in rivals:
        point = fit_numbers(training, stayed)  # of a rival that stayed behind, it ended early
        if _takes_force(state.point, point, training, options):
            rated = _without_replaced(state, first)
            others = _distinct_choices(state, chosen, rivals, rated, training, point, options)
            rated[chosen.placed.effect.identity] = chosen
            by_law = _by_law(rated, point)
            return _State(point, by_law, state.dropped, (*state.not_taken, others))
    return None


def _without_replaced(state: _State, first: Rated) -> dict[str, Rated]:
    """Return the ratings of a state without that of the effect whose place a candidate takes."""
    gone = None if first.instead_of is None else first.instead_of.effect.identity
    return {key: r for key, r in state.rated.items() if key != gone}


def _distinct_choices(
    state: _State,
    chosen: Rated,
    rivals: Sequence[tuple[Rated, ForceModel]],
    rated: dict[str, Rated],
    training: Training,
    taken: ForceModel,
    options: SearchOptions,
) -> tuple[_State, ...]:
    """Return the states that rivals lead to, best first; one for all that leave about the same.

    That is the one with the fewest numbers. Those that leave about as much as the model that was
    `taken` are the same choice; of them only another class than that of the `chosen` rival leads
    elsewhere, and is the last. The difference is less than an effect must take.
    A law that could do without one of its amplitudes is the choice of a simpler one that it
    contains.
    """
    rivals = [(r, p) for r, p in rivals if not r.as_simpler]
    groups: list[tuple[float, list[tuple[Rated, ForceModel]]]] = [(training.cost(taken), [])]
    costs = sorted((training.cost(point), i) for i, (_, point) in enumerate(rivals))
    for cost, i in costs:
        if cost > (1.0 + options.least_gain) * groups[-1][0]:
            groups.append((cost, []))
        groups[-1][1].append(rivals[i])
    own = chosen.placed.effect.effect_class
    others = [(r, p) for r, p in groups[0][1] if r.placed.effect.effect_class != own]
    found = []
    for group in (*(some for _, some in groups[1:]), others):
        if group:
            rival, point = min(group, key=lambda r: r[0].numbers)
            with_it = {**rated, rival.placed.effect.identity: rival}
            found.append(_State(point, _by_law(with_it, point), state.dropped, state.not_taken))
    return tuple(found)


def _new(table: Sequence[Effect], point: ForceModel) -> list[Effect]:
    """Return the effects of a table that may act beside those of a model."""
    asked = _asked(table, point)
    return [e for e in asked if not any(_exclude(e, p.effect) for p in point.placed)]


def _asked(table: Sequence[Effect], point: ForceModel) -> list[Effect]:
    """Return the effects of a table that are asked beside those of a model.

    A law is asked before and behind a lag: behind a slow one it is another force.
    """
    placed, lagging = point.placed, point.model.lagging
    there = {(p.effect.key, p.effect.where) for p in placed}
    some = [e for e in table if not e.before_lag or delayed(e, placed, lagging)]
    return [e for e in some if not e.beside or (e.beside, e.where) in there]


def _exclude(one: Effect, other: Effect) -> bool:
    """Return whether two effects are one, two dry frictions of a place, or a law and a simpler one.

    One of such laws may take the place of the other.
    """
    if one.where != other.where:
        return False
    nested = one.key in other.contains or other.key in one.contains or same_law(one, other)
    return nested or (_rubs(one) and _rubs(other))


def _rubs(effect: Effect) -> bool:
    """Return whether an effect is a dry friction, of which a DOF has one law.

    A spring that is dragged along is one too: the force of a Maxwell-slip element. So is a damping
    that levels off, of which friction would be a part.
    """
    return effect.effect_class == _FRICTION or effect.key.startswith(_ALSO)


def _without_idle(state: _State, training: Training, options: SearchOptions) -> _State:
    """Remove found effects that the criterion no longer confirms beside the others.

    A law is judged without the free forms, which contain most laws; a free form beside all.
    """
    while len(state.rated) > 1:
        idle = []
        for p in state.point.placed:
            if p.effect.identity in state.rated:
                others = tuple(
                    o for o in state.point.placed if o is not p and (is_free(p) or not is_free(o))
                )
                rest = Beside.of(replace(state.point, placed=others), training)
                rated = rated_beside(rest, rest, p, None)
                if not confirmed(rated, options):
                    idle.append((rated.gain.statistic, p))
        if not idle:
            break
        _, worst = min(idle, key=lambda pair: pair[0])
        state = _removed(state, worst, training)
    return state


def _removed(state: _State, placed: Placed, training: Training) -> _State:
    identity = placed.effect.identity
    rated = {k: r for k, r in state.rated.items() if k != identity}
    kept = tuple(p for p in state.point.placed if p is not placed)
    point = fit_numbers(training, replace(state.point, placed=kept))
    return _State(point, rated, (*state.dropped, identity), state.not_taken)


def _against_rivals(
    state: _State,
    asked: Sequence[str],
    named: Sequence[Effect],
    training: Training,
    options: SearchOptions,
    at_place: bool = False,
) -> _State:
    """Compare found effects with their rivals beside all others; take the best or simplest.

    asked: their identities. What others left hid by what an effect is told from its alternatives.
    at_place: whether all laws at the place of an effect are its rivals, also those that gained
    nothing while others were missing.
    """
    for identity in asked:
        own = next((p for p in state.point.placed if p.effect.identity == identity), None)
        if own is None or is_free(own):
            continue
        rated = state.rated[identity]
        kept = tuple(p for p in state.point.placed if p is not own)
        bare = replace(state.point, placed=kept)
        contenders = [e for r in state.rated.values() for e in r.contenders]
        known = {(e.key, e.where) for e in contenders}
        contenders += [e for e in named if (e.beside, e.where) in known]
        if at_place:
            contenders += [e for e in _asked(named, bare) if e.where == own.effect.where]
        rest = fit_numbers(training, bare)
        others = {e.identity: e for e in _new(contenders, bare) if not same_law(e, own.effect)}
        rivals = [own.effect, *_telling(rest, list(others.values()), training, options)]
        ranking = _with_present_numbers(rate(rest, rivals, training, options), own, rest, training)
        ranking = _as_contradicted(ranking, own, options)
        first = next((r for r in ranking if confirmed(r, options)), None)
        if first is None:
            continue
        if not any(confirmed(r, options) for r in ranking if r.placed.effect == own.effect):
            # From far, a line does not foretell it; but here it was confirmed.
            ranking = [replace(rated, placed=own, instead_of=None), *ranking]
        best, point = fitted_rivals(rest, first, ranking, training, options, named)[0]
        now = {k: r for k, r in state.rated.items() if k != identity}
        now[best.placed.effect.identity] = best
        state = replace(state, point=point, rated=_by_law(now, point))
    return state


def _with_present_numbers(
    ranking: Sequence[Rated], own: Placed, rest: ForceModel, training: Training
) -> list[Rated]:
    """Return a ranking beside the model `rest`, an effect that was found with the numbers that it
    has if these gain more there than those of a fit from its start values."""
    beside = Beside.of(rest, training)
    now = rated_beside(beside, beside, own, None)
    afresh = [r for r in ranking if r.placed.effect == own.effect]
    best = min([now, *afresh], key=by_gain)
    others = [r for r in ranking if r.placed.effect != own.effect]
    return sorted([best, *others], key=by_gain)


def _as_contradicted(ranking: Sequence[Rated], own: Placed, options: SearchOptions) -> list[Rated]:
    """Return a ranking that does not ask of the rivals of a found effect what its own is not asked.

    A record that contradicts it, beside the numbers that the model has without it, says nothing
    against a rival that it contradicts no more.
    """
    mine = next(r for r in ranking if r.placed.effect == own.effect).gain.others
    found = []
    for r in ranking:
        others = r.gain.others
        as_much = (mine <= 0.0) & (others > mine - options.agreement)
        asked = np.where(as_much & (r.placed.effect != own.effect), np.nan, others)
        found.append(replace(r, gain=replace(r.gain, others=asked)))
    return found


def _by_law(rated: Mapping[str, Rated], point: ForceModel) -> dict[str, Rated]:
    """Return the ratings of a model's effects, some of which fits moved before or behind a lag."""
    found = {}
    for p in point.placed:
        own = next((r for r in rated.values() if same_law(r.placed.effect, p.effect)), None)
        if own is not None:
            found[p.effect.identity] = own
    return found
