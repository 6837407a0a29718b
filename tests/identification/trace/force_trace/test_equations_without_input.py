"""Test equations that no input is in: all of their terms are free, and only one is shared."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from levid.benchmarks.trace.imported_plant_simulation import Acting, Kind, Linear, simulated
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_regression.gauss_newton_fit import fit_numbers
from levid.identification.trace.force_regression.held_out_gain import Blocks
from levid.identification.trace.force_regression.residual_whitening import Whitening
from levid.identification.trace.force_regression.training_records import Training
from levid.identification.trace.force_search import scale_of_equations
from levid.identification.trace.force_trace.force_trace_summary import force_summary
from levid.identification.trace.force_trace.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.base import Effect, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

CART = """
levid: model
name: cart
dof: [{name: x, unit: m}, {name: arm, unit: rad}]
inputs: [{name: f, unit: N}]
parameters:
  mt: {value: 1.25, unit: kg, min: 0.1, max: 10}
  ml: {value: 0.05, unit: kg m, min: 0, max: 1}
  j: {value: 0.028, unit: kg m^2, min: 0.0001, max: 1}
  d: {value: 5, unit: N s/m, min: 0, max: 100}
  c: {value: 0.001, unit: N m s/rad, min: 0, max: 1}
  g: {value: 9.81, unit: m/s^2, fixed: true}
M: [[mt, ml], [ml, j]]
D: [[d, 0], [0, c]]
K: [[0, 0], [0, -ml * g]]
B: [[1], [0]]
"""
MT, ML, J, D, C, G = 1.1, 0.06, 0.024, 4.0, 0.002, 9.81
TS = 0.005
Table = Callable[[Places, Extent], list[Effect]]


def traced(
    seed: int,
    *acting: Acting,
    noise_rad: float = 2.5e-4,
    table: Table = all_effects,
    smooth_s: float = 0.15,
) -> ForceTrace:
    """Trace a record of a pendulum that a cart balances."""
    rng, rows, none = np.random.default_rng(seed), 8000, np.zeros((2, 2))
    M = np.array([[MT, ML], [ML, J]])
    rates = -np.linalg.solve(M, np.hstack([np.diag([0.0, -ML * G]), np.diag([D, C])]))
    A = np.vstack([np.hstack([none, np.eye(2)]), rates])
    B = np.concatenate([np.zeros(2), np.linalg.solve(M, [1.0, 0.0])])[:, None]
    cost = solve_continuous_are(A, B, np.diag([100.0, 50.0, 1.0, 1.0]), 0.3 * np.eye(1))
    gains = B.T @ cost / 0.3
    plant = Linear(
        M, np.diag([D, C]), np.diag([0.0, -ML * G]), np.array([[1.0], [0.0]]),
        gains[:, :2], gains[:, 2:] / TS, np.array([1e-5, noise_rad]), TS, 20,
    )  # fmt: skip
    smooth = round(smooth_s / TS)
    force = rng.normal(size=rows + 2 * smooth)
    for _ in range(2):
        force = np.convolve(force, np.ones(smooth) / smooth, mode="same")
    v = (3.0 * force[:rows] / force.std())[:, None]
    moved = simulated(plant, v, rng, *acting)
    config = parse_text(CART, ModelConfig, "cart")
    record = Experiment("r", TS, moved.u, moved.y, {}, frozenset(), False, feedback=True)
    records = [imported_trace_record(record, config)]
    return trace_records(records, config, table, lambda *_: None)


def assert_within_three_standard_errors(found: ForceTrace) -> None:
    free = found.found.point.parameters
    assert free.names == ("mt", "ml", "j", "d", "c")
    errors = found.errors[: len(free.names)]  # then those of effects
    off = np.abs(found.found.point.values - [MT, ML, J, D, C]) / errors
    assert np.all(off < 3.0), dict(zip(free.names, off, strict=True))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_noise_does_not_make_the_numbers_of_such_an_equation_small(seed: int):
    """The noise is a tenth of the swing; absolute errors lead to numbers near zero together."""
    found = traced(seed, noise_rad=3e-3, table=lambda _places, _extent: [])
    assert not found.found.rated
    assert_within_three_standard_errors(found)
    point = found.found.point
    ml = point.values[point.parameters.names.index("ml")]
    assert ml == pytest.approx(ML, rel=0.1)


@pytest.mark.parametrize(("share", "is_told"), [(0.05, True), (0.002, False)])
@pytest.mark.parametrize("weight", [1.0, 1000.0])
def test_an_equation_tells_the_scale_of_another_one_by_a_few_per_cent_of_its_own_force(
    share: float, is_told: bool, weight: float
) -> None:
    """Numbers m of the cart, ml of both and j of the arm; errors of the arm count `weight` times
    as much, as those of a cart do that dry friction holds."""
    rng = np.random.default_rng(0)
    cart, arm, turn = rng.standard_normal((3, 500))
    none, command = np.zeros(500), cart + share * turn
    of_arm = weight * (turn + arm)

    def groups(inputs: np.ndarray, inertia_x: np.ndarray, inertia_arm: np.ndarray) -> np.ndarray:
        rows = [np.stack([inputs, none], axis=1), np.stack([inertia_x, inertia_arm], axis=1)]
        return np.stack([*rows, np.zeros((500, 2))])

    at: Any = SimpleNamespace(
        groups=[groups(command, cart + share * turn, of_arm)],
        power=np.ones(2),
        point=SimpleNamespace(
            parameters=SimpleNamespace(names=("m", "ml", "j"), prior_sd=np.full(3, np.inf))
        ),
    )
    changes = np.stack(
        [
            groups(none, cart, none),
            groups(none, share * turn, weight * arm),
            groups(none, none, weight * turn),
        ]
    )
    least = SearchOptions().told_from_model
    held = scale_of_equations._parameter_to_hold(at, [changes], 1, least)
    assert (held is None) == is_told


def test_effect_in_such_an_equation_is_found():
    """A spring at the pendulum, beside numbers that are all free."""
    stiffening = Acting(Kind.CUBIC, 1, np.array([40.0]))
    (law,) = force_summary(traced(2, stiffening))["effects"]
    assert "stiffness" in {law["class"], *(a["class"] for a in law["alternatives"])}
    assert law["where"] == ["arm"]
    assert not law["evidence"]["doubtful"]


@pytest.mark.parametrize("share", [0.1, 0.01])
def test_numbers_that_became_small_together_grow_again(share: float) -> None:
    """So they become while a friction of the cart is missing, for which its mass stands then."""
    found = traced(1, table=lambda _places, _extent: [], smooth_s=0.3)
    point, free = found.found.point, found.found.point.parameters
    density = np.array([[1e6, 1.0]] * 2)  # errors of the cart count little, as friction is missing
    flat = Whitening(np.array([0.0, found.limit_hz]), density, found.limit_hz)
    blocks = Blocks.of([r.rows for r in found.fitted], found.options.blocks)
    training = Training.unscaled(found.fitted, flat, blocks)
    training = scale_of_equations.with_scale(
        training, training.at(point), found.options.told_from_model
    )
    assert np.isfinite(training.reference[1])
    of_arm = np.isin(free.names, ["ml", "j", "c"])
    fitted = fit_numbers(training, point.with_values(np.where(of_arm, share, 1.0) * point.values))
    again = fit_numbers(training, point)
    assert training.cost(fitted) == pytest.approx(training.cost(again), rel=1e-4)
    assert fitted.values == pytest.approx(again.values, rel=1e-3)


def test_scale_that_is_told_once_a_friction_is_found_is_held_no_longer() -> None:
    """The arm hardly turns. With its ml held at a wrong value a lever of the force seems to be
    there beside the friction of the cart."""
    found = traced(2, Acting(Kind.COULOMB, 0, np.array([0.8, 0.005])), smooth_s=0.5)
    (law,) = force_summary(found)["effects"]
    assert (law["class"], law["where"]) == ("friction", ["x"])
    assert law["parameters"]["friction"]["value"] == pytest.approx(0.8, rel=0.01)
    assert_within_three_standard_errors(found)
    assert not any("is held" in note for note in found.notes)
