"""Compare two results of identify or trace, and say whether they differ."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ..json_data import plain_json
from ..value_with_interval import value_with_interval
from .parameter_differences import (
    SIGNIFICANT,
    Difference,
    parameter_differences,
    whole_model_test,
)
from .response_differences import ResponseComparison, compare_responses
from .saved_result import SavedResult


@dataclass(frozen=True)
class OneSided:
    """An effect, random force or parameter that only one result has; values by name with unit."""

    name: str
    values: dict[str, str]


@dataclass(frozen=True)
class Comparison:
    """Differences of two results, b against a.

    parameters: those that both have. whole: chi-square, degrees of freedom and p-value of equal
    parameters; None without correlations. response: None if it cannot be compared, `notes` then say
    why. only_a, only_b: effects in one result alone. notes: what limits the comparison.
    """

    a: SavedResult
    b: SavedResult
    parameters: tuple[Difference, ...]
    whole: tuple[float, int, float] | None
    response: ResponseComparison | None
    only_a: tuple[OneSided, ...]
    only_b: tuple[OneSided, ...]
    notes: tuple[str, ...]

    @property
    def significant(self) -> tuple[Difference, ...]:
        """The parameters that differ by more than chance."""
        return tuple(d for d in self.parameters if d.significant)

    @property
    def tested(self) -> int:
        """Number of parameters that both results fitted."""
        return sum(d.p_value is not None for d in self.parameters)

    @property
    def verdict(self) -> str:
        """The answer in a sentence."""
        parts = []
        names = [f"{d.name} of {d.effect}" if d.effect else d.name for d in self.significant]
        if names:
            parts.append(
                f"{len(names)} of {self.tested} parameters differ by more than chance: "
                f"{', '.join(names)}"
            )
        elif self.whole is not None and self.whole[2] < SIGNIFICANT:
            parts.append("the models differ as a whole, but no single parameter does beyond chance")
        elif self.tested:
            parts.append(f"no parameter differs by more than chance ({self.tested} compared)")
        else:
            parts.append("no parameter has a standard error in both results: no test is possible")
        for side, found in (("A", self.only_a), ("B", self.only_b)):
            if found:
                parts.append(f"only {side} has: {', '.join(e.name for e in found)}")
        if self.shared_logs:
            parts.insert(0, "two results of the same logs: no change of the plant is shown")
        return "; ".join(parts)

    @property
    def shared_logs(self) -> int:
        """Number of logs that both results use."""
        return _shared_logs(self.a, self.b)


def compare(
    a: SavedResult, b: SavedResult, schedule: Mapping[str, float] | None = None
) -> Comparison:
    """Compare two results; responses at `schedule` (default: the declared values).

    Raises:
        ConfigError, ModelError: a model cannot be evaluated.
    """
    notes = list(_notes(a, b))
    found = compare_responses(a, b, schedule or {})
    if isinstance(found, str):
        notes.append(found)
    return Comparison(
        a,
        b,
        parameter_differences(a, b),
        whole_model_test(a, b),
        None if isinstance(found, str) else found,
        tuple(_one_sided(a, b)),
        tuple(_one_sided(b, a)),
        tuple(notes),
    )


def _shared_logs(a: SavedResult, b: SavedResult) -> int:
    return len(set(a.logs) & set(b.logs))


def _notes(a: SavedResult, b: SavedResult) -> Iterator[str]:
    shared = _shared_logs(a, b)
    if shared:
        yield (
            f"both results use {shared} log{'s' * (shared > 1)} in common: their errors are not "
            "independent, and the tests cannot show a change of the plant; compare results of "
            "different logs"
        )
    for side, r in (("A", a), ("B", b)):
        if r.free and not r.correlated:
            yield (
                f"{side}: no covariance in result.json: errors of its parameters are taken as "
                "independent, so the confidence band of its response is not exact"
            )
        edges = [
            name
            for name in r.free
            if r.model.parameters[name].value
            in (r.model.parameters[name].min, r.model.parameters[name].max)
        ]
        if edges:
            yield f"{side}: {', '.join(edges)} at a bound: its standard error is unreliable"
    if a.model.input != b.model.input:
        yield f"the models take different inputs between samples: {a.model.input}, {b.model.input}"
    if a.model.effects or b.model.effects:
        yield "the responses are those of the linear models, without their effects"


def _one_sided(one: SavedResult, other: SavedResult) -> Iterator[OneSided]:
    """Yield what `one` has and `other` has not."""
    known = other.effects
    for identity, (name, effect) in one.effects.items():
        if identity not in known:
            values = {n: _text(p.value, p.se, p.unit) for n, p in effect.parameters.items()}
            yield OneSided(name, values)
    for name, parameters in one.random_forces.items():
        if name not in other.random_forces:
            yield OneSided(
                name, {n: _text(p["value"], p["se"], p["unit"]) for n, p in parameters.items()}
            )


def _text(value: float, se: float | None, unit: str) -> str:
    return f"{value_with_interval(value, se)} {'' if unit == '1' else unit}".rstrip()


def comparison_summary(found: Comparison) -> dict[str, Any]:
    """Return the comparison as JSON data; None replaces nan."""
    response = found.response
    plain: dict[str, Any] = plain_json(
        {
            "a": str(found.a.path),
            "b": str(found.b.path),
            "verdict": found.verdict,
            "parameters": [
                {
                    "name": d.name,
                    "effect": d.effect or None,
                    "unit": d.unit,
                    "a": {"value": d.a.value, "se": d.a.se},
                    "b": {"value": d.b.value, "se": d.b.se},
                    "difference": d.difference,
                    "se": d.se,
                    "in_errors": d.in_errors,
                    "interval_95": d.interval,
                    "p_holm": d.p_value,
                    "significant": d.significant,
                }
                for d in found.parameters
            ],
            "whole": found.whole
            and dict(zip(("chi_square", "parameters", "p_value"), found.whole, strict=True)),
            "response": response
            and {
                "at": response.schedule,
                "band_hz": [response.freq_hz[0], response.freq_hz[-1]],
                "paths": [vars(path) for path in response.paths],
            },
            "only_a": [{"name": e.name, "values": e.values} for e in found.only_a],
            "only_b": [{"name": e.name, "values": e.values} for e in found.only_b],
            "notes": found.notes,
        }
    )
    return plain
