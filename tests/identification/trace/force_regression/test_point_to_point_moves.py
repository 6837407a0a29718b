"""Test the trace of moves that end at rest, held by dry friction, and of shafts that twist."""

from __future__ import annotations

from collections.abc import Callable
from math import pi

import numpy as np
import pytest

from levid.benchmarks.trace.sticking_plants import TS, Shaft, Stage
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_regression.force_trace_summary import force_summary
from levid.identification.trace.force_regression.rests import moving_rows
from levid.identification.trace.force_regression.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.candidate_effects import all_effects

Array = np.ndarray

STAGE = """
levid: model
name: stage
dof: [{name: x, unit: m}]
inputs: [{name: i, unit: A}]
parameters:
  m: {value: 3.2, unit: kg, fixed: true}
  d: {value: 14, unit: N s/m, min: 0, max: 500}
  kf: {value: 48, unit: N/A, min: 1, max: 500}
M: [[m]]
D: [[d]]
K: [[0]]
B: [[kf]]
"""
FRICTION = 2.4
STICKS = Stage(friction=FRICTION)

SHAFT = """
levid: model
name: shaft
dof: [{name: q1, unit: rad}, {name: q2, unit: rad}]
inputs: [{name: t, unit: N m}]
parameters:
  j1: {value: 1.0e-3, unit: kg m^2, min: 1.0e-5, max: 0.1}
  j2: {value: 1.2e-3, unit: kg m^2, min: 1.0e-5, max: 0.1}
  d1: {value: 2.0e-3, unit: N m s/rad, min: 0, max: 1}
  k: {value: 15, unit: N m/rad, min: 0.01, max: 1000}
  c: {value: 0.01, unit: N m s/rad, min: 0, max: 1}
M: [[j1, 0], [0, j2]]
D: [[d1 + c, -c], [-c, c]]
K: [[k, -k], [-k, k]]
B: [[1], [0]]
"""
MOTOR = """
levid: model
name: motor
dof: [{name: q1, unit: rad}]
inputs: [{name: t, unit: N m}]
parameters:
  j: {value: 2.4e-3, unit: kg m^2, min: 1.0e-5, max: 0.1}
  d1: {value: 2.0e-3, unit: N m s/rad, min: 0, max: 1}
M: [[j]]
D: [[d1]]
K: [[0]]
"""


def traced(text: str, flights: list[tuple[Array, Array]]) -> ForceTrace:
    config = parse_text(text, ModelConfig, "model")
    records = [
        imported_trace_record(Experiment(f"r{n}", TS, u, y, {}, frozenset(), False), config)
        for n, (u, y) in enumerate(flights)
    ]
    return trace_records(records, config, all_effects, lambda *_: None)


def named(trace: ForceTrace) -> set[tuple[str, tuple[str, ...], bool]]:
    summary = force_summary(trace)["effects"]
    return {(e["class"], tuple(e["where"]), e["evidence"]["doubtful"]) for e in summary}


def value(trace: ForceTrace, effect_class: str, name: str) -> tuple[float, float]:
    found = [e for e in force_summary(trace)["effects"] if e["class"] == effect_class]
    return found[0]["parameters"][name]["value"], found[0]["parameters"][name]["se"]


@pytest.mark.parametrize("seed", [1, 2])
def test_friction_that_holds_a_stage_at_rest_is_named(seed: int) -> None:
    """At rest its force follows the command, as a delay, a dead zone or a spring would have it."""
    trace = traced(STAGE, [STICKS.flown(10 * seed + i) for i in range(3)])
    assert named(trace) == {("friction", ("x",), False)}
    friction, _ = value(trace, "friction", "friction")
    # 1 % for the corners of its force, which the low-pass of the balance rounds.
    assert friction == pytest.approx(FRICTION, rel=0.01)
    assert trace.found.point.model.values["kf"] == pytest.approx(STICKS.kf, rel=0.01)
    after = force_summary(trace)["validation"]["force_percent"]["after"]
    assert after < 1.5


def test_two_effects_that_hide_each_other_are_both_named() -> None:
    """While both are missing, one record contradicts each of them, and a delay is left."""
    plant = Stage(friction=FRICTION, cogging=1.9)
    trace = traced(STAGE, [plant.flown(30 + i) for i in range(3)])
    assert named(trace) == {("friction", ("x",), False), ("cogging", ("x",), False)}
    assert value(trace, "cogging", "pitch")[0] == pytest.approx(plant.pitch, rel=0.01)


def test_backlash_between_two_masses_is_named_at_their_relative_motion() -> None:
    plant = Shaft(half=5e-3)
    trace = traced(SHAFT, [plant.flown(40 + i) for i in range(3)])
    assert named(trace) == {("backlash", ("q1 - q2",), False)}
    assert value(trace, "backlash", "half")[0] == pytest.approx(plant.half, rel=0.03)
    assert trace.found.point.model.values["j2"] == pytest.approx(plant.j2, rel=0.02)


def test_shaft_that_twists_is_named_though_its_load_is_not_measured() -> None:
    plant = Shaft()
    flights = [plant.flown(50 + i) for i in range(3)]
    trace = traced(MOTOR, [(u, y[:, :1]) for u, y in flights])
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
    still: Callable[[float], Array] = lambda size: np.full((100, 1), size)  # noqa: E731
    assert moving_rows(still(0.0), sd, TS, hz, 0.05).all()  # nothing moves: nothing is left out


def test_model_of_which_every_term_is_free_keeps_the_scale_of_its_input() -> None:
    """An equation holds times any factor: all numbers are in proportion to the one that is held."""
    free = STAGE.replace("fixed: true", "min: 0.1, max: 50")
    trace = traced(free, [STICKS.flown(10 + i) for i in range(3)])
    assert any("kf is held at 48" in note for note in trace.notes)
    assert named(trace) == {("friction", ("x",), False)}
    friction, _ = value(trace, "friction", "friction")
    assert friction == pytest.approx(FRICTION * 48 / STICKS.kf, rel=0.01)
    assert trace.found.point.model.values["m"] == pytest.approx(STICKS.m * 48 / STICKS.kf, rel=0.01)
