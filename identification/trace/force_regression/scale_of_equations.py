"""Find equations whose terms are all free: no record tells their scale, so a parameter is held.

An equation of motion holds times any factor. If every term of it has a free parameter, the fit may
make all of them small together, with the force that the model lacks among them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...rounding import ROUNDING, TINY
from .force_record import ForceModel
from .training_records import Evaluated, Training

Array = NDArray[np.float64]


def with_told_scales(
    start: ForceModel, training: Training, told_from_model: float
) -> tuple[ForceModel, tuple[str, ...]]:
    """Return a model with known scales, and a note for each parameter that is held for it.

    A parameter with a prior is held at its declared value, else what multiplies an input, else the
    mass. The intervals of the others do not include the error of the one that is held.
    """
    point, notes = replace(start, placed=()), []
    for i, dof in enumerate(start.model.dof):
        at = training.at(point)
        held = _parameter_to_hold(at, training.group_columns(at), i, told_from_model)
        if held is not None:
            name = point.parameters.names[held]
            others = [k for k in range(len(point.parameters.names)) if k != held]
            point = replace(point, parameters=point.parameters.only(others))
            notes.append(
                f"every term of the equation of {dof} has a free parameter, so that records do not "
                f"tell its scale: {name} is held at {point.model.values[name]:.4g}, and all other "
                "numbers are in proportion to it"
            )
    return replace(start, parameters=point.parameters), tuple(notes)


def _parameter_to_hold(
    at: Evaluated, changes: Sequence[Array], equation: int, told: float
) -> int | None:
    """Return the number of the parameter to hold for the scale of an equation, None if it is told.

    changes: of the groups by each parameter, each record (F, 3, rows, n). Each equation counts
    relative to its own forces, as that is what its error is relative to.
    """
    free = at.point.parameters
    if not free.names:
        return None
    force = np.sqrt(np.sum([np.sum(g * g, axis=(0, 1)) for g in at.groups], axis=0))
    size = np.maximum(force, TINY)
    J = np.concatenate([(c / size).reshape(len(c), -1) for c in changes], axis=1).T
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
    share = np.abs(way[: J.shape[1]])
    known = share * np.isfinite(free.prior_sd)
    if known.max() > 0.0:
        return int(np.argmax(known))
    kinds = np.stack([np.sum(c**2, axis=(-2, -1)) for c in changes]).sum(axis=0)  # (F, groups)
    for kind in (0, 1, 2):
        own = share * (kinds[:, kind] == kinds.max(axis=1)) * (kinds[:, kind] > 0.0)
        if own.max(initial=0.0) > 0.0:
            return int(np.argmax(own))
    return None
