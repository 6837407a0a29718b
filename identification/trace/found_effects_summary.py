"""Summarise a trace: effects and errors as JSON, for the report, and as a model file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...config.model import EffectParameter, ModelConfig, ModelEffect
from ...model.effects.base import Effect, Placed, Places, located
from ...model.effects.flexible import sites
from ...model.effects.freeform import depends_on
from ..json_data import plain_json
from ..rounding import ROUNDING, TINY
from ..value_with_interval import percent
from .parameter_covariance import parameter_covariance
from .residual.free_run_error import (
    RecordError,
    percent_of_pose,
    pooled,
    pooled_pose,
    shares,
)
from .residual.random_vibration import RandomVibration
from .run_trace import Trace
from .search.backward_elimination import brought
from .search.predictive_criterion import certainty
from .search.tested_candidate import Round, Tried
from .search_options import SearchOptions

Array = NDArray[np.float64]

METRIC = "free_run"
ABOUT_METRIC = (
    "RMS of the free-run simulation error over rows and sensors, in standard deviations of the "
    "sensor noise, on held-out records; the first 5 s do not count (the first third of records "
    "under 15 s)"
)
NOISE_MOST = SearchOptions().explained_by_laws
"""Largest error over noise floor that counts as noise: the floor has errors of a few percent."""
SQUARE_MOST = SearchOptions().explained ** 2
_FAR_BELOW = 0.5
"""Mean square of one-step errors (1 for noise) below which the noise was overestimated."""
NO_STILL = (
    "No record is still: the noise is estimated from the fit's residual, which includes undeclared "
    "effects. The residual may be above noise; free forms and vibration were not searched."
)
_NO_FLOOR = "no record tells noise from the model's error"
_IN_DOUBT, _MUCH = 2.0, 0.5
"""Named effects are uncertain if the error stays above this multiple of the noise floor, and what
is left of the squared error above it is more than this share of what they explain."""
_MANY = 2
"""More coils than this with equal forces act like a force on the DOF."""
PERHAPS_A_PART = "perhaps a part of what is described freely there"
_MAX_ERROR_SHARE = 0.5
"""Largest standard error of an identified parameter, over its uncertainty before."""
_OUTSIDE = SearchOptions.least_gain
"""Share of the power on either side of a band that is stated."""


@dataclass(frozen=True)
class Evidence:
    """The evidence for an effect.

    statistic: agreement of the effect's prediction with the errors of held-out records (if `held`),
    else between time blocks of the training records, in standard deviations of chance. explained:
    reduction of the cross-validated squared error; `share`: the same over the squared error above
    noise at that time, None if that was negligible. `alternatives` are not told from it by these
    records. support: share of resamples of the blocks that choose the effect or one of these;
    shares: of resamples in which each of [the effect, *alternatives] fits best. left_share: of the
    one-step-ahead squared error above noise without the effect, the share that is left with it; 0
    where noise leaves as much.
    """

    statistic: float
    held: bool
    explained: float
    share: float | None
    round: int
    alternatives: tuple[Effect, ...]
    support: float = math.nan
    shares: tuple[float, ...] = ()
    left_share: float = 0.0


@dataclass(frozen=True)
class RandomForce:
    """A random force on a DOF, which a model cannot predict."""

    shaking: RandomVibration
    dof: str
    unit: str

    equation = "force = noise of this rms, nine tenths of its power between low and high"

    @property
    def name(self) -> str:
        """Name and place of the force, for display."""
        low, high = self.shaking.band_hz
        return f"Random vibration at {self.dof}, {low:.3g} to {high:.3g} Hz"


@dataclass(frozen=True)
class FoundEffect:
    """An effect in the model; `evidence` is None for a declared effect."""

    placed: Placed
    evidence: Evidence | None

    @property
    def effect(self) -> Effect:
        """The effect, without parameter values."""
        return self.placed.effect

    @property
    def unknown(self) -> bool:
        """Whether it is a free form, not a known effect."""
        return self.effect.effect_class == "unknown"

    @property
    def others(self) -> tuple[Effect, ...]:
        """Effects of another class or place that these records do not tell from it."""
        found = () if self.evidence is None else self.evidence.alternatives
        return tuple(e for e in found if _kind(e) != _kind(self.effect))

    @property
    def name(self) -> str:
        """Its name; those of effects that are not told from it follow."""
        return " or ".join(dict.fromkeys([self.effect.name, *(e.name for e in self.others)]))

    def parameters(self) -> dict[str, EffectParameter]:
        """Return values, standard errors and units by name, amplitudes first."""
        return _parameters(self.placed)


@dataclass(frozen=True)
class DofError:
    """Free-run error of one DOF in SI units; band_hz: middle 80 % of its power after the trace."""

    name: str
    unit: str
    before: float
    after: float
    floor: float
    band_hz: tuple[float, float]


@dataclass(frozen=True)
class Outcome:
    """The result of a trace in numbers.

    before, after, floor: ABOUT_METRIC of the refitted declared model, of the model with effects,
    and of noise alone. mean_square: of the one-step-ahead errors after the trace on held-out
    records, in noise variances; `beyond`: the same of the readings' non-rigid free-run error, None
    without redundant sensors. `nearest`: candidates of the last round that explain most, none
    significant. gone: accepted or declared effects removed because others explain the same.
    noise_measured: the noise comes from still records. unpredicted: share of the one-step-ahead
    errors above noise, before the search, that no effect takes; 0 where noise leaves as much.
    least_gain: that of the search options.
    """

    effects: tuple[FoundEffect, ...]
    declared: tuple[FoundEffect, ...]
    before: float
    after: float
    floor: float
    dof: tuple[DofError, ...]
    mean_square: float
    beyond: float | None
    nearest: tuple[Tried, ...]
    gone: tuple[str, ...]
    unsettled: tuple[str, ...]
    shaken: tuple[RandomForce, ...] = ()
    noise_measured: bool = True
    actuators: frozenset[str] = frozenset()
    """Names of actuators that are located by their input's name instead of coil:N."""
    unpredicted: float = 0.0
    least_gain: float = SearchOptions.least_gain

    @property
    def overrated(self) -> bool:
        """Whether the errors are far below the estimated sensor noise."""
        return self.mean_square < _FAR_BELOW

    @property
    def significant(self) -> bool:
        """Whether the residual is significantly above noise."""
        return self.mean_square > SQUARE_MOST or not self.after <= NOISE_MOST * self.floor

    @property
    def explained(self) -> float:
        """Share of the squared error above noise that the effects explain; nan if none."""
        there = self.before**2 - self.floor**2
        return 1.0 - (self.after**2 - self.floor**2) / there if there > 0.0 else math.nan

    def in_doubt(self, found: FoundEffect) -> bool:
        """Return whether a name is uncertain: much of what is there is left with it.

        If the true effect is not in the table, the best candidate still explains a part of it. What
        is left is large, or as large a share of what it takes as an effect must take itself: an
        equation that is right leaves far less.
        """
        left = 0.0 if found.evidence is None else found.evidence.left_share
        return not found.unknown and (bool(self.doubt) or left > self.least_gain)

    @property
    def doubtful(self) -> bool:
        """Whether any name is uncertain."""
        return any(self.in_doubt(f) for f in self.effects)

    @property
    def doubt(self) -> str:
        """Why all names are uncertain, in words; empty if they are not."""
        named = any(not f.unknown for f in self.effects)
        much = 1.0 - self.explained > _MUCH * self.explained
        if named and self.after > _IN_DOUBT * self.floor and much:
            return (
                f"the effects explain {percent(self.explained)} of the squared error above "
                f"noise, and {self.after / self.floor:.2g} times the noise floor is left"
            )
        return ""

    def perhaps_part_of(self, found: FoundEffect) -> tuple[str, ...]:
        """Return the free forms at the same place as a known effect.

        The effect may then be a part of what they describe, which is not in the table.
        """
        if found.unknown:
            return ()
        return tuple(
            f.effect.name
            for f in self.effects
            if f.unknown and _acts_at(found.effect.where, f.effect.where[0], self.actuators)
        )

    @property
    def verdict(self) -> str:
        """The result in a sentence."""
        parts = []
        for word, doubtful in (("found", False), ("perhaps", True)):
            names = [
                f.name + (f" ({PERHAPS_A_PART})" if self.perhaps_part_of(f) else "")
                for f in self.effects
                if not f.unknown and self.in_doubt(f) is doubtful
            ]
            if not doubtful:
                names += [s.name for s in self.shaken]
            if names:
                parts.append(f"{word}: {', '.join(names)}")
        forms = ", ".join(f.effect.name for f in self.effects if f.unknown)
        if forms:
            parts.append(f"not explained by a known effect, described by free forms: {forms}")
        if parts:
            return "; ".join([*parts, self.rest])
        if self.significant:
            return (
                "nothing found: the residual is above noise, and no known effect explains it "
                "significantly"
            )
        if self.overrated:
            return f"no conclusion: {self._too_loud}"
        if not self.noise_measured:
            return f"no effect added, and no conclusion on the residual: {_NO_FLOOR}"
        return "nothing found: the model explains the records down to the noise"

    @property
    def rest(self) -> str:
        """The residual, described in a clause."""
        if self.significant:
            return "the residual is above noise"
        if self.overrated:
            return f"no conclusion on the residual: {self._too_loud}"
        return "the residual is noise" if self.noise_measured else f"residual: {_NO_FLOOR}"

    @property
    def _too_loud(self) -> str:
        return (
            f"the one-step errors have only {self.mean_square:.2g} of the sensor noise variance, "
            "which was estimated at the readings' highest frequencies; sample faster, or excite "
            "less at these frequencies"
        )


def _acts_at(where: Sequence[str], place: str, actuators: frozenset[str]) -> bool:
    """Return whether an effect at `where` acts at a place; many equal coils act at every DOF."""
    if len(where) > _MANY and all(w.startswith("coil:") or w in actuators for w in where):
        return (":" not in place and place not in actuators) or place in where
    return place in where


def outcome(trace: Trace) -> Outcome:
    """Return the result of a trace in numbers."""
    placed = {p.effect.identity: p for p in trace.found.point.placed}
    started = {p.effect.identity: p.effect.name for p in trace.declared.placed}
    evidence = _evidence(trace)
    before, _ = pooled(trace.before)
    after, floor = pooled(trace.after)
    taken = {
        r.taken.effect.identity: r.taken.effect.name for r in trace.found.rounds if r.taken
    } | started
    held = trace.found.held
    last = trace.found.rounds[-1]
    return Outcome(
        tuple(FoundEffect(p, evidence.get(k)) for k, p in placed.items() if k not in started),
        tuple(FoundEffect(p, None) for k, p in placed.items() if k in started),
        before,
        after,
        floor,
        _dof_errors(trace),
        held.squares / max(float(held.count.sum()), 1.0),
        _beyond(trace),
        last.ranking[: SearchOptions.patience] if last.taken is None else (),
        tuple(n for key, n in taken.items() if key not in placed),
        tuple(e.name for e in trace.after if not e.settled),
        tuple(
            RandomForce(s, trace.places.dof[s.dof], trace.places.force_unit(s.dof))
            for s in trace.shaken
        ),
        trace.found.point.disturbance.measured,
        frozenset(w for w in trace.places.actuators if ":" not in w),
        _unpredicted(trace),
        trace.options.least_gain,
    )


def summary(trace: Trace) -> dict[str, Any]:
    """Return the result as dicts, lists, finite numbers and text, for JSON.

    effects: name, class, where, parameters with value, standard error and unit, support,
    alternatives and evidence of each; declared effects are not included. An effect that these
    records do not tell from one of another class or place has the class ambiguous. validation:
    metric, before, after, noise_floor (None if no still record measures the noise), percent (error
    over output, by DOF), noise_measured, per_dof, per_record. unexplained: the residual. None
    replaces nan.
    """
    found = outcome(trace)
    percent = {
        "before": dict(zip(trace.places.dof, percent_of_pose(trace.before), strict=True)),
        "after": dict(zip(trace.places.dof, percent_of_pose(trace.after), strict=True)),
    }
    plain: dict[str, Any] = plain_json(
        {
            "effects": [
                *(_effect(f, trace.places, found) for f in found.effects),
                *(_random(s) for s in found.shaken),
            ],
            "validation": {
                "metric": METRIC,
                "about": ABOUT_METRIC,
                "percent": percent,
                "before": found.before,
                "after": found.after,
                "noise_floor": found.floor if found.noise_measured else None,
                "noise_measured": found.noise_measured,
                "per_dof": {
                    d.name: {
                        "unit": d.unit,
                        "before": d.before,
                        "after": d.after,
                        "noise_floor": d.floor if found.noise_measured else None,
                    }
                    for d in found.dof
                },
                "per_record": _per_record(trace),
            },
            "unexplained": {
                "found": found.verdict,
                "significant": found.significant,
                "doubtful": found.doubtful,
                "unpredicted": found.unpredicted,
                "mean_square": found.mean_square,
                "per_dof": {
                    d.name: {
                        "times_noise_floor": d.after / d.floor if found.noise_measured else None,
                        "band_hz": list(d.band_hz),
                    }
                    for d in found.dof
                },
                "beyond_rigid": found.beyond,
                "nearest": [
                    {
                        **_named(t.effect),
                        "statistic_sd": certainty(t.agreement),
                        "squared_errors": t.gain,
                    }
                    for t in found.nearest
                ],
                "given_up": list(found.gone),
                "unsettled_records": list(found.unsettled),
            },
            "covariance": covariance_after(trace),
        }
    )
    return plain


def telling(found: FoundEffect) -> str:
    """Return the excitation that distinguishes an effect from its alternatives; '' if unknown."""
    if found.evidence is None:
        return found.effect.told_apart_by
    both = (found.effect, *found.evidence.alternatives)
    return "; or ".join(dict.fromkeys(e.told_apart_by for e in both if e.told_apart_by))


def _per_record(trace: Trace) -> list[dict[str, Any]]:
    """Return the errors of each held-out record by DOF, in SI units."""
    return [
        {
            "record": a.name,
            "seconds": a.seconds,
            "per_dof": {
                name: {
                    "before": float(np.sqrt(b.pose_squares[i])),
                    "after": float(np.sqrt(a.pose_squares[i])),
                    "noise_floor": (
                        float(np.sqrt(a.pose_floor[i]))
                        if trace.found.point.disturbance.measured
                        else None
                    ),
                }
                for i, name in enumerate(trace.places.dof)
            },
        }
        for b, a in zip(trace.before, trace.after, strict=True)
    ]


def model_after(trace: Trace) -> ModelConfig:
    """Return the refitted model with its effects, values with standard errors."""
    point, config = trace.found.point, trace.config
    free, values = point.parameters, point.values
    sd = trace.found.errors[: len(values)] * free.scale
    known = np.minimum(free.worth, free.prior_sd)
    parameters = dict(config.parameters)
    for name, value, error, before in zip(free.names, values, sd, known, strict=True):
        identified = error < _MAX_ERROR_SHARE * before
        parameters[name] = parameters[name].model_copy(
            update={"value": float(value), "se": float(error) if identified else None}
        )
    return config.model_copy(
        update={"parameters": parameters, "effects": tuple(model_effect(p) for p in point.placed)}
    )


def covariance_after(trace: Trace) -> dict[str, Any]:
    """Return the covariance of the parameters of `model_after`: see parameter_covariance."""
    names = list(trace.found.point.parameters.names)
    return parameter_covariance(model_after(trace), names, trace.found.correlations)


def model_effect(placed: Placed) -> ModelEffect:
    """Return the entry of a model file for an effect."""
    return ModelEffect(
        effect=placed.effect.key, where=placed.effect.where, parameters=_parameters(placed)
    )


def _parameters(placed: Placed) -> dict[str, EffectParameter]:
    quantities = (*placed.effect.amplitudes, *placed.effect.shape)
    values = (*placed.amplitudes, *placed.shape)
    errors = placed.standard_errors
    return {
        q.name: EffectParameter(value=value, unit=q.unit, se=_finite(errors.get(q.name)))
        for q, value in zip(quantities, values, strict=True)
    }


def _finite(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None


def _kind(effect: Effect) -> tuple[str, tuple[str, ...]]:
    return effect.effect_class, effect.where


def _share_of_excess(found: Round) -> float | None:
    """Return what was taken of the squared error above noise; None where there is none to share."""
    if found.taken is None or found.excess <= SearchOptions.accuracy * found.count:
        return None
    return float(min(found.taken.gain / found.excess, 1.0))


def _evidence(trace: Trace) -> dict[str, Evidence]:
    """Return the evidence of accepted effects, by identity."""
    point, train = trace.found.point, trace.found.train
    left = _left(trace)
    without = {
        p.effect.identity: left + max(cost, 0.0)
        for p, cost in zip(point.placed, brought(point, train), strict=True)
    }
    return {
        (key := r.taken.effect.identity): Evidence(
            certainty(r.taken.agreement),
            r.taken.agreement.asked,
            r.taken.gain,
            _share_of_excess(r),
            number,
            tuple(t.effect for t in r.alternatives),
            trace.found.supports.get(key, math.nan),
            r.shares or (1.0,),
            left / without[key] if left > 0.0 and key in without else 0.0,
        )
        for number, r in enumerate(trace.found.rounds, start=1)
        if r.taken is not None
    }


def _left(trace: Trace) -> float:
    """Return the squared prediction errors above noise, 0 if noise leaves as much.

    Free forms take a part of it too: what they describe is not left.
    """
    train = trace.found.train
    visible = trace.options.visible * float(train.count.sum())
    return train.excess if train.excess > visible else 0.0


def _unpredicted(trace: Trace) -> float:
    """Return the share of the first prediction errors above noise that is left."""
    first, count = trace.found.rounds[0], float(trace.found.train.count.sum())
    there = first.excess / first.count * count
    return _left(trace) / there if there > 0.0 else 0.0


def _dof_errors(trace: Trace) -> tuple[DofError, ...]:
    before, _ = pooled_pose(trace.before)
    after, floor = pooled_pose(trace.after)
    places = trace.places
    return tuple(
        DofError(
            name, unit, float(before[i]), float(after[i]), float(floor[i]), _band(trace.after, i)
        )
        for i, (name, unit) in enumerate(zip(places.dof, places.dof_units, strict=True))
    )


def _band(errors: Sequence[RecordError], dof: int) -> tuple[float, float]:
    """Return the band of the middle 80 % of the power of a DOF's error, in Hz."""
    freq_hz = max((e.freq_hz for e in errors), key=len)
    power = np.zeros(len(freq_hz))
    for e in errors:
        power += np.interp(freq_hz, e.freq_hz, e.psd[:, dof], right=0.0) * e.seconds
    share = np.cumsum(power) / max(float(power.sum()), TINY)
    low, high = (float(np.interp(at, share, freq_hz)) for at in (_OUTSIDE, 1.0 - _OUTSIDE))
    return low, high


def _beyond(trace: Trace) -> float | None:
    """Return the mean square non-rigid error: the readings' error without the pose's."""
    shape = trace.places.sensor_shape
    sensors, n = shape.shape
    inner = shape.T @ shape
    own = np.diag(inner)
    # If the sensor geometry couples the DOF, the squares of the pose are not sufficient.
    mixed = float(np.abs(inner - np.diag(own)).max()) > ROUNDING * float(own.max())
    if sensors <= n or mixed:
        return None
    sd = trace.found.point.disturbance.sensor_sd
    squares = np.array(
        [sensors * e.squares - float(own @ e.pose_squares) / sd**2 for e in trace.after]
    )
    return float(shares(trace.after) @ squares) / float(sensors - n)


def _effect(found: FoundEffect, places: Places, result: Outcome) -> dict[str, Any]:
    effect, why = found.effect, found.evidence
    evidence: dict[str, Any] = {"equation": effect.equation}
    if found.unknown:
        evidence["signals"] = [located(word, places) for word in depends_on(effect)]
    if why is not None:
        evidence |= {
            "statistic_sd": why.statistic,
            "asked": "held_out" if why.held else "blocks",
            "squared_errors": why.explained,
            "share": why.share,
            "round": why.round,
            "alternatives": [_named(e) for e in why.alternatives],
            "perhaps_part_of": list(result.perhaps_part_of(found)),
            "left_share": why.left_share,
            "doubtful": result.in_doubt(found),
        }
    evidence |= {"absorbed_by": effect.absorbed_by, "told_apart_by": telling(found)}
    parameters = {
        name: {"value": p.value, "se": p.se, "unit": p.unit}
        for name, p in found.parameters().items()
    }
    where = sites(found.placed, places)
    plain: dict[str, Any] = {
        "name": found.name,
        "class": "ambiguous" if found.others else effect.effect_class,
        "where": list(where),
        "parameters": parameters,
    }
    if why is not None:
        plain |= {"support": why.support, "alternatives": _members(found, why)}
    return {**plain, "evidence": evidence}


def _members(found: FoundEffect, why: Evidence) -> list[dict[str, Any]]:
    """Return the effects of an ambiguous one, each with its support; none if it is not."""
    if not found.others:
        return []
    kinds: dict[tuple[str, tuple[str, ...]], dict[str, Any]] = {}
    for effect, share in zip((found.effect, *why.alternatives), why.shares, strict=False):
        member = kinds.setdefault(_kind(effect), {**_named(effect), "support": 0.0})
        member["support"] += share * why.support
    return list(kinds.values())


def _random(force: RandomForce) -> dict[str, Any]:
    s = force.shaking
    low, high = s.band_hz
    return {
        "name": force.name,
        "class": "vibration",
        "where": [force.dof],
        "parameters": {
            "rms": {"value": s.rms, "se": s.se, "unit": force.unit},
            "low": {"value": low, "se": None, "unit": "Hz"},
            "high": {"value": high, "se": None, "unit": "Hz"},
        },
        "support": None,
        "alternatives": [],
        "evidence": {
            "equation": force.equation,
            "statistic_sd": s.statistic,
            "asked": "held_out",
            "absorbed_by": "noise of the force",
            "told_apart_by": "still records beside excited ones",
        },
    }


def _named(effect: Effect) -> dict[str, Any]:
    return {"name": effect.name, "class": effect.effect_class, "where": list(effect.where)}
