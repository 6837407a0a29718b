"""Find the relative motions in a declared model: springs and dampers between its DOF."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from .declared_model import DeclaredModel
from .effects.base import Joint

Array = NDArray[np.float64]

_STEP = 1e-4
"""Relative change of a parameter for the derivative of a matrix that is linear in it."""
_ROUNDING = 1e-6


def joints(
    model: DeclaredModel, units: tuple[str, ...], force_units: tuple[str, ...]
) -> tuple[Joint, ...]:
    """Return the motions that a spring or damper of the model sees, and the DOF that it pushes.

    A parameter of a spring between two DOF enters K as p a b^T: b is the motion that stretches it,
    a the DOF on which its force acts. A matrix of rank one has one such spring. Springs of one DOF
    that act on it alone are no joints. A matrix of higher rank, as of springs that share a
    parameter, has a spring between each two DOF of one unit that it couples and no other does.
    """
    found: dict[str, Joint] = {}
    several = []
    for matrix in _matrices(model):
        _, sizes, Vt = np.linalg.svd(matrix)
        if sizes[0] == 0.0:
            continue
        if sizes[1] > _ROUNDING * sizes[0]:
            several.append(matrix)
            continue
        motion = _without_rounding(Vt[0])
        first = int(np.flatnonzero(motion)[0])
        motion = motion / motion[first]
        pull = _without_rounding(matrix[:, first])
        if np.count_nonzero(pull) < 2 and np.count_nonzero(motion) < 2:
            continue
        # A positive spring draws back.
        sign = -1.0 if pull @ motion < 0.0 else 1.0
        pull = sign * pull / abs(pull[first] or float(np.abs(pull).max()))
        name = _name(model.dof, motion, pull)
        found.setdefault(name, Joint(name, motion, pull, units[first], force_units[first]))
    alone = tuple(found.values())
    for i, j, sign in _couplings(several, units, alone):
        motion = np.zeros(len(units))
        motion[[i, j]] = 1.0, sign
        name = _name(model.dof, motion, motion)
        found.setdefault(name, Joint(name, motion, motion, units[i], force_units[i]))
    return tuple(found.values())


def _couplings(
    matrices: Iterable[Array], units: tuple[str, ...], known: Iterable[Joint]
) -> Iterator[tuple[int, int, float]]:
    """Yield the pairs of DOF of one unit that symmetric entries couple, other than known joints do,
    and the sign of the second one's motion in what stretches the spring."""
    joined = [np.flatnonzero(j.motion) for j in known]
    for matrix in matrices:
        most = _ROUNDING * float(np.abs(matrix).max())
        for i, j in combinations(range(len(units)), 2):
            entry = float(matrix[i, j])
            symmetric = abs(entry - float(matrix[j, i])) <= most < abs(entry)
            if symmetric and units[i] == units[j] and not any({i, j} <= {*k} for k in joined):
                yield i, j, float(np.sign(entry))


def _matrices(model: DeclaredModel) -> Iterator[Array]:
    """Yield the derivatives of K and D by each parameter, then K and D themselves."""
    if len(model.dof) < 2:
        return
    at = model.at()
    for name, value in model.values.items():
        step = _STEP * (abs(value) or 1.0)
        moved = _with(model, {name: value + step}).at()
        yield (moved.K - at.K) / step
        yield (moved.D - at.D) / step
    yield at.K
    yield at.D


def _with(model: DeclaredModel, values: Mapping[str, float]) -> DeclaredModel:
    return replace(model, values={**model.values, **values})


def _without_rounding(vector: Array) -> Array:
    most = float(np.abs(vector).max())
    return np.asarray(np.where(np.abs(vector) > _ROUNDING * most, vector, 0.0))


def _name(dof: tuple[str, ...], motion: Array, pull: Array) -> str:
    """Return a motion in words, such as 'q1 - 0.1 q2', and where it acts if not along itself."""
    text = ""
    for name, factor in zip(dof, motion.tolist(), strict=True):
        if factor:
            sign = " - " if factor < 0.0 else " + "
            size = "" if np.isclose(abs(factor), 1.0) else f"{abs(factor):.3g} "
            text += f"{sign if text else ''}{size}{name}"
    along = np.linalg.norm(motion) * np.linalg.norm(pull)
    if abs(float(motion @ pull)) > (1.0 - _ROUNDING) * along:
        return text
    on = " and ".join(name for name, factor in zip(dof, pull.tolist(), strict=True) if factor)
    return f"{text} on {on}"
