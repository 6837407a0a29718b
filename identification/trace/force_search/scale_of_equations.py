"""Find equations whose terms are all free: no record tells their scale, so a parameter is held.

An equation of motion holds times any factor. If every term of it has a free parameter, the fit may
make all of them small together, with the force that the model lacks among them. Another equation
that shares a parameter may tell the scale, and how well depends on what the model lacks there: so
it is asked before the search, of an equation as right as declared ones are, and again after it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Effect
from ...greybox.free_parameters import FreeParameters
from ...rounding import ROUNDING, TINY, basis_of
from ..force_balance.force_record import GROUPS, ForceModel
from ..force_regression.candidate_fit import Beside
from ..force_regression.training_records import Evaluated, Training
from ..search_options import SearchOptions
from .rated_candidate import Fitted, gain_between

Array = NDArray[np.float64]


def with_scale(training: Training, at: Evaluated, told_from_model: float) -> Training:
    """Return the records with the scale of each equation set by what no number is free of.

    A force sets the scale if more than `told_from_model` of its square is beside the columns, and
    if as much of it is changed by no parameter.
    """
    changes, n = training.group_columns(at), len(at.power)
    columns, scale = training.columns(at, changes), np.zeros((len(GROUPS), n))
    fixed = replace(training, scaled_at=at.point).fixed
    for i in range(n):
        J = np.concatenate([c[:, :, i] for c in columns], axis=1).T
        for kind in range(len(GROUPS)):
            force, part = (
                np.concatenate([g[kind, :, i] for g in some]) for some in (at.groups, fixed)
            )
            least = told_from_model * float(force @ force)
            left = _beside(J, force)
            scale[kind, i] = left @ left > least and part @ part > least
    all_free = _all_free(at, changes, told_from_model)
    free = ~scale.any(axis=0) | all_free
    scale[:, free] = 0.0
    powers = np.sum([np.sum(g**2, axis=1) for g in at.groups], axis=0)
    first = np.where(powers[0] > 0.0, 0, np.argmax(powers, axis=0))
    scale[first[free], np.flatnonzero(free)] = 1.0
    return replace(
        training,
        scale=scale,
        reference=np.where(free, powers[first, np.arange(n)], np.nan),
        all_free=all_free,
        unset=free,
        scaled_at=at.point,
    )


def with_told_scales(
    start: ForceModel, training: Training, told_from_model: float
) -> tuple[ForceModel, dict[str, str]]:
    """Return a model with known scales, and the DOF for whose scale each parameter is held.

    A parameter with a prior is held at its declared value, else what multiplies an input, else the
    mass. The intervals of the others do not include the error of the one that is held.
    """
    point, held_for = replace(start, placed=()), dict[str, str]()
    for i, dof in enumerate(start.model.dof):
        at = training.at(point)
        held = _parameter_to_hold(at, training.group_columns(at), i, told_from_model)
        if held is not None:
            name = point.parameters.names[held]
            others = [k for k in range(len(point.parameters.names)) if k != held]
            point = replace(point, parameters=point.parameters.only(others))
            held_for[name] = dof
    return replace(start, parameters=point.parameters), held_for


def freed_if_told(
    found: ForceModel, declared: FreeParameters, training: Training, options: SearchOptions
) -> tuple[Training, ForceModel] | None:
    """Return the records and the model with one held parameter free, None if none of them is told.

    A parameter is told if another value takes as much of what the model misses as an effect must
    take. Before a large effect is found none may be: the missing force is larger than the part of
    the parameter. declared: all that the model's file leaves free.
    """
    for name in declared.names:
        if name in found.parameters.names:
            continue
        own = {*found.parameters.names, name}
        free = declared.only([i for i, one in enumerate(declared.names) if one in own])
        freed = replace(found, parameters=free)
        at = training.at(replace(freed, placed=()))
        anew = with_scale(training, at, options.told_from_model)
        if _confirmed(free.names.index(name), Beside.of(freed, anew), options):
            return anew, freed
    return None


def _confirmed(k: int, beside: Beside, options: SearchOptions) -> bool:
    """Return whether another value of parameter k is confirmed as an effect would be."""
    training, count = beside.training, len(beside.own[0])
    others = [i for i in range(count) if i != k]
    whole = training.judged(beside.at, beside.own, beside.groups)
    orders = others, [*others, k]
    before, after = (
        Fitted(whole.only(order), [c[order] for c in beside.own], beside.at.missing)
        for order in orders
    )
    gain = gain_between(before, after, len(others), 1, training.blocks)
    sure = gain.statistic > options.standard_errors and gain.elsewhere
    return sure and gain.share > options.least_gain


def explained_by_any_form(
    point: ForceModel, training: Training, told_from_model: float
) -> NDArray[np.bool_]:
    """Return the equations (n,) of which every term is free with a model's effects, so that a free
    form beside them explains all."""
    at = training.at(point)
    return training.all_free | _all_free(at, training.group_columns(at), told_from_model)


def without_scales(
    point: ForceModel, effects: Sequence[Effect], training: Training, told_from_model: float
) -> list[Effect]:
    """Return the effects without those that are the scale of an equation whose other terms are all
    free.

    Beside such an effect, as the gain of an actuator beside a free gain of the other one, the fit
    may make all terms small together: it takes all of the missing force, and is nothing.
    """
    at = training.at(point)
    own, n = training.group_columns(at), len(at.power)
    told = [i for i in range(n) if _way_of_scale(at, own, i, told_from_model) is None]

    def is_scale(effect: Effect) -> bool:
        changes = training.group_changes(point, effect, effect.grid[0])
        more = [np.concatenate(pair) for pair in zip(own, changes, strict=True)]
        return any(_way_of_scale(at, more, i, told_from_model) is not None for i in told)

    return [e for e in effects if not (e.linear and is_scale(e))]


def notes_on_held(found: ForceModel, held_for: Mapping[str, str]) -> tuple[str, ...]:
    """Return what each parameter that is still held for a DOF means for the other numbers."""
    return tuple(
        f"every term of the equation of {dof} has a free parameter, so that records do not tell "
        f"its scale: {name} is held at {found.model.values[name]:.4g}, and all other numbers are "
        "in proportion to it"
        for name, dof in held_for.items()
        if name not in found.parameters.names
    )


def _parameter_to_hold(
    at: Evaluated, changes: Sequence[Array], equation: int, told: float
) -> int | None:
    """Return the number of the parameter to hold for the scale of an equation, None if it is told.

    changes: of the groups by each parameter, each record (F, 3, rows, n).
    """
    free = at.point.parameters
    if not free.names:
        return None
    way = _way_of_scale(at, changes, equation, told)
    if way is None:
        return None
    share = np.abs(way)
    known = share * np.isfinite(free.prior_sd)
    if known.max() > 0.0:
        return int(np.argmax(known))
    kinds = np.stack([np.sum(c**2, axis=(-2, -1)) for c in changes]).sum(axis=0)  # (F, groups)
    for kind in (0, 1, 2):
        own = share * (kinds[:, kind] == kinds.max(axis=1)) * (kinds[:, kind] > 0.0)
        if own.max(initial=0.0) > 0.0:
            return int(np.argmax(own))
    return None


def _way_of_scale(
    at: Evaluated, changes: Sequence[Array], equation: int, told: float
) -> Array | None:
    """Return the part of each number (C,) in a change of all forces of an equation in proportion.

    None if these do not change so. changes: of the groups by each number, each record
    (C, 3, rows, n). Each equation counts relative to its own forces, as that is what its error is
    relative to.
    """
    force = np.sqrt(np.sum([np.sum(g * g, axis=(0, 1)) for g in at.groups], axis=0))
    size = np.maximum(force, TINY)
    each = [(c / size).reshape(len(c), math.prod(c.shape[1:])) for c in changes]
    J = np.concatenate(each, axis=1).T
    of_each = np.eye(len(at.power)) / size
    whole = [np.concatenate([(g * one).reshape(-1) for g in at.groups]) for one in of_each]
    target = whole.pop(equation)
    # The other equations may keep their forces, or scale as well.
    columns = np.column_stack([J, *whole])
    length = np.linalg.norm(columns, axis=0)
    length = np.where(length > 0.0, length, 1.0)
    way = np.linalg.lstsq(columns / length, target, rcond=ROUNDING)[0]
    left = target - columns / length @ way
    if left @ left > told * float(target @ target):
        return None
    return np.asarray(way[: J.shape[1]])


def _all_free(at: Evaluated, changes: Sequence[Array], told: float) -> NDArray[np.bool_]:
    """Return where a change of the parameters changes all forces in proportion (n,).

    changes: of the groups by each parameter. told: share of a squared force that must remain beside
    them for it not to be free.
    """
    found = []
    for i in range(len(at.power)):
        J = np.hstack([c[..., i].reshape(len(c), c.shape[1] * c.shape[2]) for c in changes]).T
        force = np.concatenate([g[..., i].reshape(-1) for g in at.groups])
        left = _beside(J, force)
        found.append(left @ left <= told * float(force @ force))
    return np.array(found)


def _beside(J: Array, force: Array) -> Array:
    """Return what columns (rows, C) leave of a force (rows,)."""
    Q = basis_of(J)
    return np.asarray(force - Q @ (Q.T @ force))
