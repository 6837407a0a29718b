"""Test the trace of plants whose largest effect moves the model's first numbers far off."""

from __future__ import annotations

from collections.abc import Callable
from math import exp, sin

import numpy as np
import pytest

from levid.benchmarks.trace.judged_plants import traced
from levid.benchmarks.trace.moves_and_shafts import KINDS, declared, flights
from levid.benchmarks.trace.sticking_plants import TS, Shaft
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_trace.force_trace_outcome import force_outcome
from levid.identification.trace.force_trace.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.candidate_effects import all_effects

pytestmark = pytest.mark.long
Array = np.ndarray

ARM = """
levid: model
name: arm
dof: [{name: q, unit: rad}]
inputs: [{name: u, unit: N m}]
input: zoh
parameters:
  j: {value: 0.069, unit: kg m^2, min: 0.001, max: 10}
  d: {value: 0.065, unit: N m s/rad, min: 0, max: 10}
  k: {value: 1.2, unit: N m/rad, fixed: true}
M: [[j]]
D: [[d]]
K: [[k]]
"""
CYLINDER = """
levid: model
name: cylinder
dof: [{name: x, unit: m}]
inputs: [{name: u, unit: V}]
input: zoh
parameters:
  b: {value: 5, unit: m/s^2/V, min: 0, max: 100}
  d: {value: 38, unit: 1/s, min: 0, max: 1000}
  tau: {value: 0.007, unit: s, min: 0, max: 0.1}
M: [[1]]
D: [[d]]
K: [[0]]
B: [[b]]
lag_s: tau
"""
MOTOR = """
levid: model
name: motor
dof: [{name: q, unit: rad}]
inputs: [{name: i, unit: A}]
input: zoh
parameters:
  d: {value: 0.0034, unit: N m s/rad, min: 0, max: 1}
  kt: {value: 0.135, unit: N m/A, min: 0.01, max: 1}
M: [[0.002]]
D: [[d]]
K: [[0]]
B: [[kt]]
"""


def sines(seed: int, rows: int, Ts_s: float, low_hz: float, high_hz: float) -> Array:
    """Return twenty sines (rows,) of unit variance."""
    rng, t = np.random.default_rng(seed), np.arange(rows) * Ts_s
    hz, phase = rng.uniform(low_hz, high_hz, 20), rng.uniform(0.0, 2 * np.pi, 20)
    return np.sin(2 * np.pi * np.multiply.outer(t, hz) + phase).sum(axis=1) / np.sqrt(10.0)


def flown(
    acceleration: Callable[[float, float, float], float],
    command: Callable[[int, float, float], float],
    rows: int,
    Ts_s: float,
    noise: float,
    seed: int,
    steps: int = 8,
) -> tuple[Array, Array]:
    """Return held commands and readings (rows, 1), by the midpoint rule; `command` knows the row,
    the reading and the last one."""
    u, y = np.zeros((rows, 1)), np.zeros((rows, 1))
    errors = noise * np.random.default_rng(seed).normal(size=rows)
    q = v = last = 0.0
    h = Ts_s / steps
    for k in range(rows):
        y[k] = q + errors[k]
        u[k] = now = command(k, y[k, 0], last)
        last = y[k, 0]
        for _ in range(steps):
            half = v + 0.5 * h * acceleration(q, v, now)
            v += h * acceleration(q + 0.5 * h * v, half, now)
            q += h * half
    return u, y


def named(trace: ForceTrace) -> dict[str, dict[str, float]]:
    """Return the values of all effects by key; none may be in doubt."""
    assert not force_outcome(trace).doubtful
    return {
        p.effect.key: {q.name: v for q, v in zip(p.quantities, p.values, strict=True)}
        for p in trace.found.point.placed
    }


def test_gravity_is_found_in_place_of_a_stiffness_that_is_held() -> None:
    """Of a sine less the line that stood for it, neither fits without the other."""

    def acceleration(q: float, v: float, u: float) -> float:
        return (u - 0.08 * v - 1.9 * sin(q + 0.05)) / 0.06

    records = []
    for seed in (1, 2):
        wanted = 1.2 * sines(seed, 2500, 5e-3, 0.05, 0.8)
        records.append(
            flown(
                acceleration,
                lambda k, q, last, w=wanted: 12.0 * (w[k] - q) - 0.9 * (q - last) / 5e-3,
                *(2500, 5e-3, 1e-6, seed),
            )
        )
    trace = traced(parse_text(ARM, ModelConfig, "arm"), records, 5e-3)
    found = named(trace)
    assert set(found) == {"gravity.sine_for_stiffness"}
    gravity = found["gravity.sine_for_stiffness"]
    # What is left of the swings' sine beside its line is a tenth of it.
    assert gravity["k_s"] == pytest.approx(1.9 * np.cos(0.05), rel=0.02)
    assert gravity["k"] == pytest.approx(1.2, rel=0.03)


def test_a_dead_zone_behind_a_lag_is_found_while_a_record_contradicts_it() -> None:
    """It moves gain and damping by half: with the first numbers, a record speaks against it."""
    records = []
    for seed, level in ((1, 1.7), (2, 0.5)):
        wanted, lagging = sines(seed, 3000, 2e-3, 0.1, 8.0), [0.0]

        def acceleration(_x: float, v: float, u: float, at: list[float] = lagging) -> float:
            # Called twice a step, at its begin and its middle.
            now, at[0] = at[0], u + (at[0] - u) * exp(-0.5 * 2e-3 / 8 / 6e-3)
            return 6.0 * (now - min(max(now, -0.4), 0.4)) - 45.0 * v

        records.append(
            flown(
                acceleration,
                lambda k, x, _, w=wanted, a=level: a * w[k] - 4.0 * x,
                *(3000, 2e-3, 1e-6, seed),
            )
        )
    trace = traced(parse_text(CYLINDER, ModelConfig, "cylinder"), records, 2e-3)
    found = named(trace)
    assert set(found) == {"dead_zone.after_lag"}
    assert found["dead_zone.after_lag"]["width"] == pytest.approx(0.4, rel=0.01)
    assert trace.found.point.model.values["b"] == pytest.approx(6.0, rel=0.01)
    assert trace.found.point.model.values["tau"] == pytest.approx(6e-3, rel=0.02)


@pytest.mark.parametrize("pause_s", [0.0, 20.0])
def test_heat_of_an_actuator_lasts_from_record_to_record(pause_s: float) -> None:
    config, heat, records = parse_text(MOTOR, ModelConfig, "motor"), [0.0], []
    rows, Ts_s, tau_s = 3000, 4e-3, 15.0
    for n, level in enumerate((2.0, 3.2, 1.0)):
        wanted = level * sines(n, rows, Ts_s, 0.3, 8.0)

        def acceleration(_q: float, v: float, i: float) -> float:
            heat[0] += 0.5 * Ts_s / 8 * (i * i - heat[0]) / tau_s
            return (0.12 * (1.0 - 0.02 * heat[0]) * i - 0.004 * v) / 0.002

        u, y = flown(
            acceleration,
            lambda k, q, _, w=wanted: w[k] - 2.0 * q,
            *(rows, Ts_s, 1e-5, n),
        )
        e = Experiment(f"r{n}", Ts_s, u, y, {}, frozenset(), False)
        record = imported_trace_record(e, config)
        record.time_s[:] += n * (rows * Ts_s + pause_s)
        records.append(record)
        heat[0] *= exp(-pause_s / tau_s)
    trace = trace_records(records, config, all_effects, lambda *_: None)
    found = named(trace)
    assert set(found) == {"thermal_drift.heat_with_rests"}
    assert found["thermal_drift.heat_with_rests"]["a"] == pytest.approx(0.02, rel=0.05)
    assert found["thermal_drift.heat_with_rests"]["tau"] == pytest.approx(tau_s, rel=0.1)


def test_a_load_behind_a_gap_is_found_at_its_motor() -> None:
    kind = KINDS["motor of a shaft with a gap"]
    plant = Shaft(half=3e-3, c=0.05)
    model = declared(kind, plant, np.random.default_rng(0))
    found = named(traced(model, flights(kind, plant, 3), TS))
    assert set(found) == {"backlash.load"}
    # Bounces give the squares many minima: the fit ends in one beside the truth, with a gap a tenth
    # too wide. Its interval does not know that.
    assert found["backlash.load"]["m"] == pytest.approx(plant.j2, rel=0.1)
    assert found["backlash.load"]["half"] == pytest.approx(plant.half, rel=0.15)
