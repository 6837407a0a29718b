"""Test which parameters of two fits differ by more than their standard errors explain."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..subspace.response_uncertainty import SURE_95
from .holm_correction import holm
from .saved_result import SavedResult

SIGNIFICANT = 0.05
"""Probability that any parameter is called different by chance."""


@dataclass(frozen=True)
class Value:
    """A value with its standard error, None if it was not fitted."""

    value: float
    se: float | None


@dataclass(frozen=True)
class Difference:
    """A parameter of two results: b less a.

    effect: the effect that it belongs to, empty for a parameter of the matrices. se: the combined
    standard error, None if neither result fitted the parameter. p_value: corrected for the number
    of tests (Holm), None without a test.
    """

    name: str
    unit: str
    a: Value
    b: Value
    effect: str = ""
    p_value: float | None = None

    @property
    def difference(self) -> float:
        """The difference b - a."""
        return self.b.value - self.a.value

    @property
    def se(self) -> float | None:
        """Standard error of the difference of independent fits; None if neither has one."""
        errors = [v.se for v in (self.a, self.b) if v.se is not None]
        return math.hypot(*errors) if errors else None

    @property
    def in_errors(self) -> float | None:
        """The difference in combined standard errors."""
        return self.difference / self.se if self.se else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval of the difference."""
        if self.se is None:
            return None
        return self.difference - SURE_95 * self.se, self.difference + SURE_95 * self.se

    @property
    def significant(self) -> bool:
        """Whether the difference is more than chance, among all parameters compared."""
        return self.p_value is not None and self.p_value < SIGNIFICANT


def parameter_differences(a: SavedResult, b: SavedResult) -> tuple[Difference, ...]:
    """Return the parameters that both results have, those of common effects included.

    The errors of the two fits are taken as independent and normal. Parameters that neither result
    fitted are returned if their values differ. Priors that both fits share make the test
    conservative.
    """
    return _tested([*_of_matrices(a, b), *_of_effects(a, b)])


def whole_model_test(a: SavedResult, b: SavedResult) -> tuple[float, int, float] | None:
    """Return chi-square, degrees of freedom and p-value of equal parameters (Wald's test).

    The test covers the parameters that both results fitted, with their correlations. Return None if
    a result has no correlations, or no parameter is common.
    """
    from scipy.stats import chi2

    common = [name for name in a.free if name in b.free]
    if not common or not (a.correlated and b.correlated):
        return None
    places = [[r.free.index(name) for name in common] for r in (a, b)]
    S = sum(r.covariance[np.ix_(at, at)] for r, at in zip((a, b), places, strict=True))
    d = np.array([b.model.parameters[n].value - a.model.parameters[n].value for n in common])
    scale = np.sqrt(np.diag(S))
    try:
        value = float((d / scale) @ np.linalg.solve(S / np.outer(scale, scale), d / scale))
    except np.linalg.LinAlgError:  # parameters that are known in one combination only
        return None
    return value, len(common), float(chi2.sf(value, len(common)))


def _of_matrices(a: SavedResult, b: SavedResult) -> Iterator[Difference]:
    errors_a, errors_b = a.standard_errors, b.standard_errors
    for name, one in a.model.parameters.items():
        other = b.model.parameters.get(name)
        if other is None:
            continue
        found = Difference(
            name,
            one.unit,
            Value(one.value, errors_a.get(name)),
            Value(other.value, errors_b.get(name)),
        )
        if found.se is not None or found.difference:
            yield found


def _of_effects(a: SavedResult, b: SavedResult) -> Iterator[Difference]:
    others = b.effects
    for identity, (label, effect) in a.effects.items():
        if identity not in others:
            continue
        _, other = others[identity]
        for name, one in effect.parameters.items():
            if name in other.parameters:
                two = other.parameters[name]
                yield Difference(
                    name, one.unit, Value(one.value, one.se), Value(two.value, two.se), label
                )


def _tested(found: Sequence[Difference]) -> tuple[Difference, ...]:
    from scipy.stats import norm

    tests = [d for d in found if d.in_errors is not None and d.a.se and d.b.se]
    corrected = holm([2.0 * float(norm.sf(abs(d.in_errors or 0.0))) for d in tests])
    p_values = {id(d): float(p) for d, p in zip(tests, corrected, strict=True)}
    return tuple(Difference(d.name, d.unit, d.a, d.b, d.effect, p_values.get(id(d))) for d in found)
