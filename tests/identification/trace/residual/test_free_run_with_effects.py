"""Test free runs of models with effects against independent numerical integration."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.control_loop import ControlLoop
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.free_parameters import free_parameters
from levid.identification.greybox.prediction.noise_model import Noise
from levid.identification.records.record import IdentificationError
from levid.identification.trace.linearised.linearisation_point import WorkingPoint
from levid.identification.trace.records.record_from_log import TraceRecord
from levid.identification.trace.records.sensor_and_amplifier_noise import Disturbance
from levid.identification.trace.residual.free_run_error import pooled, record_error
from levid.identification.trace.residual.free_run_with_effects import EffectFreeRun, free_run
from levid.model.controller import pi_controller
from levid.model.effects.base import Placed, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

MASS, DAMPER, SPRING = 2.0, 12.0, 800.0  # 3.2 Hz, damping 0.15
MODEL = f"""
levid: model
name: mass
dof: [{{name: x, unit: m}}]
inputs: [{{name: f, unit: N}}]
input: HOLD
parameters:
  m: {{value: {MASS}, unit: kg, min: 0.1, max: 20}}
  d: {{value: {DAMPER}, unit: N s/m, min: 0, max: 100}}
  k: {{value: {SPRING}, unit: N/m, min: 1, max: 10000}}
M: [[m]]
D: [[d]]
K: [[k]]
"""
TS = 2e-3
ROWS = 5000
SD = 1e-8
ONE = np.eye(1)
PLACES = Places(("x",), ("m",), ONE, ONE, "N", ("N",), "m", np.zeros((0, 2)), np.zeros((0, 2)),
                beam=False, span_s=(0.0, ROWS * TS))  # fmt: skip
KP, KI = np.array([2000.0]), np.array([8000.0])
Force = Callable[[np.ndarray, np.ndarray], np.ndarray]


def multisine_force(seed: int, rms_n: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of time in s: a force of twenty sines between 0.5 and 15 Hz."""
    rng = np.random.default_rng(seed)
    omega, phase = 2 * np.pi * rng.uniform(0.5, 15.0, 20), rng.uniform(0, 2 * np.pi, 20)
    size = rms_n / np.sqrt(10)
    return lambda t: size * np.sin(np.multiply.outer(t, omega) + phase).sum(axis=-1)


def open_record(rms_n: float, force: Force) -> TraceRecord:
    """Return an open-loop record with an unknown force, integrated by scipy to ten digits."""
    u, t = multisine_force(1, rms_n), np.arange(ROWS) * TS

    def motion(time: float, state: np.ndarray) -> np.ndarray:
        x, v = state
        return np.array([v, (u(time) - DAMPER * v - SPRING * x + force(x, v)) / MASS])

    solved = solve_ivp(motion, (0.0, t[-1]), [0.0, 0.0], "DOP853", t, rtol=1e-9, atol=1e-12)
    return _record(u(t)[:, None], solved.y[:1].T, None)


def closed_loop_record(rms_n: float, force: Force) -> TraceRecord:
    """Return a closed-loop record: commands held and one cycle late, 20 steps per period."""
    v = multisine_force(2, rms_n)(np.arange(ROWS) * TS)
    x = speed = integral = acting = 0.0
    u, y, fine = np.empty((ROWS, 1)), np.empty((ROWS, 1)), TS / 20

    def acceleration(x: float, speed: float, held: float) -> float:
        return (held - DAMPER * speed - SPRING * x + float(force(x, speed))) / MASS

    for k in range(ROWS):
        y[k] = x
        integral -= KI[0] * TS * x
        u[k] = v[k] - KP[0] * x + integral
        for _ in range(20):  # Heun's method: relative error (omega Ts / 20)^2, 1e-6
            a = acceleration(x, speed, acting)
            after, faster = x + fine * speed, speed + fine * a
            b = acceleration(after, faster, acting)
            x, speed = x + 0.5 * fine * (speed + faster), speed + 0.5 * fine * (a + b)
        acting = u[k, 0]
    nothing = np.zeros((ROWS, 1))
    return _record(
        u, y, ControlLoop(v[:, None], nothing, nothing, nothing, pi_controller(KP, KI, TS))
    )


def _record(u: np.ndarray, y: np.ndarray, loop: ControlLoop | None) -> TraceRecord:
    y = y + SD * np.random.default_rng(3).standard_normal(y.shape)
    e = Experiment("made", TS, u, y, {}, frozenset(), False, int(loop is not None), loop)
    own = np.zeros_like(u) if loop is None else loop.v
    nothing = np.zeros((ROWS, 3))
    return TraceRecord(
        e, PLACES, np.arange(ROWS) * TS, y, u, 0.0 * own, nothing, nothing, None, "made"
    )


def point(hold: str, *placed: Placed) -> WorkingPoint:
    config = parse_text(MODEL.replace("HOLD", hold), ModelConfig, "mass")
    noise = Disturbance(Noise.independent(np.array([1e-12]), np.array([SD**2])), SD, measured=True)
    parameters = free_parameters(config)
    # The effects are known, so the trajectory may follow the model.
    return WorkingPoint(declared_model(config), parameters, placed, noise, config.input, trust=1.0)


def effect(key: str, amplitude: float, shape: tuple[float, ...] = ()) -> Placed:
    table = all_effects(PLACES, Extent((0.01,), (0.2,), 0.01, 10.0, 0.0))
    return Placed(next(e for e in table if e.key == key), shape, (amplitude,))


def relative_error(run: EffectFreeRun, record: TraceRecord) -> float:
    """Return the rms error divided by the rms motion."""
    rest = slice(run.counts_from, None)
    y = record.experiment.y[rest]
    return float(np.sqrt(np.mean((run.q[rest] - y) ** 2)) / y.std())


CUBIC, COULOMB, SLOW = 1e6, 0.5, 0.01


def hardening(x: np.ndarray, _v: np.ndarray) -> np.ndarray:
    return -CUBIC * x**3


def sliding(_x: np.ndarray, v: np.ndarray) -> np.ndarray:
    return -COULOMB * np.tanh(v / SLOW)


@cache
def made(kind: str, rms_n: float, loop: bool) -> TraceRecord:
    force = {"cubic": hardening, "coulomb": sliding, "none": lambda x, v: 0.0 * x}[kind]
    return (closed_loop_record if loop else open_record)(rms_n, force)


@pytest.mark.parametrize("loop", [False, True])
def test_free_run_of_a_linear_plant_agrees_with_integration(loop: bool) -> None:
    record = made("none", 2.0, loop)
    run = free_run(point("zoh" if loop else "band_limited"), record)
    assert run.settled
    assert run.counts_from == ROWS // 3  # a third of a record shorter than 15 s
    # Linear interpolation over an eighth of a period and Heun's steps: about 1e-5.
    assert relative_error(run, record) < 1e-4


def test_band_limited_free_run_starts_at_the_plants_state() -> None:
    record = made("none", 2.0, loop=False)
    run = free_run(point("band_limited"), record)
    rows = slice(run.counts_from, run.counts_from + 100)
    error = (run.q - record.experiment.y)[rows]
    # Five standard deviations of the sensor noise; the initial state is known better than that.
    assert np.abs(error).max() < 5 * SD


@pytest.mark.parametrize(
    ("rms_n", "loop"), [(6.0, False), (15.0, False), (6.0, True), (15.0, True)]
)
def test_free_run_with_a_strong_cubic_spring_converges(rms_n: float, loop: bool) -> None:
    record = made("cubic", rms_n, loop)
    y = record.experiment.y
    hold = "zoh" if loop else "band_limited"
    # The cubic stiffness is not a small correction: it is up to 1.5 to 10 times the linear one, and
    # a run without it has a large error.
    assert 3 * CUBIC * np.max(y**2) > 1.5 * SPRING
    assert relative_error(free_run(point(hold), record), record) > 0.3
    run = free_run(point(hold, effect("stiffness.cubic", CUBIC)), record)
    assert run.settled
    # Interpolation of the force over six rows has an error of (omega Ts)^6 / 300, 1e-4 at the
    # harmonics of the stiffest motion. The nonlinear motion amplifies this error and that of the
    # initial state a hundred times before they decay.
    assert relative_error(run, record) < 1e-2


@pytest.mark.parametrize("loop", [False, True])
def test_free_run_with_coulomb_friction_converges(loop: bool) -> None:
    record = made("coulomb", 2.0, loop)
    hold = "zoh" if loop else "band_limited"
    without = relative_error(free_run(point(hold), record), record)
    run = free_run(point(hold, effect("friction.coulomb", COULOMB, (SLOW,))), record)
    assert run.settled
    # The force changes sign within a few rows, faster than a polynomial can follow: an error of a
    # tenth of the friction in one of a hundred rows.
    assert relative_error(run, record) < 3e-3 * without
    assert without > 0.02


def test_diverging_free_run_is_reported_as_not_settled() -> None:
    # The softening exceeds the linear stiffness: there is no bounded trajectory.
    record = made("none", 10.0, loop=False)
    with np.errstate(all="ignore"):
        run = free_run(point("band_limited", effect("stiffness.cubic", -1e9)), record)
    assert not run.settled


def test_error_of_a_wrong_model_is_its_bias() -> None:
    record = made("cubic", 10.0, loop=True)
    right, wrong = (
        record_error(point("zoh", *placed), record)
        for placed in ((effect("stiffness.cubic", CUBIC),), ())
    )
    assert right.rows == ROWS - ROWS // 3
    rest = record.experiment.y[ROWS // 3 :]
    run = free_run(point("zoh"), record)
    bias = np.mean((rest - run.q[ROWS // 3 :]) ** 2)
    assert wrong.squares * SD**2 == pytest.approx(bias, rel=1e-9)
    assert wrong.pose_squares[0] == pytest.approx(bias, rel=1e-9)
    assert wrong.squares > 1e3 * right.squares
    # Welch's spectrum sums to the mean square without the mean.
    spread = np.var(rest - run.q[ROWS // 3 :])
    assert np.sum(wrong.psd) * wrong.freq_hz[1] == pytest.approx(spread, rel=0.2)
    error, floor = pooled([right, right])
    assert error == pytest.approx(np.sqrt(right.squares))
    assert floor == pytest.approx(np.sqrt(right.floor))


def test_closed_loop_without_zoh_input_is_rejected() -> None:
    record = made("none", 2.0, loop=True)
    with pytest.raises(IdentificationError, match="'made': expected input: zoh in a closed loop"):
        free_run(point("band_limited"), record)
