"""Test the trace of plants whose sensors err: a nonlinear one, a late one, and crosstalk."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lfilter

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_trace.force_trace_summary import force_summary
from levid.identification.trace.force_trace.trace_imported import trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.candidate_effects import all_effects

Array = np.ndarray
TS, ROWS, STEPS = 5e-3, 6000, 10
M, D, K = np.array([2.0, 1.5]), np.array([10.0, 8.0]), np.array([800.0, 900.0])
ONE = """
levid: model
name: isolator
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
parameters:
  m: {value: 2.2, unit: kg, min: 0.01, max: 100}
  d: {value: 8.5, unit: N s/m, min: 0, max: 500}
  k: {value: 700, unit: N/m, min: 0, max: 9000}
M: [[m]]
D: [[d]]
K: [[k]]
"""
TWO = """
levid: model
name: stage
dof: [{name: x, unit: m}, {name: y, unit: m}]
inputs: [{name: f, unit: N}, {name: g, unit: N}]
parameters:
  m1: {value: 2.2, unit: kg, min: 0.01, max: 100}
  m2: {value: 1.3, unit: kg, min: 0.01, max: 100}
  d1: {value: 8.5, unit: N s/m, min: 0, max: 500}
  d2: {value: 9.5, unit: N s/m, min: 0, max: 500}
  k1: {value: 700, unit: N/m, min: 0, max: 9000}
  k2: {value: 1000, unit: N/m, min: 0, max: 9000}
M: [[m1, 0], [0, m2]]
D: [[d1, 0], [0, d2]]
K: [[k1, 0], [0, k2]]
"""


def flown(seed: int, axes: int, reading: Callable[[Array], Array], k3: float = 0.0) -> Experiment:
    """Return 30 s of axes with springs K q + k3 q^3 under noise below 6 Hz, with noise of 0.1 % in
    the readings."""
    rng = np.random.default_rng(seed)
    u = lfilter(*butter(2, 2.0 * 6.0 * TS), rng.standard_normal((ROWS, axes)), axis=0)
    u *= (6.0 + 3.0 * seed) / u.std(axis=0)
    q, v, h = np.zeros(axes), np.zeros(axes), TS / STEPS
    positions = np.empty((ROWS, axes))
    for row in range(ROWS):
        positions[row] = q
        for _ in range(STEPS):
            spring = K[:axes] * q + k3 * q**3
            half = v + 0.5 * h * (u[row] - D[:axes] * v - spring) / M[:axes]
            middle = q + 0.5 * h * v
            spring = K[:axes] * middle + k3 * middle**3
            v = v + h * (u[row] - D[:axes] * half - spring) / M[:axes]
            q = q + h * half
    y = reading(positions)
    y = y + 1e-3 * y.std(axis=0) * rng.standard_normal(y.shape)
    return Experiment(f"r{seed}", TS, u, y, {}, frozenset(), False, 0, None)


def traced(model: str, axes: int, reading: Callable[[Array], Array], k3: float = 0.0) -> dict:
    config = parse_text(model, ModelConfig, "model")
    records = [imported_trace_record(flown(seed, axes, reading, k3), config) for seed in (1, 2)]
    return force_summary(trace_records(records, config, all_effects, lambda *_: None))


def bent(h: Array) -> Array:
    """Return readings r of h = r + 40 r^3, by Newton's method."""
    r = h.copy()
    for _ in range(30):
        r = r - (r + 40.0 * r**3 - h) / (1.0 + 120.0 * r**2)
    return r


def lagged(h: Array) -> Array:
    """Return positions after a lag of 8 ms, in steps of a fiftieth of a row."""
    fine = CubicSpline(np.arange(ROWS), h)(np.arange(50 * ROWS) / 50.0)
    left = np.exp(-TS / 50.0 / 8e-3)
    middle = 0.5 * (1.0 - left) * np.array([1.0, 1.0])
    return lfilter(middle, [1.0, -left], fine, axis=0)[::50]


def test_nonlinear_sensor_is_told_from_a_nonlinear_spring() -> None:
    found = traced(ONE, 1, bent)
    (law,) = found["effects"]
    assert (law["class"], law["where"]) == ("sensor_nonlinearity", ["x"])
    assert not law["alternatives"]
    b = law["parameters"]["b"]
    assert abs(b["value"] - 40.0) < 4.0 * b["se"]  # one in 16,000
    force = found["validation"]["force_percent"]
    assert force["after"] < 0.3 * force["before"]
    # What is left is the noise of the readings: about 250 independent values tell it to 5 %.
    own = found["validation"]["per_dof"]["x"]["force_percent"]
    assert abs(own["after"] / own["noise"] - 1.0) < 0.2
    # The free run is compared where the sensor reads it.
    assert found["validation"]["metric"] == "free_run"
    assert found["validation"]["after"] < 0.3 * found["validation"]["before"]


def test_a_spring_hardens_with_the_position_and_not_with_what_a_nonlinear_sensor_reads() -> None:
    found = traced(ONE, 1, bent, k3=4e5)
    laws = {law["class"]: law for law in found["effects"]}
    assert set(laws) == {"stiffness", "sensor_nonlinearity"}
    for kind, name, true in (("stiffness", "k3", 4e5), ("sensor_nonlinearity", "b", 40.0)):
        assert not laws[kind]["evidence"]["doubtful"]
        number = laws[kind]["parameters"][name]
        assert abs(number["value"] - true) < 4.0 * number["se"]  # as above
        assert number["se"] < 0.05 * true


def test_lag_of_the_only_sensor_is_not_told_from_that_of_the_only_actuator() -> None:
    found = traced(ONE, 1, lagged)
    (law,) = found["effects"]
    assert law["class"] == "ambiguous"
    names = " ".join(a["name"] for a in law["alternatives"])
    assert "of the sensor at x" in names
    assert "of an actuator at f" in names


def test_interpolation_error_of_an_encoder_is_named() -> None:
    """It was a ripple of the force, beside a lag that took the place of the mass."""
    size, pitch = 2e-4, 0.02
    found = traced(ONE, 1, lambda x: x + size * np.sin(2.0 * np.pi / pitch * x))
    (law,) = found["effects"]
    assert law["name"].startswith("Interpolation error of the encoder")
    assert not law["alternatives"]
    assert not law["evidence"]["doubtful"]
    numbers = law["parameters"]
    assert abs(numbers["pitch"]["value"] - pitch) < 4.0 * numbers["pitch"]["se"]
    # The law is of the reading: a slope of 6 % makes a second harmonic of half as much.
    assert abs(numbers["a"]["value"] + size) < 0.06 * size


def test_reading_with_a_part_of_another_one_is_named() -> None:
    found = traced(TWO, 2, lambda h: h @ np.array([[1.0, 0.06], [0.0, 1.0]]))
    (law,) = found["effects"]
    assert (law["class"], law["where"]) == ("sensor_crosstalk", ["y", "x"])
    share = law["parameters"]["share"]
    # y reads 0.06 x, so that y = r_y - 0.06 r_x.
    assert abs(share["value"] + 0.06) < 4.0 * share["se"]
