"""Test free runs with the effects of plants other than the rig against numerical integration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.free_parameters import free_parameters
from levid.identification.greybox.prediction.noise_model import Noise
from levid.identification.trace.linearised.linearisation_point import WorkingPoint
from levid.identification.trace.records.record_from_log import TraceRecord, imported_places
from levid.identification.trace.records.sensor_and_amplifier_noise import Disturbance
from levid.identification.trace.residual.free_run_with_effects import free_run
from levid.model.effects.actuator_chain import same_law
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

INERTIA, DAMPER, SPRING = 0.02, 0.12, 8.0  # 3.2 Hz, damping 0.15
MODEL = f"""
levid: model
name: arm
dof: [{{name: angle, unit: rad}}]
inputs: [{{name: torque, unit: N m}}]
input: zoh
parameters:
  j: {{value: {INERTIA}, unit: kg m^2, min: 0.001, max: 1}}
  d: {{value: {DAMPER}, unit: N m s/rad, min: 0, max: 1}}
  k: {{value: {SPRING}, unit: N m/rad, min: 1, max: 100}}
M: [[j]]
D: [[d]]
K: [[k]]
"""
CONFIG = parse_text(MODEL, ModelConfig, "arm")
TS, ROWS, STEPS = 2e-3, 5000, 20
SD = 1e-7
TAIL_S = 0.03
PLACES = replace(imported_places(CONFIG), span_s=(0.0, ROWS * TS))
Added = Callable[[float, float, float], float]
"""Torque over angle, speed and the held command."""


class Play:
    """A part that is dragged along."""

    def __init__(self, stiffness: float, half: float) -> None:
        self._stiffness, self._half, self._at = stiffness, half, 0.0

    def __call__(self, q: float, _v: float, _u: float) -> float:
        self._at = min(max(self._at, q - self._half), q + self._half)
        return -self._stiffness * (q - self._at)


def after_plays(*shares: float, r: float) -> Added:
    """Return what play operators of half widths r, 3 r, 9 r take of a command."""
    plays = [Play(share, ratio * r) for share, ratio in zip(shares, (1.0, 3.0, 9.0), strict=True)]
    return lambda _q, v, u: sum(one(u, v, 0.0) for one in plays)


class Load:
    """A load behind a gap."""

    def __init__(
        self, mass: float, frequency_hz: float, damping: float, half: float, slowing: float
    ) -> None:
        self._mass, self._w, self._damping = mass, 2 * np.pi * frequency_hz, damping
        self._half, self._slowing, self._at, self._rate = half, slowing, 0.0, 0.0

    def __call__(self, q: float, v: float, _u: float) -> float:
        # Called twice a step, at its begin and its middle.
        x, h = self._at - q, 0.5 * TS / STEPS
        stretched = x - min(max(x, -self._half), self._half)
        pull = self._w**2 * stretched
        pull += 2 * self._damping * self._w * (self._rate - v) * (stretched != 0.0)
        self._rate -= h * (pull + self._slowing * self._rate)
        self._at += h * self._rate
        return self._mass * pull


class InTime:
    """A force that depends on the time."""

    def __init__(self, force: Callable[[float, float, float, float], float]) -> None:
        self._force, self._time_s = force, 0.0

    def __call__(self, q: float, v: float, u: float) -> float:
        # Called twice a step, at its begin and its middle.
        found = self._force(self._time_s, q, v, u)
        self._time_s += 0.5 * TS / STEPS
        return found


def growing(t: float, q: float, v: float, u: float) -> float:
    """Return the force of a mass that grows by 0.004 a second."""
    more = 0.004 * t
    return -more * (u - DAMPER * v - SPRING * q) / (INERTIA + more)


class Chain:
    """A lag with a law before and one behind it."""

    def __init__(self, before: Callable[[float], float], behind: Callable[[float], float]) -> None:
        self._before, self._behind = before, behind
        self._speed = before(float(command()[0]))  # steady at the begin

    def __call__(self, _q: float, _v: float, u: float) -> float:
        # Called twice a step, at its begin and its middle.
        now, end = self._speed, self._before(u)
        self._speed = end + (now - end) * float(np.exp(-0.5 * TS / STEPS / TAIL_S))
        return self._behind(now) - u


def magnet(c: float, y0: float, i0: float, sign: float, a: int, b: int) -> Added:
    def added(q: float, _v: float, u: float) -> float:
        x, r = sign * q / y0, u / i0
        return c * ((1 + r) ** a / (1 + x) ** b - 1 - a * r + b * x)

    return added


def two_magnets(c: float, y0: float, i0: float, sign: float) -> Added:
    def added(q: float, _v: float, u: float) -> float:
        x, r = sign * q / y0, u / i0
        pulls = ((1 + r) / (1 + x)) ** 2 - ((1 - r) / (1 - x)) ** 2
        return c * (pulls / 4 - r + x)

    return added


def stribeck(_q: float, v: float, _u: float) -> float:
    s = np.tanh(v / 0.5)
    return float(-(0.2 + 0.3 * np.exp(-((v / 1.0) ** 2)) + 0.1 * s) * s)


def power(size: float, x: float, p: float) -> float:
    return float(size * np.sign(x) * abs(x) ** p)


CASES: dict[str, tuple[tuple[float, ...], tuple[float, ...], Callable[[], Added]]] = {
    "damping.eddy_current": ((0.3,), (2.0,), lambda: lambda q, v, u: -0.3 * v / (1 + v * v / 4)),
    "damping.falling": ((0.3,), (2.0,), lambda: lambda q, v, u: -0.3 * v / (1.0 + abs(v) / 2.0)),
    "damping.asymmetric": ((0.05,), (), lambda: lambda q, v, u: -0.05 * abs(v)),
    "friction.coulomb_asymmetric": (
        (0.3, 0.1), (0.5,),
        lambda: lambda q, v, u: -(0.3 + 0.1 * np.tanh(v / 0.5)) * np.tanh(v / 0.5),
    ),
    "damping.power[3]": ((0.3,), (1.5,), lambda: lambda q, v, u: power(-0.3, v / 3.0, 1.5)),
    "damping.root[3]": ((0.3,), (0.5,), lambda: lambda q, v, u: power(-0.3, v / 3.0, 0.5)),
    "stiffness.power[0.3]": ((0.5,), (5.0,), lambda: lambda q, v, u: power(-0.5, q / 0.3, 5.0)),
    "stiffness.snap_through": (
        (0.5,), (0.05, 0.2), lambda: lambda q, v, u: 0.5 * np.tanh((q - 0.05) / 0.2),
    ),
    "stiffness.leveling_off": (
        (0.5,), (0.05, 0.2), lambda: lambda q, v, u: -0.5 * np.tanh((q - 0.05) / 0.2),
    ),
    "stiffness.exponential.up": (
        (0.2,), (0.3,), lambda: lambda q, v, u: -0.2 * (np.exp(q / 0.3) - 1.0),
    ),
    "stiffness.exponential.down": (
        (0.2,), (0.3,), lambda: lambda q, v, u: 0.2 * (np.exp(-q / 0.3) - 1.0),
    ),
    "permanent_magnet.y2.opens[0]": (
        (1.0,), (2.5,), lambda: lambda q, v, u: (1.0 + q / 2.5) ** -2 - 1.0,
    ),
    "permanent_magnet.y4.closes[0]": (
        (-0.3,), (2.5,), lambda: lambda q, v, u: (
            -0.3 * ((1.0 - q / 2.5) ** -4 - 1.0)
        ),
    ),
    "friction.leveling_off": ((0.3,), (0.5,), lambda: lambda q, v, u: -0.3 * v / (abs(v) + 0.5)),
    "friction.stribeck_asymmetric": ((0.2, 0.3, 0.1), (1.0, 0.5), lambda: stribeck),
    "gravity.sine": (
        (3.0, 1.0), (), lambda: lambda q, v, u: -(3.0 * np.sin(q) + 1.0 * np.cos(q)),
    ),
    "gravity.sine_for_stiffness": (
        (3.0, 1.0, 2.0), (), lambda: lambda q, v, u: 2.0 * q - 3.0 * np.sin(q) - 1.0 * np.cos(q),
    ),
    "backlash.dead_zone_spring": (
        (6.0,), (0.05, 0.1),
        lambda: lambda q, v, u: -6.0 * (q - 0.05 - min(max(q - 0.05, -0.1), 0.1)),
    ),
    "backlash.dead_zone_contact": (
        (6.0, 0.02), (0.05, 0.1),
        lambda: lambda q, v, u: (
            -6.0 * (q - 0.05 - min(max(q - 0.05, -0.1), 0.1)) - 0.02 * v * (abs(q - 0.05) > 0.1)
        ),
    ),
    "stiffness.stop.above": (
        (6.0, 0.02), (0.1,),
        lambda: lambda q, v, u: -6.0 * max(q - 0.1, 0.0) - 0.02 * v * (q > 0.1),
    ),
    "stiffness.stop.below": (
        (6.0, 0.02), (-0.1,),
        lambda: lambda q, v, u: -6.0 * min(q + 0.1, 0.0) - 0.02 * v * (q < -0.1),
    ),
    "backlash.play": ((2.0,), (0.1,), lambda: Play(2.0, 0.1)),
    "damping.drift": ((0.01,), (), lambda: InTime(lambda t, q, v, u: -0.01 * t * v)),
    "stiffness.drift": ((0.2,), (), lambda: InTime(lambda t, q, v, u: -0.2 * t * q)),
    "inertia.drift": ((0.004,), (), lambda: InTime(growing)),
    "damping.warming": (
        (0.05,), (4.0,), lambda: InTime(lambda t, q, v, u: -0.05 * np.exp(-t / 4.0) * v),
    ),
    "friction.warming": (
        (0.2, 0.3), (0.5, 4.0),
        lambda: InTime(lambda t, q, v, u: -(0.2 + 0.3 * np.exp(-t / 4.0)) * np.tanh(v / 0.5)),
    ),
    "flexible_mode.load": ((0.002,), (15.0, 0.1, 3.0), lambda: Load(0.002, 15.0, 0.1, 0.0, 3.0)),
    "backlash.load": ((0.002,), (15.0, 0.4, 0.01, 3.0), lambda: Load(0.002, 15.0, 0.4, 0.01, 3.0)),
    "cogging.position": (
        (0.3, 0.2), (0.4,),
        lambda: lambda q, v, u: (
            0.3 * np.sin(2 * np.pi * q / 0.4) + 0.2 * np.cos(2 * np.pi * q / 0.4)
        ),
    ),
    "cogging.position.another": (
        (0.3, 0.2), (0.4,),
        lambda: lambda q, v, u: (
            0.3 * np.sin(2 * np.pi * q / 0.4) + 0.2 * np.cos(2 * np.pi * q / 0.4)
        ),
    ),
    "magnetic_force.i2_y2.opens[0,0]": (
        (1.0,), (2.5, 20.0), lambda: magnet(1.0, 2.5, 20.0, 1.0, 2, 2),
    ),
    "magnetic_force.i2_y2.closes[0,0]": (
        (1.0,), (2.5, 20.0), lambda: magnet(1.0, 2.5, 20.0, -1.0, 2, 2),
    ),
    "magnetic_force.i2_y4.opens[0,0]": (
        (1.0,), (3.0, 20.0), lambda: magnet(1.0, 3.0, 20.0, 1.0, 2, 4),
    ),
    "magnetic_force.i2_y4.closes[0,0]": (
        (-1.0,), (3.0, 20.0), lambda: magnet(-1.0, 3.0, 20.0, -1.0, 2, 4),
    ),
    "magnetic_force.i1_y4.opens[0,0]": (
        (1.0,), (3.0, 5.0), lambda: magnet(1.0, 3.0, 5.0, 1.0, 1, 4),
    ),
    "magnetic_force.i1_y4.closes[0,0]": (
        (1.0,), (3.0, 5.0), lambda: magnet(1.0, 3.0, 5.0, -1.0, 1, 4),
    ),
    "magnetic_force.differential.opens[0,0]": (
        (1.0,), (2.5, 20.0), lambda: two_magnets(1.0, 2.5, 20.0, 1.0),
    ),
    "magnetic_force.differential.closes[0,0]": (
        (1.0,), (2.5, 20.0), lambda: two_magnets(1.0, 2.5, 20.0, -1.0),
    ),
    "stiffness.preloaded": (
        (0.5,), (0.05, 0.02), lambda: lambda q, v, u: (
            -0.5 * min(max((q - 0.05) / 0.02, -1.0), 1.0)
        ),
    ),
    "actuator.hysteresis": ((0.2, 0.1, 0.05), (0.3,), lambda: after_plays(0.2, 0.1, 0.05, r=0.3)),
    "actuator.square[1.7]": ((0.8,), (), lambda: lambda q, v, u: 0.8 * u * (abs(u) / 1.7 - 1.0)),
    "actuator.squared": ((0.1,), (), lambda: lambda q, v, u: 0.1 * u * abs(u)),
    "actuator.quadratic": ((0.1,), (), lambda: lambda q, v, u: 0.1 * u * u),
    "actuator.root": ((0.2,), (), lambda: lambda q, v, u: power(0.2, u, 0.5)),
    "actuator.cubic": ((0.02,), (), lambda: lambda q, v, u: 0.02 * u**3),
    "actuator.asymmetric": ((0.1,), (), lambda: lambda q, v, u: 0.1 * abs(u)),
    "actuator.times_speed": ((-0.02,), (), lambda: lambda q, v, u: -0.02 * u * v),
    "actuator.load_friction": (
        (0.2,), (0.5,), lambda: lambda q, v, u: -0.2 * abs(u) * np.tanh(v / 0.5),
    ),
    "actuator.quantised": ((1.0,), (1.5,), lambda: lambda q, v, u: 1.5 * np.round(u / 1.5) - u),
    # The model has no lag.
    "actuator.squared_after_lag": ((0.1,), (), lambda: lambda q, v, u: 0.1 * u * abs(u)),
    "actuator.quadratic_after_lag": ((0.1,), (), lambda: lambda q, v, u: 0.1 * u * u),
}  # fmt: skip


EXTENT = Extent((0.3,), (3.0,), 0.3, 5.0, 0.0)


@cache
def command() -> np.ndarray:
    """Return a command of twenty sines between 0.5 and 10 Hz, 1.5 N m rms."""
    rng, t = np.random.default_rng(1), np.arange(ROWS) * TS
    omega, phase = 2 * np.pi * rng.uniform(0.5, 10.0, 20), rng.uniform(0, 2 * np.pi, 20)
    return 1.5 / np.sqrt(10) * np.sin(np.multiply.outer(t, omega) + phase).sum(axis=-1)


def record(added: Added) -> TraceRecord:
    """Return the plant under held commands, by the midpoint rule with 20 steps per period."""
    u, y, h = command(), np.empty((ROWS, 1)), TS / STEPS
    q = v = 0.0

    def acceleration(q: float, v: float, held: float) -> float:
        return (held + added(q, v, held) - DAMPER * v - SPRING * q) / INERTIA

    for k in range(ROWS):
        y[k] = q
        for _ in range(STEPS):
            a = acceleration(q, v, u[k])
            b = acceleration(q + 0.5 * h * v, v + 0.5 * h * a, u[k])
            q, v = q + h * (v + 0.5 * h * a), v + h * b
    y += SD * np.random.default_rng(3).standard_normal(y.shape)
    e = Experiment("made", TS, u[:, None], y, {}, frozenset(), False, 0, None)
    nothing, still = np.zeros((ROWS, 1)), np.zeros((ROWS, 3))
    return TraceRecord(
        e, PLACES, np.arange(ROWS) * TS, y, u[:, None], nothing, still, still, None, "made"
    )


def relative_error(made: TraceRecord, *placed: Placed) -> float:
    noise = Disturbance(Noise.independent(np.array([1e-8]), np.array([SD**2])), SD, measured=True)
    point = WorkingPoint(
        declared_model(CONFIG), free_parameters(CONFIG), placed, noise, "zoh", trust=1.0
    )
    run = free_run(point, made)
    assert run.settled
    rest = slice(run.counts_from, None)
    y = made.experiment.y[rest]
    return float(np.sqrt(np.mean((run.q[rest] - y) ** 2)) / y.std())


@pytest.mark.parametrize("key", CASES)
def test_free_run_with_an_effect_agrees_with_integration(key: str) -> None:
    amplitudes, shape, added = CASES[key]
    (effect,) = (e for e in all_effects(PLACES, EXTENT) if e.key == key)
    made = record(added())
    without = relative_error(made)
    error = relative_error(made, Placed(effect, shape, amplitudes))
    assert without > 0.01
    # Where a dragged part or a load is at the begin is not known: about k half of force.
    begun = ("backlash.play", "backlash.load", "actuator.hysteresis")
    # A root is infinitely steep at rest, within a row.
    steep = 2e-4 if key.startswith("damping.root") else 1e-4
    assert error < (5e-3 if key in begun else steep)


def clipped(u: float) -> float:
    return min(max(u, -2.0), 2.0)


def with_dead_zone(u: float) -> float:
    return u - min(max(u, -0.5), 0.5)


LAG = ("actuator_lag", (TAIL_S,), (TAIL_S,))
CHAINS = {
    "propeller": (
        lambda u: u, lambda s: s + 0.1 * s * abs(s),
        (LAG, ("actuator.squared_after_lag", (0.1,), ())),
    ),
    "valve": (lambda u: u, with_dead_zone, (LAG, ("dead_zone.after_lag", (1.0,), (0.5,)))),
    "bridge": (with_dead_zone, lambda s: s, (LAG, ("dead_zone", (1.0,), (0.5,)))),
    "amplifier": (clipped, lambda s: s, (LAG, ("saturation", (1.0,), (2.0, 1000.0)))),
    "magnet": (lambda u: u, clipped, (LAG, ("saturation.after_lag", (1.0,), (2.0, 1000.0)))),
    "three parts": (
        with_dead_zone, clipped,
        (("saturation.after_lag", (1.0,), (2.0, 1000.0)), LAG, ("dead_zone", (1.0,), (0.5,))),
    ),
}  # fmt: skip
"""Laws before and behind a lag, and the effects, in any order."""


@pytest.mark.parametrize("name", CHAINS)
def test_a_command_passes_the_parts_of_an_actuator_one_by_one(name: str) -> None:
    before, behind, parts = CHAINS[name]
    table = {e.key: e for e in all_effects(PLACES, EXTENT)}
    made = record(Chain(before, behind))
    placed = [Placed(table[key], shape, amplitudes) for key, amplitudes, shape in parts]
    assert relative_error(made) > 0.1
    # A command behind a lag is held over each period at its mean: a limit within it is not seen.
    assert relative_error(made, *placed) < 1e-3
    # In the other order it would be another plant.
    twins = [
        replace(p, effect=e)
        for p in placed
        for e in table.values()
        if e != p.effect and same_law(e, p.effect)
    ]
    kept = [p for p in placed if not any(same_law(t.effect, p.effect) for t in twins)]
    assert relative_error(made, *kept, *twins) > 1e-2


def test_every_effect_of_imported_plants_is_simulated() -> None:
    families = ("gravity.", "backlash.", "cogging.", "magnetic_force.", "actuator.")
    listed = {e.key for e in all_effects(PLACES, EXTENT)}
    assert {k for k in listed if k.startswith(families) or "asymmetric" in k} - set(CASES) == {
        "stiffness.asymmetric"
    }
