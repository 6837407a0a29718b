"""Test axes with two inputs, of which the gain of one is known and that of the other is free.

Only the force of the first sets the scale of an equation. With a lever of it that is free too, all
terms of the equation may become small together. A helicopter on a stand is such a plant: each of
its propellers turns both axes, and only what it does to its own axis is known.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from levid.benchmarks.trace.imported_plant_cases import low_pass_noise
from levid.benchmarks.trace.imported_plant_simulation import Acting, Kind, Linear, simulated
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_balance.force_record import ForceModel
from levid.identification.trace.force_regression.held_out_gain import Blocks
from levid.identification.trace.force_regression.residual_whitening import Whitening
from levid.identification.trace.force_regression.training_records import Training
from levid.identification.trace.force_search.scale_of_equations import (
    with_scale,
    without_scales,
)
from levid.identification.trace.force_trace.force_trace_outcome import force_outcome
from levid.identification.trace.force_trace.force_trace_summary import force_summary
from levid.identification.trace.force_trace.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.base import Effect, Placed
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent
from levid.report.trace.answer import imported_answer

HELICOPTER = """
levid: model
name: helicopter
dof: [{name: pitch, unit: rad}, {name: yaw, unit: rad}]
inputs: [{name: vp, unit: V}, {name: vy, unit: V}]
parameters:
  jp: {value: 0.0445, unit: kg m^2, min: 0, max: 1}
  jy: {value: 0.0495, unit: kg m^2, min: 0, max: 1}
  dp: {value: 0.041, unit: N m s/rad, min: 0, max: 1}
  dy: {value: 0.071, unit: N m s/rad, min: 0, max: 1}
  kg: {value: 0.315, unit: N m/rad, min: 0, max: 7}
  kpp: {value: 0.05, unit: N m/V, fixed: true}
  kyy: {value: 0.05, unit: N m/V, fixed: true}
  kpy: {value: 0.0081, unit: N m/V, min: 0, max: 0.1}
  kyp: {value: 0.0134, unit: N m/V, min: 0, max: 0.1}
M: [[jp, 0], [0, jy]]
D: [[dp, 0], [0, dy]]
K: [[kg, 0], [0, 0]]
B: [[kpp, kpy], [kyp, kyy]]
"""
JP, JY, DP, DY, KG, KPY, KYP = TRUTH = np.array([0.038, 0.043, 0.05, 0.08, 0.37, 0.007, 0.012])
KNOWN, FRICTION = 0.05, 0.02
TOLD = SearchOptions().told_from_model
TS, ROWS, NOISE_RAD = 0.005, 8000, 1e-4


@cache
def traced(seed: int, friction: float) -> ForceTrace:
    """Trace a record of the helicopter, with a dry friction of pitch."""
    rng = np.random.default_rng(seed)
    B, none = np.array([[KNOWN, KPY], [KYP, KNOWN]]), np.zeros((2, 2))
    plant = Linear(
        np.diag([JP, JY]), np.diag([DP, DY]), np.diag([KG, 0.0]), B, none, none,
        np.full(2, NOISE_RAD), TS, 20,
    )  # fmt: skip
    v = 2.0 * np.stack([low_pass_noise(rng, ROWS, TS, 2.0) for _ in range(2)], axis=1)
    acting = [Acting(Kind.COULOMB, 0, np.array([friction, 0.005]))] if friction else []
    moved = simulated(plant, v, rng, *acting)
    config = parse_text(HELICOPTER, ModelConfig, "helicopter")
    record = Experiment("r", TS, moved.u, moved.y, {}, frozenset(), False)
    records = [imported_trace_record(record, config)]
    return trace_records(records, config, all_effects, lambda *_: None)


@pytest.mark.parametrize("friction", [0.0, FRICTION])
@pytest.mark.parametrize("seed", [1, 2])
def test_effect_and_numbers_are_found_beside_a_free_gain(seed: int, friction: float) -> None:
    """Before, a lever of -kpp and numbers near zero took more than the friction."""
    found = traced(seed, friction)
    laws = force_summary(found)["effects"]
    named = [(one["class"], one["where"]) for one in laws]
    assert named == ([("friction", ["pitch"])] if friction else [])
    if friction:
        assert laws[0]["parameters"]["friction"]["value"] == pytest.approx(friction, rel=0.02)
    values, errors = found.found.point.values, found.errors[: len(TRUTH)]
    assert np.all(np.abs(values - TRUTH) < 4.0 * errors)
    assert np.all(errors < 0.01 * TRUTH)


def test_answer_says_where_noise_is_all_that_is_left() -> None:
    """The model leaves 0.7 % of the force, as much as the noise; half of a per cent is an error."""
    result = force_outcome(traced(1, 0.0))
    assert "no more than noise and the 0.5 % of that force" in imported_answer(result)
    assert result.nearest == ""
    quiet = replace(result.after, noise_percent=np.zeros(2))
    louder = replace(quiet, force_percent=np.array([0.6, 0.1]))
    assert "unexplained" in imported_answer(replace(result, after=louder))


@cache
def scaled() -> tuple[ForceTrace, Training, ForceModel]:
    """Return a trace, its records with known scales and flat weights, and its model alone."""
    found = traced(1, FRICTION)
    flat = Whitening(np.array([0.0, found.limit_hz]), np.ones((2, 2)), found.limit_hz)
    blocks = Blocks.of([r.rows for r in found.fitted], found.options.blocks)
    training = Training.unscaled(found.fitted, flat, blocks)
    point = replace(found.found.point, placed=())
    return found, with_scale(training, training.at(point), TOLD), point


def effects_of(found: ForceTrace) -> dict[str, Effect]:
    covered = Extent.measured([r.signals for r in found.fitted])
    return {e.identity: e for e in all_effects(found.places, covered)}


@pytest.mark.parametrize("left", [0.5, 0.01])
def test_errors_count_relative_to_what_a_lever_leaves_of_the_known_force(left: float) -> None:
    """The force of the free gain is there as before; it does not set the scale."""
    found, training, point = scaled()
    lever = effects_of(found)["linear.input@pitch+vp"]
    placed = Placed(lever, (), ((left - 1.0) * KNOWN,))
    share = training.at(replace(point, placed=(placed,))).share
    # The lever's command is a mean of each period: 1e-4 of the force, which is left of it at most.
    assert share == pytest.approx([1.0 / left, 1.0], rel=0.02)


def test_what_would_leave_a_scale_free_is_no_candidate() -> None:
    found, training, point = scaled()
    linear = [e for e in effects_of(found).values() if e.linear]
    kept = without_scales(point, linear, training, TOLD)
    assert {e.identity for e in linear} - {e.identity for e in kept} == {
        "coil_gain.all@vp+vy",
        "coil_gain@vp",
        "coil_gain@vy",
        "linear.input@pitch+vp",
        "linear.input@yaw+vy",
    }
