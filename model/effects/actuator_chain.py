"""Chain of an actuator: the parts that a command passes one after the other.

First what limits or bends the command, then a limit of its rate, then what makes it late, then what
acts on the force itself, and at its end a force that depends on the command: a magnet's current is
what the lag leaves. Of a saturation before a lag, the lag delays what the saturation leaves: the
sum of what each of them does to the command would be another plant. Laws that are not in the chain,
and all of the rig's, are added: there each is small, and their order does not show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .base import Array, Effect, Placed, Signals, Term

_ON_COMMAND = ("dead_zone", "saturation", "actuator_nonlinearity")
_ON_FORCE = ("thermal_drift", "force_constant", "torque_ripple", "coil_gain")
_LAGS = ("rate_limit", "actuator_lag")
_LOADED = "actuator.load_friction"
"""A friction by its class, but of what the command does."""
_ORDER = (
    *_ON_COMMAND,
    *_LAGS,
    "delay",
    *(f"{kind} behind" for kind in _ON_COMMAND),
    *_ON_FORCE,
    _LOADED,
    "magnetic_force",
)
"""Classes of effects in the order in which a command passes them. Where a delay is among them does
not show."""
_TINY = float(np.finfo(float).tiny)
_SMALL = 1e-3
"""Change of a command over the command, with which later parts are differentiated."""


def in_chain(
    placed: Sequence[Placed], signals: Signals
) -> tuple[list[tuple[Placed, Signals]], Array]:
    """Return effects, each with the signals that reach it, in the order of the chain.

    Commands reach it as the earlier ones leave them; those not in the chain come first. The second
    result are the commands (N, C) that leave the chain.
    """
    if signals.places.beam:
        return [(p, signals) for p in placed], signals.coil
    found, there = [], signals
    for p in sorted(placed, key=lambda p: _position(p.effect)):
        inside = _position(p.effect)[0] >= 0
        found.append((p, there if inside else signals))
        held = p.term(there).held if inside else None
        there = there if held is None else replace(there, coil=there.coil + held)
    return found, there.coil


def beside(effect: Effect, placed: Sequence[Placed]) -> tuple[Placed, ...]:
    """Return the effects that are in a chain with an effect, itself among them if it is placed."""
    if _position(effect)[0] < 0:
        return ()
    where = set(effect.where)
    return tuple(p for p in placed if _position(p.effect)[0] >= 0 and where & set(p.effect.where))


def reaching(effect: Effect, placed: Sequence[Placed], signals: Signals) -> Signals:
    """Return the signals that reach an effect, of those that enter the chain with other effects."""
    if signals.places.beam:
        return signals
    before = [p for p in beside(effect, placed) if _position(p.effect) < _position(effect)]
    return replace(signals, coil=in_chain(before, signals)[1]) if before else signals


def passed_on(
    effect: Effect, terms: Sequence[Term], placed: Sequence[Placed], signals: Signals
) -> list[Term]:
    """Return the terms of an effect as the later parts of the chain pass them on.

    Linear ones do so exactly, of others it is the derivative. signals: as they enter the chain.
    """
    if signals.places.beam:
        return list(terms)
    along, _ = in_chain(beside(effect, placed), signals)
    later = [(p, there) for p, there in along if _position(p.effect) > _position(effect)]
    return [t if t.held is None else _behind(t, t.held, later) for t in terms]


def same_law(one: Effect, other: Effect) -> bool:
    """Return whether two effects are one law at one place, before or behind a lag."""
    keys = {e.before_lag or e.key for e in (one, other)}
    return one.where == other.where and len(keys) == 1


def delayed(effect: Effect, placed: Sequence[Placed], lagging: bool) -> bool:
    """Return whether an effect's command has a lag, so that it may act before or behind that.

    lagging: whether the model has a lag of all commands.
    """
    late = {p.effect.where for p in placed if _kind(p.effect) in _LAGS}
    return lagging or effect.where in late


def orders(
    placed: Sequence[Placed], table: Sequence[Effect], lagging: bool
) -> list[tuple[Placed, ...]]:
    """Return effects in the orders that they may have: one law before or behind its lag at a time.

    The first are the effects as they are; with no lag, all are before it. table: of all effects.
    lagging: whether the model has a lag of all commands.
    """
    now, others = list(placed), []
    for i, p in enumerate(placed):
        other = next((e for e in table if e != p.effect and same_law(e, p.effect)), None)
        if other is None:
            continue
        moved = replace(p, effect=other)
        if delayed(p.effect, placed, lagging):
            others.append((i, moved))
        elif p.effect.before_lag:
            now[i] = moved
    return [tuple(now), *((*now[:i], moved, *now[i + 1 :]) for i, moved in others)]


def _behind(term: Term, change: Array, later: Sequence[tuple[Placed, Signals]]) -> Term:
    """Return a term with what its change of the commands (N, C) becomes behind later parts."""
    force = term.force
    for p, there in later:
        step = (
            _SMALL * float(np.linalg.norm(there.coil)) / max(float(np.linalg.norm(change)), _TINY)
        )
        if not 0.0 < step < np.inf:  # one of them is zero
            break
        moved = p.term(replace(there, coil=there.coil + step * change))
        before = p.term(there)
        if moved.held is not None and before.held is not None:
            change = change + (moved.held - before.held) / step
        if moved.force is not None and before.force is not None:
            more = (moved.force - before.force) / step
            force = more if force is None else force + more
    return replace(term, held=change, force=force)


def _position(effect: Effect) -> tuple[int, str]:
    """Return where in the chain an effect is; a negative number if it is not in it."""
    kind = _kind(effect)
    return _ORDER.index(kind) if kind in _ORDER else -1, effect.identity


def _kind(effect: Effect) -> str:
    if effect.key == _LOADED:
        return _LOADED
    return f"{effect.effect_class} behind" if effect.before_lag else effect.effect_class
