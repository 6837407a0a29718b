"""Test the trace of actuators with several parts in a chain, and of two masses on springs."""

from __future__ import annotations

from collections.abc import Callable

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

CONFIG = parse_text(
    """
levid: model
name: stage
dof: [{name: q, unit: m}]
inputs: [{name: u, unit: N}]
parameters:
  m: {value: 4.5, unit: kg, min: 0.1, max: 100}
  d: {value: 17.0, unit: N s/m, min: 0, max: 1000}
  k: {value: 2000, unit: N/m, min: 0, max: 100000}
M: [[m]]
D: [[d]]
K: [[k]]
""",
    ModelConfig,
    "stage",
)
MASS, DAMPER, SPRING = 5.0, 15.0, 1776.0  # 3 Hz
TS, ROWS, STEPS = 5e-3, 4000, 4
Parts = Callable[[float, np.ndarray], tuple[float, np.ndarray]]
"""Force and change of four states over command and states."""


def second_order(f: float, x: np.ndarray, hz: float, damping: float) -> np.ndarray:
    w = 2.0 * np.pi * hz
    return np.array([x[1], w * w * (f - x[0]) - 2.0 * damping * w * x[1]])


def third_order(u: float, x: np.ndarray) -> tuple[float, np.ndarray]:
    return x[2], np.array([*second_order(u, x, 12.0, 0.35), (x[0] - x[2]) / 0.018, 0.0])


def bridge(u: float, x: np.ndarray) -> tuple[float, np.ndarray]:
    left = u - min(max(u, -8.0), 8.0)
    return x[0], np.array([(left - x[0]) / 0.03, 0.0, 0.0, 0.0])


def magnet(u: float, x: np.ndarray) -> tuple[float, np.ndarray]:
    return min(max(x[0], -30.0), 30.0), np.array([*second_order(u, x, 25.0, 0.7), 0.0, 0.0])


def moved(parts: Parts, seed: int, masses: tuple[tuple[float, float, float], ...]) -> Experiment:
    """Return 20 s of the stage by Runge's and Kutta's rule, with noise of 0.1 % of its motion.

    masses: on springs, with their frequency and damping.
    """
    rng = np.random.default_rng(seed)
    u = 20.0 * lfilter(*butter(2, 2.0 * 15.0 * TS), 4.0 * rng.standard_normal(ROWS))
    y, h = np.empty((ROWS, 1)), TS / STEPS
    x = np.zeros(6 + 2 * len(masses))

    def rate(x: np.ndarray, u: float) -> np.ndarray:
        force, inside = parts(u, x[2:6])
        change = np.concatenate([[x[1], 0.0], inside, np.zeros(2 * len(masses))])
        for i, (m, hz, damping) in enumerate(masses):
            w, p = 2.0 * np.pi * hz, x[6 + 2 * i : 8 + 2 * i]
            a = w * w * (x[0] - p[0]) + 2.0 * damping * w * (x[1] - p[1])
            change[6 + 2 * i : 8 + 2 * i] = p[1], a
            force -= m * a
        change[1] = (force - DAMPER * x[1] - SPRING * x[0]) / MASS
        return change

    for row in range(ROWS):
        y[row] = x[0]
        for _ in range(STEPS):
            a = rate(x, u[row])
            b = rate(x + 0.5 * h * a, u[row])
            c = rate(x + 0.5 * h * b, u[row])
            x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + rate(x + h * c, u[row]))
    sd = 1e-3 * y.std()
    y += sd * rng.standard_normal(y.shape)
    return Experiment("made", TS, u[:, None], y, {}, frozenset(), False, noise_sd=np.array([sd]))


def directly(u: float, x: np.ndarray) -> tuple[float, np.ndarray]:
    return u, np.zeros_like(x)


LAG, SECOND = "actuator_lag", "actuator_lag.second_order"
MASS_ON_SPRING = "flexible_mode.loose_mass"


@pytest.mark.parametrize(
    ("parts", "masses", "numbers"),
    [
        # In a linear plant, the other lag may be the sensor's.
        (third_order, (), {SECOND: {"frequency": 12.0, "damping": 0.35}}),
        (bridge, (), {"dead_zone": {"width": 8.0}, LAG: {"lag": 0.03}}),
        (magnet, (), {"saturation.after_lag": {"limit": 30.0}, SECOND: {"frequency": 25.0}}),
        (directly, ((0.25, 9.0, 0.02), (0.3, 11.0, 0.02)),
         {MASS_ON_SPRING: {}, f"{MASS_ON_SPRING}.another": {}}),
    ],
    ids=["third order", "bridge", "magnet", "two masses"],
)  # fmt: skip
def test_each_part_is_named_with_its_numbers(
    parts: Parts,
    masses: tuple[tuple[float, float, float], ...],
    numbers: dict[str, dict[str, float]],
) -> None:
    records = [imported_trace_record(moved(parts, 1, masses), CONFIG)]
    trace = trace_records(records, CONFIG, all_effects, lambda *_: None)
    placed = {p.effect.key: p for p in trace.found.point.placed}
    assert set(placed) >= set(numbers)
    assert len(placed) == 2
    for key, expected in numbers.items():
        effect = placed[key].effect
        names = [q.name for q in (*effect.amplitudes, *effect.shape)]
        values = dict(zip(names, (*placed[key].amplitudes, *placed[key].shape), strict=True))
        for name, value in expected.items():
            assert values[name] == pytest.approx(value, rel=0.03)  # standard errors are below 1 %
    if masses:
        found = sorted((p.amplitudes[0], p.shape[0]) for p in placed.values())
        assert np.array(found) == pytest.approx(np.sort([m[:2] for m in masses], axis=0), rel=0.03)
    summary = force_summary(trace)
    # Numbers that are known to a part of a thousand leave a few thousandths.
    assert summary["validation"]["after"] < 0.01 * summary["validation"]["before"]
