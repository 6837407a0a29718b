"""Dead zone and saturation of coils and amplifiers.

A bridge amplifier has a dead zone around zero. A magnetic circuit saturates softly, an amplifier
hard (Mohan, Undeland, Robbins, *Power Electronics*, 2003, ch. 8): F / (1 + |F/limit|^p)^(1/p) is
soft for p = 2 and hard for large p. Of other plants than the rig a hyperbolic tangent is asked as
well, with which magnetic circuits are often described (Takacs, *Mathematics of Hysteretic
Phenomena*, 2003). Each coil carries about 8 N of weight, so the effect of a dead zone is visible
only if a command reaches the zone. Signature: a force error that depends on one coil's command,
equally at all frequencies: like a gain error at small amplitudes, with harmonics at large ones. On
the rig, dead zone and saturation act on the force, after the coils' lag. Elsewhere they act on the
command, and if the actuator has a lag they may act behind it: a valve's overlap does so on the
spool, a magnet saturates by its current.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_coil
from .lag_and_hysteresis_recursions import held_for, lagged_within
from .operating_range import Extent
from .point_force_conversion import forces

Coils = tuple[int, ...]

_SHARES, _WEIGHTS = ((0.0694318442, 0.3300094782, 0.6699905218, 0.9305681558),
                     (0.1739274226, 0.3260725774, 0.3260725774, 0.1739274226))  # fmt: skip
"""Gauss-Legendre nodes and weights on a period, four points."""
_LIMITS = (0.85, 0.5, 0.25)
"""Start values of a limit over the largest command. The rig reports commands at its limits; other
plants may be driven far into saturation, where a squared characteristic would fit better at 0.85.
"""
_HARD = 1000.0
"""Hardness from which on a limit is a hard one: its corner is within a thousandth of the limit."""
_TOLD_APART = "excitation of the coils one by one, at two amplitudes"


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return dead zone and saturation of every coil, and common ones of all coils."""
    found = []
    limits = _LIMITS[:1] if places.beam else _LIMITS
    single = [((c,), "") for c in range(places.coils)]
    every, several = tuple(range(places.coils)), places.coils > 1 and places.one_command_unit
    together = [(every, ", same for all coils")] if several else []
    orders = (True,) if places.beam else (False, True)
    for (coils, which), behind in product(single + together, orders):
        twin = behind and not places.beam
        key, suffix = ".after_lag" if twin else "", which + (" behind its lag" if twin else "")
        after = ", F the command after the lag" if twin else ""
        where = tuple(places.actuator(c) for c in coils)
        unit, largest = places.command_unit(coils[0]), extent.largest_command(coils)
        found += [
            Effect(
                "dead_zone" + key,
                places.worded(f"Dead zone of a coil{suffix}"),
                "dead_zone",
                where,
                "force = F - depth clip(F, -width, width)" + after,
                (Quantity("depth", "1", 0.0, 1.0),),
                partial(_dead_zone, coils=coils, behind=behind),
                (Quantity("width", unit, 1e-3 * largest, largest, log=True),),
                ((0.15 * largest,), (0.4 * largest,)),
                absorbed_by="if no command comes near zero: constant force",
                told_apart_by=places.worded(_TOLD_APART),
                shape_of_unit_amplitude=_whole_dead_zone,
                before_lag="dead_zone" if twin else "",
            ),
            Effect(
                "saturation" + key,
                places.worded(f"Saturation of a coil{suffix}"),
                "saturation",
                where,
                "force = F - depth (F - F / (1 + |F/limit|^p)^(1/p)), p = hardness" + after,
                (Quantity("depth", "1", 0.0, 1.0),),
                partial(_saturation, coils=coils, behind=behind),
                (
                    Quantity("limit", unit, 0.1 * largest, 10 * largest, log=True),
                    Quantity("hardness", "1", 1.0, _HARD, log=True, ends=True),
                ),
                tuple((share * largest, 6.0) for share in limits),
                absorbed_by="not visible far below the limit",
                told_apart_by=places.worded(_TOLD_APART),
                shape_of_unit_amplitude=_whole_saturation,
                before_lag="saturation" if twin else "",
            ),
        ]
        if not places.beam:
            found.append(
                Effect(
                    "saturation.tanh" + key,
                    places.worded(f"Soft saturation of a coil{suffix}"),
                    "saturation",
                    where,
                    "force = F - depth (F - limit tanh(F/limit))" + after,
                    (Quantity("depth", "1", 0.0, 1.0),),
                    partial(_soft_saturation, coils=coils, behind=behind),
                    (Quantity("limit", unit, 0.1 * largest, 10 * largest, log=True),),
                    tuple((share * largest,) for share in (1.0, *limits)),
                    absorbed_by="not visible far below the limit",
                    told_apart_by=places.worded(_TOLD_APART),
                    shape_of_unit_amplitude=_whole_soft_saturation,
                    before_lag="saturation.tanh" if twin else "",
                )
            )
    return found


def _dead_zone(
    signals: Signals, shape: Sequence[float], *, coils: Coils, behind: bool
) -> list[Term]:
    return [_lost(signals, coils, lambda F: np.clip(F, -shape[0], shape[0]), behind)]


def _saturation(
    signals: Signals, shape: Sequence[float], *, coils: Coils, behind: bool
) -> list[Term]:
    limit, hardness = shape

    def lost(F: Array) -> Array:
        # Logarithms avoid the overflow of a large ratio to a high power.
        log_ratio = hardness * np.log(np.maximum(np.abs(F) / limit, 1e-12))
        return np.asarray(-F * np.expm1(-np.logaddexp(0.0, log_ratio) / hardness))

    return [_lost(signals, coils, lost, behind)]


def _soft_saturation(
    signals: Signals, shape: Sequence[float], *, coils: Coils, behind: bool
) -> list[Term]:
    limit = shape[0]
    return [_lost(signals, coils, lambda F: F - limit * np.tanh(F / limit), behind)]


def _whole_soft_saturation(depth: Sequence[float], shape: Sequence[float]) -> tuple[float, ...]:
    """Return the shape with the same loss far below the limit: depth F (F / limit)^2 / 3."""
    return (shape[0] / float(depth[0]) ** 0.5,) if depth[0] > 0.0 else tuple(shape)


def _whole_dead_zone(_depth: Sequence[float], shape: Sequence[float]) -> tuple[float, ...]:
    return tuple(shape)


def _whole_saturation(depth: Sequence[float], shape: Sequence[float]) -> tuple[float, ...]:
    """Return the shape with the same loss far below the limit: depth F (F / limit)^p / p."""
    limit, hardness = shape
    return limit * float(depth[0]) ** (-1.0 / hardness) if depth[0] > 0.0 else limit, hardness


def _lost(signals: Signals, coils: Coils, lost: Callable[[Array], Array], behind: bool) -> Term:
    """Return the term of a force loss lost(F), by its mean over each period.

    behind: whether it is lost behind the model's lag. A term is lagged like a command, so the
    returned commands have this mean after the lag.
    """
    held = signals.coil[:, list(coils)]
    if behind and signals.lag_s > 0.0:
        held = np.stack([_held(signals, F, lost) for F in held.T], axis=1)
    else:
        held = lost(held)
    if len(coils) == 1:
        return on_coil(signals, coils[0], -held[:, 0])
    return Term(held=forces(-held, signals.places.coil_shape[list(coils)]))


def _held(signals: Signals, F: Array, lost: Callable[[Array], Array]) -> Array:
    mean = np.zeros(signals.rows)
    for share, weight in zip(_SHARES, _WEIGHTS, strict=True):
        mean += weight * lost(lagged_within(F, signals.lag_s, signals.Ts_s, share))
    return held_for(mean, signals.lag_s, signals.Ts_s)
