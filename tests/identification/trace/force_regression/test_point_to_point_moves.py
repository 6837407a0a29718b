"""Test the trace of moves that end at rest, held by dry friction, and of shafts that twist.

The plants are integrated here, and stick as a real one does: at rest, friction balances any force
up to its level.
"""

from __future__ import annotations

from collections.abc import Callable
from math import copysign, cos, pi, sin

import numpy as np
import pytest

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_regression.force_trace_summary import force_summary
from levid.identification.trace.force_regression.rests import moving_rows
from levid.identification.trace.force_regression.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.candidate_effects import all_effects

Array = np.ndarray
TS, STEPS = 2e-3, 10

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
M, D, KF, FRICTION = 3.2, 17.0, 40.0, 2.4
PITCH, COGGING = 0.03, 1.9

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
J1, J2, D1, K, C, HALF = 9e-4, 1.1e-3, 2.4e-3, 20.0, 0.012, 5e-3


def moves(seed: int, reach: float, rows: int) -> Array:
    """Return set points (rows,): smooth moves between random places, each followed by a rest."""
    rng = np.random.default_rng(seed)
    found, at = [np.zeros(100)], 0.0
    while sum(map(len, found)) < rows:
        there, n = rng.uniform(-reach, reach), int(rng.uniform(120, 300))
        s = np.linspace(0.0, 1.0, n)
        found += [at + (there - at) * (10 * s**3 - 15 * s**4 + 6 * s**5), np.full(n, there)]
        at = there
    return np.concatenate(found)[:rows]


def stage(seed: int, friction: float, cogging: float, rows: int = 5000) -> tuple[Array, Array]:
    """Return currents and positions (rows, 1) of a stage that a PID controller moves."""
    set_points = moves(seed, 0.08, rows)
    u, y = np.zeros((rows, 1)), np.zeros((rows, 1))
    x = v = integral = last = 0.0
    h = TS / STEPS
    for k in range(rows):
        error = set_points[k] - x
        integral += 1500.0 * TS * error
        u[k] = current = (900.0 * error + integral + 40.0 * (error - last) / TS) / KF
        y[k], last = x, error
        for _ in range(STEPS):
            force = KF * current - D * v + cogging * sin(2 * pi * x / PITCH + 0.4)
            if v == 0.0 and abs(force) <= friction:
                continue
            after = v + h * (force - copysign(friction, v or force)) / M
            v = 0.0 if friction and v * after < 0.0 else after
            x += h * v
    return u, y + np.random.default_rng(seed).normal(0.0, 3e-7, y.shape)


def shaft(seed: int, half: float, rows: int = 5000) -> tuple[Array, Array]:
    """Return torques (rows, 1) and both angles (rows, 2) of a motor that swings a load."""
    rng = np.random.default_rng(seed)
    hz, phase = rng.uniform(0.5, 18.0, 12), rng.uniform(0.0, 2 * pi, 12)
    u, y = np.zeros((rows, 1)), np.zeros((rows, 2))
    q1 = q2 = v1 = v2 = 0.0
    h = TS / STEPS
    for k in range(rows):
        torque = 0.06 * sum(cos(2 * pi * f * k * TS + p) for f, p in zip(hz, phase, strict=True))
        u[k], y[k] = torque - 0.05 * q1, (q1, q2)
        for _ in range(STEPS):
            twist = q1 - q2
            touching = abs(twist) > half
            contact = K * (twist - copysign(half, twist)) if touching else 0.0
            contact += C * (v1 - v2) if touching or not half else 0.0
            v1 += h * (u[k, 0] - D1 * v1 - contact) / J1
            v2 += h * contact / J2
            q1, q2 = q1 + h * v1, q2 + h * v2
    return u, y + rng.normal(0.0, 2e-6, y.shape)


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
    trace = traced(STAGE, [stage(10 * seed + i, FRICTION, 0.0) for i in range(3)])
    assert named(trace) == {("friction", ("x",), False)}
    friction, _ = value(trace, "friction", "friction")
    # 1 % for the corners of its force, which the low-pass of the balance rounds.
    assert friction == pytest.approx(FRICTION, rel=0.01)
    assert trace.found.point.model.values["kf"] == pytest.approx(KF, rel=0.01)
    after = force_summary(trace)["validation"]["force_percent"]["after"]
    assert after < 1.5


def test_two_effects_that_hide_each_other_are_both_named() -> None:
    """While both are missing, one record contradicts each of them, and a delay is left."""
    trace = traced(STAGE, [stage(30 + i, FRICTION, COGGING) for i in range(3)])
    assert named(trace) == {("friction", ("x",), False), ("cogging", ("x",), False)}
    assert value(trace, "cogging", "pitch")[0] == pytest.approx(PITCH, rel=0.01)


def test_backlash_between_two_masses_is_named_at_their_relative_motion() -> None:
    trace = traced(SHAFT, [shaft(40 + i, HALF) for i in range(3)])
    assert named(trace) == {("backlash", ("q1 - q2",), False)}
    assert value(trace, "backlash", "half")[0] == pytest.approx(HALF, rel=0.03)
    assert trace.found.point.model.values["j2"] == pytest.approx(J2, rel=0.02)


def test_shaft_that_twists_is_named_though_its_load_is_not_measured() -> None:
    flights = [shaft(50 + i, 0.0) for i in range(3)]
    trace = traced(MOTOR, [(u, y[:, :1]) for u, y in flights])
    assert ("flexible_mode", ("q1",), False) in named(trace)
    hz, _ = value(trace, "flexible_mode", "frequency")
    assert hz == pytest.approx(np.sqrt(K / J2) / (2 * pi), rel=0.02)


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
    trace = traced(free, [stage(10 + i, FRICTION, 0.0) for i in range(3)])
    assert any("kf is held at 48" in note for note in trace.notes)
    assert named(trace) == {("friction", ("x",), False)}
    friction, _ = value(trace, "friction", "friction")
    assert friction == pytest.approx(FRICTION * 48 / KF, rel=0.01)
    assert trace.found.point.model.values["m"] == pytest.approx(M * 48 / KF, rel=0.01)
