"""Test the trace of moves that end at rest, held by dry friction, and of shafts that twist."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from levid.benchmarks.trace.judged_plants import traced
from levid.benchmarks.trace.moves_and_shafts import KINDS, Kind, declared, flights, judged
from levid.benchmarks.trace.sticking_plants import TS, Shaft, Stage
from levid.config.model import ModelConfig
from levid.identification.trace.force_balance.rests import away_from_turns, moving_rows
from levid.identification.trace.force_trace.force_trace_summary import force_summary
from levid.identification.trace.force_trace.trace_imported import ForceTrace

PLANT = Stage(friction=2.4)
MODEL = KINDS["friction"]


def model(plant: Stage | Shaft, kind: Kind) -> ModelConfig:
    return declared(kind, plant, np.random.default_rng(0))


def named(trace: ForceTrace) -> set[tuple[str, tuple[str, ...], bool]]:
    summary = force_summary(trace)["effects"]
    return {(e["class"], tuple(e["where"]), e["evidence"]["doubtful"]) for e in summary}


def value(trace: ForceTrace, effect_class: str, name: str) -> tuple[float, float]:
    found = [e for e in force_summary(trace)["effects"] if e["class"] == effect_class]
    return found[0]["parameters"][name]["value"], found[0]["parameters"][name]["se"]


def test_friction_that_holds_a_stage_at_rest_is_named() -> None:
    """At rest its force follows the command, as a delay, a dead zone or a spring would have it."""
    trace = traced(model(PLANT, MODEL), flights(MODEL, PLANT, 1), TS)
    assert named(trace) == {("friction", ("x",), False)}
    friction, _ = value(trace, "friction", "friction")
    # 1 % for the corners of its force, which the low-pass of the balance rounds.
    assert friction == pytest.approx(PLANT.friction, rel=0.01)
    assert trace.found.point.model.values["kf"] == pytest.approx(PLANT.kf, rel=0.01)
    after = force_summary(trace)["validation"]["force_percent"]["after"]
    assert after < 1.5


def test_intervals_know_that_a_turn_with_friction_is_seen_early_or_late() -> None:
    """Below a limit the speed is round where it jumps: numbers were 4 standard errors off."""
    found = judged("friction", 69000)
    assert found.right
    assert len(found.inside) >= 3
    assert all(found.inside)


def test_two_effects_that_hide_each_other_are_both_named() -> None:
    """While both are missing, one record contradicts each of them, and a delay is left."""
    plant = Stage(friction=2.4, cogging=1.9)
    trace = traced(model(plant, MODEL), flights(MODEL, plant, 10), TS)
    assert named(trace) == {("friction", ("x",), False), ("cogging", ("x",), False)}
    assert value(trace, "cogging", "pitch")[0] == pytest.approx(plant.pitch, rel=0.01)


def test_backlash_between_two_masses_is_named_at_their_relative_motion() -> None:
    plant, kind = Shaft(half=5e-3), KINDS["gap"]
    trace = traced(model(plant, kind), flights(kind, plant, 13), TS)
    assert named(trace) == {("backlash", ("q1 - q2",), False)}
    assert value(trace, "backlash", "half")[0] == pytest.approx(plant.half, rel=0.03)
    assert trace.found.point.model.values["j2"] == pytest.approx(plant.j2, rel=0.02)


def test_shaft_that_twists_is_named_though_its_load_is_not_measured() -> None:
    plant, kind = Shaft(), KINDS["motor of a soft shaft"]
    trace = traced(model(plant, kind), flights(kind, plant, 16), TS)
    assert ("flexible_mode", ("q1",), False) in named(trace)
    hz, _ = value(trace, "flexible_mode", "frequency")
    assert hz == pytest.approx(np.sqrt(plant.k / plant.j2) / (2 * pi), rel=0.02)


def test_rests_are_told_from_moves_and_turns() -> None:
    sd, hz = np.array([1e-6]), 50.0
    t = TS * np.arange(4000)
    speed = np.where(t < 4.0, 0.05 * np.sin(2 * pi * t), 0.0)[:, None]
    noise = sd * 2 * pi * np.sqrt(2 * TS * hz**3 / 3)
    speed = speed + noise * np.random.default_rng(0).normal(size=speed.shape)
    moves = moving_rows(speed, sd, TS, hz, memory_s=0.05)
    # A turn is shorter than the memory; what is within half of it of a rest is of the rest.
    assert moves[: round(3.9 / TS)].all()
    assert not moves[round(4.0 / TS) :].any()
    assert moving_rows(np.zeros((100, 1)), sd, TS, hz, 0.05).all()  # what never moves stays in


def test_rows_around_turns_are_told_from_others() -> None:
    t = TS * np.arange(2000)
    speed = np.stack([np.sin(2 * pi * t), np.ones_like(t)], axis=1)
    away = away_from_turns(speed, TS, memory_s=0.05)
    assert away[:, 1].all()
    from_turn_s = np.abs((t + 0.25) % 0.5 - 0.25)
    from_turn_s[t > t[-1] - 0.1] = 0.025  # the last turn is behind the end
    assert not away[from_turn_s < 0.02, 0].any()
    assert away[from_turn_s > 0.03, 0].all()


def test_short_stop_is_told_from_a_turn() -> None:
    sd, hz = np.array([1e-6]), 50.0
    limit = 5.0 * float(sd[0]) * 2 * pi * np.sqrt(2 * TS * hz**3 / 3)
    ramp = np.linspace(-40.0 * limit, 40.0 * limit, 401)  # it turns within ten rows
    stop = np.concatenate([ramp[:201], np.zeros(30), ramp[201:]])
    still = np.full(100, 40.0 * limit)
    turned = np.concatenate([-still, ramp, still])[:, None]
    stopped = np.concatenate([-still, stop, still])[:, None]
    memory_s = 60 * TS
    assert moving_rows(turned, sd, TS, hz, memory_s).all()
    moves = moving_rows(stopped, sd, TS, hz, memory_s)[:, 0]
    # 30 rows and what it takes to turn, and half of the memory before and after.
    assert np.count_nonzero(~moves) == pytest.approx(30 + 10 + 60, abs=4)
    assert not moves[315]


def test_model_of_which_every_term_is_free_keeps_the_scale_of_its_input() -> None:
    """An equation holds times any factor: all numbers are in proportion to the one that is held."""
    known = model(PLANT, MODEL)
    mass = known.parameters["m"].model_copy(update={"fixed": False, "min": 0.1, "max": 50.0})
    free = known.model_copy(update={"parameters": {**known.parameters, "m": mass}})
    trace = traced(free, flights(MODEL, PLANT, 3), TS)
    held = free.parameters["kf"].value
    assert any(f"kf is held at {held:.4g}" in note for note in trace.notes)
    assert named(trace) == {("friction", ("x",), False)}
    friction, _ = value(trace, "friction", "friction")
    assert friction == pytest.approx(PLANT.friction * held / PLANT.kf, rel=0.01)
    assert trace.found.point.model.values["m"] == pytest.approx(PLANT.m * held / PLANT.kf, rel=0.01)


def test_model_without_a_free_parameter_is_traced() -> None:
    known = model(PLANT, MODEL)
    fixed = {k: p.model_copy(update={"fixed": True}) for k, p in known.parameters.items()}
    exact = {k: p.model_copy(update={"value": getattr(PLANT, k)}) for k, p in fixed.items()}
    trace = traced(known.model_copy(update={"parameters": exact}), flights(MODEL, PLANT, 3), TS)
    assert named(trace) == {("friction", ("x",), False)}
