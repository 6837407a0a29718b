"""Find the effects beside which the model's inertia or damping matrix is physically impossible.

Several mechanisms have the same transfer function. A load on a soft shaft beside a damping of
-100 N s/m has the transfer function of a passive force with memory, which is no law of the table:
an effect that needs a negative damper is not what its name says. Nor is an effect that takes the
place of an inertia, as a coupling does that turns one equation of motion into another one. A
stiffness may be negative, as that of a magnet, and so may a damping that the model file declares
negative.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ....model.declared_model import DeclaredModel
from ...rounding import DIFFERENCE, ROUNDING, TINY
from ..force_balance.force_record import ForceModel
from ..force_regression.gauss_newton_fit import fit_numbers
from ..force_regression.intervals import Uncertainty
from ..force_regression.training_records import Training
from ..force_search.search import Searched
from ..search_options import SearchOptions

Array = NDArray[np.float64]

_MOVING = {"M": ("inertia", 2), "D": ("damping", 1)}
"""In words, and the derivative of the position that each matrix multiplies."""


def impossible_matrices(
    found: Searched,
    declared: Mapping[str, float],
    training: Training,
    uncertainty: Uncertainty,
    options: SearchOptions,
) -> dict[str, tuple[str, ...]]:
    """Return, by the identity of each effect, what is impossible with it and not without it.

    It is said as "the damping at x is negative". Under the identity "" stands what is impossible in
    a model without effects.

    declared: values of the parameters in the model file. uncertainty: of the numbers of the found
    point.
    """
    point, negative = found.point, dict[_Matrix, str]()
    matrices = [] if point.model.scheduling else [_Matrix.of(n, training) for n in _MOVING]
    for matrix in matrices:
        least, along = matrix.smallest(point.model)
        was, _ = matrix.smallest(point.model.with_values(declared))
        dof = matrix.where(point, least * along, training, options)
        error = matrix.standard_error(point, along, uncertainty)
        if dof and was >= 0.0 > least + options.standard_errors * error:
            negative[matrix] = f"the {_MOVING[matrix.name][0]} at {', '.join(dof)} is negative"
    if not found.rated:
        return {"": tuple(negative.values())}
    inertia = next((m for m in matrices if m.name == "M"), None)
    vague = inertia is not None and not inertia.is_positive(point, uncertainty, options)
    caused = dict[str, tuple[str, ...]]()
    for rated in found.rated if negative or vague else ():
        identity = rated.placed.effect.identity
        others = tuple(p for p in point.placed if p.effect.identity != identity)
        without = fit_numbers(training, replace(point, placed=others))
        reasons = [
            words for matrix, words in negative.items() if matrix.smallest(without.model)[0] >= 0.0
        ]
        if vague and inertia is not None:
            positive = inertia.is_positive(without, Uncertainty.of(without, training, ()), options)
            reasons += ["the inertia may be zero"] if positive else []
        caused[identity] = tuple(reasons)
    return caused


@dataclass(frozen=True)
class _Matrix:
    """A matrix of a model, by its name, in the scale of what it multiplies: `size`, RMS by DOF."""

    name: str
    size: tuple[float, ...]

    @classmethod
    def of(cls, name: str, training: Training) -> _Matrix:
        signals = [r.varying(r.kept[_MOVING[name][1]]) for r in training.records]
        return cls(name, tuple(np.sqrt(np.mean(np.concatenate(signals) ** 2, axis=0)).tolist()))

    def scaled(self, model: DeclaredModel) -> Array:
        """Return its symmetric part (n, n), which takes power, in that scale."""
        own = getattr(model.at(), self.name)
        return np.asarray(0.5 * (own + own.T) * np.outer(self.size, self.size))

    def smallest(self, model: DeclaredModel) -> tuple[float, Array]:
        """Return its smallest eigenvalue, 0 for what is only rounding, and the vector (n,)."""
        values, vectors = np.linalg.eigh(self.scaled(model))
        rounding = ROUNDING * float(np.abs(values).max())
        return (0.0 if abs(values[0]) <= rounding else float(values[0])), vectors[:, 0]

    def where(
        self, point: ForceModel, scaled_force: Array, training: Training, options: SearchOptions
    ) -> list[str]:
        """Return the DOF at which a force (n,) in its scale matters beside those that act."""
        acting = np.concatenate([r.acting_force(point) for r in training.records])
        least = options.least_force * np.sqrt(np.mean(acting**2, axis=0))
        force = np.abs(scaled_force) / np.maximum(self.size, TINY)
        return [d for d, f, enough in zip(point.model.dof, force, least, strict=True) if f > enough]

    def is_positive(
        self, point: ForceModel, uncertainty: Uncertainty, options: SearchOptions
    ) -> bool:
        """Return whether its smallest eigenvalue is surely positive."""
        least, along = self.smallest(point.model)
        return least > options.standard_errors * self.standard_error(point, along, uncertainty)

    def standard_error(self, point: ForceModel, along: Array, uncertainty: Uncertainty) -> float:
        """Return the standard error of its eigenvalue with the vector `along` (n,)."""
        gradient = np.zeros(len(uncertainty.silent))
        steps = DIFFERENCE * np.maximum(np.abs(point.values), point.parameters.scale)
        for i, step in enumerate(steps):
            ends = (
                point.with_values(point.values + h * np.eye(len(steps))[i]) for h in (-step, step)
            )
            low, high = (along @ self.scaled(end.model) @ along for end in ends)
            gradient[i] = (high - low) / (2.0 * step)
        return float(uncertainty.standard_errors(gradient[None])[0])
