"""Test the noise floor of a free run: the exact covariance against many random draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.control_loop import ControlLoop
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.free_run.free_run_noise_floor import (
    floor_psd,
    floor_rms,
    noise_floor,
)
from levid.identification.greybox.free_run.free_run_simulation import free_run
from levid.identification.greybox.prediction.noise_model import Noise
from levid.identification.greybox.validation import validate
from levid.model.controller import pi_controller

TS_S = 1e-3
MASS, DAMPING, STIFFNESS, BY_SLIDE, LAG_S = 2.0, 8.0, 800.0, 600.0, 2e-3
CART = f"""
levid: model
name: cart on a spring that a slide stiffens
dof: [{{name: x, unit: m}}]
inputs: [{{name: f, unit: N}}]
scheduling:
  s: {{unit: m, signal: slide_m, min: -1, max: 1}}
M: [[{MASS}]]
D: [[{DAMPING}]]
K: [["{STIFFNESS} + {BY_SLIDE}*s"]]
lag_s: {LAG_S}
"""
MODEL = declared_model(parse_text(CART, ModelConfig, "cart"))
# Force noise and sensor noise contribute about equally, so that a lack of either shows.
NOISE = Noise.independent(np.array([1e-8]), np.array([4e-13]))
KP, KI = np.array([60.0]), np.array([300.0])
CONTROLLER = pi_controller(KP, KI, TS_S)
RECORDS = 400


def experiment(rows: int, looped: bool, moving: bool) -> Experiment:
    """Return a record without excitation; the slide oscillates or stays in the middle."""
    s = 0.9 * np.sin(0.5 * TS_S * np.arange(rows)) if moving else np.zeros(rows)
    zero = np.zeros((rows, 1))
    loop = ControlLoop(zero, zero, zero, zero, CONTROLLER) if looped else None
    return Experiment("still", TS_S, zero, zero, {"s": s}, frozenset(), moving, 1, loop)


def draw_outputs(e: Experiment, first: int) -> np.ndarray:
    """Return outputs (rows, RECORDS) for RECORDS draws of the noise, from row `first` on.

    Exact steps of the cart with its current loop; the force is constant over a period.
    """
    rng = np.random.default_rng(11)
    x = np.zeros((3, RECORDS))  # position, velocity, lagged force
    integral, acting = np.zeros(RECORDS), np.zeros(RECORDS)
    out = np.empty((len(e.y) - first, RECORDS))
    blocks = np.zeros((len(out) if e.moving else 1, 5, 5))
    blocks[:, 0, 1] = 1.0
    blocks[:, 1, :4] = [0.0, -DAMPING / MASS, 1 / MASS, 1 / MASS]
    blocks[:, 1, 0] = -(STIFFNESS + BY_SLIDE * e.schedule["s"][first:][: len(blocks)]) / MASS
    blocks[:, 2, 2], blocks[:, 2, 4] = -1 / LAG_S, 1 / LAG_S
    steps = expm(blocks * TS_S)[:, :3]
    for k in range(first, len(e.y)):
        step = steps[min(k - first, len(steps) - 1)]
        force = rng.standard_normal(RECORDS) * np.sqrt(NOISE.force_psd / TS_S)
        y = x[0] + rng.standard_normal(RECORDS) * np.sqrt(NOISE.output_variance)
        out[k - first] = y
        x = step[:, :3] @ x + np.outer(step[:, 3], force) + np.outer(step[:, 4], acting)
        if e.loop is not None:
            integral = integral - KI * TS_S * y
            acting = -KP * y + integral
    return out


@pytest.mark.parametrize(
    ("looped", "moving"), [(True, False), (True, True), (False, False), (False, True)]
)
def test_floor_is_the_mean_over_noise_draws(looped: bool, moving: bool) -> None:
    e = experiment(9000, looped, moving)
    first = free_run(MODEL, e, "zoh", NOISE).counts_from
    squares = np.mean(draw_outputs(e, first) ** 2, axis=0)
    floor = noise_floor(MODEL, e, "zoh", NOISE)
    # Four standard errors of the mean of RECORDS draws.
    chance = 4 * squares.std() / np.sqrt(RECORDS) / squares.mean()
    assert floor.rms[0] ** 2 == pytest.approx(squares.mean(), rel=chance)
    assert chance < 0.1
    # The standard deviation of RECORDS draws is known to 3.5 %. The formula holds for long
    # records; this one lasts about 10 decay times of the cart.
    scatter = np.sqrt(squares).std() / np.sqrt(squares).mean()
    assert floor.spread[0] == pytest.approx(scatter, rel=0.25)
    assert floor_rms(MODEL, e, "zoh", NOISE) == floor.rms


def test_floor_is_the_sum_of_motion_and_sensor_noise() -> None:
    e = experiment(9000, True, False)
    floor = noise_floor(MODEL, e, "zoh", NOISE)
    assert floor.rms[0] ** 2 == pytest.approx(floor.motion[0, 0] + NOISE.output_variance[0])
    # Without force noise only the controller's response to sensor noise moves the cart.
    quiet = noise_floor(MODEL, e, "zoh", NOISE.scaled(force=0.0))
    assert 0 < quiet.motion[0, 0] < floor.motion[0, 0]


@pytest.mark.parametrize("rows", [2000, 9000, 60_000])
def test_floor_is_independent_of_the_number_of_blocks(rows: int) -> None:
    """The floor of a record at rest hardly depends on its length."""
    long = floor_rms(MODEL, experiment(120_000, True, False), "zoh", NOISE)
    # The error is smaller near the start, where the state is known, until the loop has forgotten
    # it: 1 s of the 1.3 s (2000 rows) to 55 s that count.
    share = {2000: 0.3, 9000: 0.05, 60_000: 0.005}[rows]
    assert floor_rms(MODEL, experiment(rows, True, False), "zoh", NOISE) == pytest.approx(
        long, rel=share
    )


@pytest.mark.parametrize("looped", [True, False])
def test_integral_of_the_spectrum_is_the_variance(looped: bool) -> None:
    e = experiment(120_000, looped, False)
    freq_hz = np.arange(2001) * 0.25
    psd = floor_psd(MODEL, e, "zoh", NOISE, freq_hz)
    # The start, without motion, is 1 % of the record.
    assert np.sqrt(np.trapezoid(psd[:, 0], freq_hz)) == pytest.approx(
        floor_rms(MODEL, e, "zoh", NOISE)[0], rel=0.01
    )


def test_true_model_has_an_error_at_the_floor() -> None:
    """The error of the true model consists of the record's noise in the closed loop."""
    e = experiment(20_000, True, False)
    y = draw_outputs(e, 0)[:, :1]
    integral = np.cumsum(-KI * TS_S * y, axis=0)
    flown = replace(e, y=y, u=-KP * y + integral)
    v = validate(MODEL, flown, "zoh", NOISE, NOISE)
    assert v.error_rms[0] == pytest.approx(v.floor_rms[0], rel=4 * v.floor_spread[0])
    assert v.floor_psd.shape == v.error_psd.shape
