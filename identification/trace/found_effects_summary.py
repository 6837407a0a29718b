"""Summarise a trace of the rig: its outcome, and the same as JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...model.effects.base import Effect, Places, located
from ...model.effects.flexible import sites
from ...model.effects.freeform import depends_on
from ..json_data import plain_json
from ..rounding import ROUNDING, TINY
from .residual.free_run_error import (
    RecordError,
    percent_of_pose,
    pooled,
    pooled_pose,
    shares,
)
from .run_trace import Trace
from .search.backward_elimination import brought
from .search.predictive_criterion import certainty
from .search.tested_candidate import Round
from .search_options import SearchOptions
from .trace_outcome import DofError, Evidence, FoundEffect, Outcome, RandomForce, kind_of, telling
from .traced_model import covariance_after

Array = NDArray[np.float64]

METRIC = "free_run"
ABOUT_METRIC = (
    "RMS of the free-run simulation error over rows and sensors, in standard deviations of the "
    "sensor noise, on held-out records; the first 5 s do not count (the first third of records "
    "under 15 s)"
)
_OUTSIDE = SearchOptions.least_gain
"""Share of the power on either side of a band that is stated."""


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
        member = kinds.setdefault(kind_of(effect), {**_named(effect), "support": 0.0})
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
