"""Test models of which one number is fixed, or assumed, and wrong: an inertia, a sensor's gain."""

from __future__ import annotations

from functools import cache

import numpy as np

from levid.benchmarks.trace.imported_plant_cases import low_pass_noise
from levid.benchmarks.trace.imported_plant_simulation import Linear, simulated
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_trace.force_trace_summary import force_summary
from levid.identification.trace.force_trace.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.candidate_effects import all_effects

CART, ARM, INERTIA, DRAG, HINGE, WEIGHT = 1.3, 0.076, 0.033, 5.4, 0.0024, 9.81
GANTRY = f"""
levid: model
name: gantry
dof: [{{name: x, unit: m}}, {{name: angle, unit: rad}}]
inputs: [{{name: u, unit: N}}]
parameters:
  m: {{value: 1.5, unit: kg, min: 0, max: 20}}
  h: {{value: 0.09, unit: kg m, min: 0, max: 1}}
  j: {{value: {1.12 * INERTIA}, unit: kg m^2, fixed: true}}
  d: {{value: 4.5, unit: N s/m, min: 0, max: 100}}
  c: {{value: 0.002, unit: N m s/rad, min: 0, max: 1}}
M: [[m, h], [h, j]]
D: [[d, 0], [0, c]]
K: [[0, 0], [0, {WEIGHT}*h]]
B: [[1], [0]]
"""
FIRST, SECOND, GROUND, SHAFT, OIL, AIR = 0.0024, 0.0019, 1.5, 2.8, 0.007, 0.0012
DISKS = """
levid: model
name: disks
dof: [{name: a, unit: rad}, {name: b, unit: rad}]
inputs: [{name: u, unit: N m}]
parameters:
  j1: {value: 0.0029, unit: kg m^2, min: 0, max: 1}
  j2: {value: 0.0016, unit: kg m^2, min: 0, max: 1}
  k0: {value: 1.8, unit: N m/rad, min: 0, max: 100}
  k: {value: 2.3, unit: N m/rad, min: 0, max: 100}
  c1: {value: 0.008, unit: N m s/rad, min: 0, max: 1}
  c2: {value: 0.001, unit: N m s/rad, min: 0, max: 1}
M: [[j1, 0], [0, j2]]
D: [[c1, 0], [0, c2]]
K: [[k0 + k, -k], [-k, k]]
B: [[1], [0]]
"""
TS, ROWS = 0.005, 8000


def traced(model: str, plant: Linear, size: float, gains: tuple[float, float]) -> ForceTrace:
    """Trace a record of a plant, of which each reading has a gain."""
    rng = np.random.default_rng(1)
    v = size * low_pass_noise(rng, ROWS, TS, 4.0)[:, None]
    moved = simulated(plant, v, rng)
    config = parse_text(model, ModelConfig, "model")
    record = Experiment("r", TS, moved.u, moved.y * gains, {}, frozenset(), False)
    records = [imported_trace_record(record, config)]
    return trace_records(records, config, all_effects, lambda *_: None)


def plant(M: list[list[float]], D: list[float], K: list[list[float]], noise: float) -> Linear:
    B, none = np.array([[1.0], [0.0]]), np.zeros((1, 2))
    return Linear(
        np.array(M), np.diag(D), np.array(K), B, none, none, np.full(2, noise), TS, 20
    )  # fmt: skip


@cache
def gantry() -> ForceTrace:
    M, K = [[CART, ARM], [ARM, INERTIA]], [[0.0, 0.0], [0.0, WEIGHT * ARM]]
    return traced(GANTRY, plant(M, [DRAG, HINGE], K, 1e-5), 4.0, (1.0, 1.0))


def test_inertia_that_is_fixed_12_percent_too_large_is_named() -> None:
    """With it all terms of its equation are free: weights by what a free form leaves were infinite,
    and nothing was named. The other equation has the same arm, and tells the scale of both."""
    found = gantry()
    (law,) = force_summary(found)["effects"]
    assert (law["class"], law["where"]) == ("linear_inertia", ["angle"])
    own = law["parameters"]["m"]
    assert abs(own["value"] + 0.12 * INERTIA) < 4.0 * own["se"]
    assert own["se"] < 0.05 * 0.12 * INERTIA
    values, errors = found.found.point.values, found.errors[:4]
    assert np.all(np.abs(values - [CART, ARM, DRAG, HINGE]) < 4.0 * errors)


def test_gain_of_a_sensor_is_one_of_what_two_disks_do_not_tell_apart() -> None:
    """With it a stiffness between the disks and the ground is another one, and the other way round.

    It was no candidate. As its force is nearly all that of the free parameters, it would be none
    by the error of an equation either, but a linear term has none.
    """
    K, gain = [[GROUND + SHAFT, -SHAFT], [-SHAFT, SHAFT]], 1.04
    disks = plant([[FIRST, 0.0], [0.0, SECOND]], [OIL, AIR], K, 1e-4)
    found = traced(DISKS, disks, 0.2, (1.0, gain))
    (law,) = force_summary(found)["effects"]
    members = {(one["class"], *one["where"]) for one in law["alternatives"]}
    assert members >= {("sensor_gain", "a"), ("sensor_gain", "b"), ("linear_stiffness", "b")}
    values, errors = found.found.point.values, found.errors[:6]
    assert np.all(np.abs(values - [FIRST, SECOND, GROUND, SHAFT, OIL, AIR]) < 4.0 * errors)
