"""Test the trace of a beam with a propeller: the speed follows the command, the thrust its square.

The thrust is purely squared, so that the declared gain and the square are not told from zero by
themselves, only their product.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_trace.force_trace_summary import force_summary
from levid.identification.trace.force_trace.trace_imported import trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.candidate_effects import all_effects

MODEL = """
levid: model
name: beam
dof: [{name: q, unit: rad}]
inputs: [{name: u, unit: "1"}]
parameters:
  j: {value: 0.05, unit: kg m^2, fixed: true}
  d: {value: 0.07, unit: N m s/rad, min: 0, max: 10}
  k: {value: 0.55, unit: N m/rad, min: 0, max: 100}
  b: {value: 0.9, unit: N m, min: 0, max: 100}
  lag: {value: 0.06, unit: s, min: 0, max: 1}
M: [[j]]
D: [[d]]
K: [[k]]
B: [[b]]
"""
DAMPER, SPRING, THRUST, LAG_S = 0.06, 0.6, 1.0, 0.05
TS, ROWS, STEPS = 5e-3, 4500, 10


def flown(seed: int) -> Experiment:
    """Return 22.5 s of a beam around a working point, with noise of 0.1 % of its motion."""
    rng = np.random.default_rng(seed)
    u = 0.5 + 0.12 * np.clip(_low_pass(rng), -3.0, 3.0)
    y, h = np.empty(ROWS), TS / STEPS
    speed, q, v = u[0], THRUST * u[0] ** 2 / SPRING, 0.0

    def acceleration(q: float, v: float, speed: float) -> float:
        return (THRUST * speed * abs(speed) - DAMPER * v - SPRING * q) / 0.05

    for row in range(ROWS):
        y[row] = q
        for _ in range(STEPS):
            half_way = u[row] + (speed - u[row]) * np.exp(-0.5 * h / LAG_S)
            a = acceleration(q, v, speed)
            b = acceleration(q + 0.5 * h * v, v + 0.5 * h * a, half_way)
            q, v = q + h * (v + 0.5 * h * a), v + h * b
            speed = u[row] + (speed - u[row]) * np.exp(-h / LAG_S)
    y += 1e-3 * y.std() * rng.standard_normal(ROWS)
    return Experiment("made", TS, u[:, None], y[:, None], {}, frozenset(), False, 0, None)


def _low_pass(rng: np.random.Generator) -> np.ndarray:
    noise = lfilter(*butter(2, 2.0 * 3.0 * TS), rng.standard_normal(ROWS))
    return np.asarray(noise / noise.std())


@pytest.mark.parametrize("declared", [True, False])
def test_square_after_the_lag_is_named(declared: bool) -> None:
    text = MODEL + "lag_s: lag\n" if declared else MODEL.replace("  lag:", "  # lag:")
    config = parse_text(text, ModelConfig, "beam")
    records = [imported_trace_record(flown(seed), config) for seed in (1, 2)]
    trace = trace_records(records, config, all_effects, lambda *_: None)
    effects = {e["class"]: e for e in force_summary(trace)["effects"]}
    assert set(effects) == {"actuator_nonlinearity", *([] if declared else ["actuator_lag"])}
    square = effects["actuator_nonlinearity"]
    assert square["evidence"]["equation"].startswith("force = F_l")
    keys = [p.effect.key.partition("[")[0] for p in trace.found.point.placed]
    # The command has one sign: a square with the sign and one without are the same.
    assert {"actuator.squared_after_lag", "actuator.quadratic_after_lag"} & set(keys)
    assert not any(e["evidence"]["doubtful"] for e in effects.values())
    values = {k: v["value"] for e in effects.values() for k, v in e["parameters"].items()}
    values |= dict(zip(trace.found.point.parameters.names, trace.found.point.values, strict=True))
    # Within 1 %: their standard errors are 0.1 to 0.3 %.
    assert values["lag"] == pytest.approx(LAG_S, rel=0.01)
    # Beside a slope that is free, the product is told by the curvature, a seventh of the force: an
    # equation that is right to 0.5 % of the force (`SearchOptions.least_force`) gives it to 4 %.
    assert values["b"] * values["a"] == pytest.approx(THRUST, rel=0.04)


def test_thrust_that_is_nothing_but_a_square_is_named() -> None:
    """With a declared gain, a square beside the command could not lose the command's own part."""
    text = MODEL.replace("  lag:", "  # lag:").replace(
        "b: {value: 0.9,", "b: {value: 1, fixed: true,"
    )
    config, records = parse_text(text, ModelConfig, "beam"), []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        u, y, q, v, h = 0.6 * _low_pass(rng), np.empty(ROWS), 0.0, 0.0, TS / STEPS
        for row in range(ROWS):
            y[row] = q
            for _ in range(STEPS):
                a = (THRUST * u[row] * abs(u[row]) - DAMPER * v - SPRING * q) / 0.05
                v += h * a
                q += h * v
        y += 1e-3 * y.std() * rng.standard_normal(ROWS)
        made = Experiment("made", TS, u[:, None], y[:, None], {}, frozenset(), False, 0, None)
        records.append(imported_trace_record(made, config))
    found = trace_records(records, config, all_effects, lambda *_: None).found
    gain, square = sorted(found.point.placed, key=lambda p: p.effect.key, reverse=True)
    assert square.effect.key == "actuator.square[0.6]"
    assert (square.amplitudes, square.plain) == ((1.0,), True)
    # Of the declared gain where the command is 0.6, from which this one is 0.4 away.
    assert gain.effect.key == "coil_gain"
    assert (1.0 + gain.amplitudes[0]) / 0.6 == pytest.approx(THRUST, rel=0.01)
