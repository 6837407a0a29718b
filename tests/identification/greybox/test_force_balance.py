"""The force balance: exact without noise, unbiased with noise, intervals that cover the band."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.force_balance.band_limited_signals import (
    upper_limit,
    velocity_limit,
)
from levid.identification.greybox.force_balance.instrumental_variables import (
    ForceBalance,
    fit_force_balance,
    force_percent,
)
from levid.identification.greybox.free_parameters import free_parameters
from levid.identification.records.record import IdentificationError

TS, ROWS = 0.002, 8000
TRUE = {"m": 2.0, "d": 12.0, "k": 800.0, "tau": 0.0036}
MODEL = """
levid: model
name: mass
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
parameters:
  m: {value: 1.5, unit: kg, min: 0.1, max: 10}
  d: {value: 20.0, unit: N s/m, min: -50, max: 100}
  k: {value: 500.0, unit: N/m, min: -5000, max: 5000}
  tau: {value: 0.0, unit: s, min: -0.002, max: 0.02}
M: [[m]]
D: [[d]]
K: [[k]]
delay_s: tau
"""
CONFIG = parse_text(MODEL, ModelConfig, "mass")


def experiment(noise_m: float, seed: int = 1) -> tuple[Experiment, Experiment]:
    """Return a record with noise, and the same without, for instruments; 3 N act besides.

    The force is held; the delay of 1.8 rows is simulated at a tenth of the row's time.
    """
    rng, fine = np.random.default_rng(seed), TS / 10
    u = lfilter([0.3], [1.0, -0.7], rng.normal(size=ROWS))
    held = np.concatenate([np.zeros(18), np.repeat(u, 10)])[: 10 * ROWS]
    m, d, k = (TRUE[name] for name in ("m", "d", "k"))
    num, den, _ = cont2discrete(([1 / m], [1.0, d / m, k / m]), fine)
    x = lfilter(num.ravel(), den, held + 3.0)[::10]
    made = [
        Experiment("r", TS, u[:, None], y[:, None], {}, frozenset(), False)
        for y in (x + noise_m * rng.normal(size=ROWS), x)
    ]
    return made[0], made[1]


def fitted(of: Experiment, instrument: Experiment) -> ForceBalance:
    p = free_parameters(CONFIG)
    bounds = (p.low, p.high, p.scale)
    return fit_force_balance(declared_model(CONFIG), [of], "zoh", p.names, bounds, [instrument])


def test_noise_free_record_gives_the_parameters() -> None:
    _, clean = experiment(0.0)
    found = fitted(clean, clean).as_values()
    for name, true in TRUE.items():
        # Aliases of the held force's images are below 1 %, most of it far above the resonance.
        assert found[name] == pytest.approx(true, rel=0.01)
    model = declared_model(CONFIG).with_values(found)
    assert force_percent(model, [clean], "zoh")[0] < 1.0
    assert force_percent(declared_model(CONFIG), [clean], "zoh")[0] > 20.0


def test_instruments_remove_the_bias_by_noise() -> None:
    """The noise is 5 % of the motion: least squares loses more of the stiffness than its error."""
    _, clean = experiment(0.0)
    noisy, _ = experiment(0.05 * float(clean.y.std()))
    with_instruments, plain = fitted(noisy, clean), fitted(noisy, noisy)
    i = with_instruments.names.index("k")
    assert abs(with_instruments.values[i] - TRUE["k"]) < 4 * with_instruments.se[i]
    assert abs(plain.values[i] - TRUE["k"]) > 2 * abs(with_instruments.values[i] - TRUE["k"])


def test_intervals_cover_the_truth_and_what_band_and_order_change() -> None:
    found = [fitted(*experiment(1e-5, seed)) for seed in range(6)]
    inside = [np.abs(f.values - [TRUE[name] for name in f.names]) <= f.half_width for f in found]
    assert np.mean(inside) > 0.9
    for f in found:
        assert np.all(f.half_width >= np.abs(f.by_band - f.values).max(axis=0))
        assert np.all(f.half_width >= np.abs(f.by_order - f.values))


def test_limit_is_where_the_output_reaches_its_noise() -> None:
    quiet, clean = experiment(1e-7)
    loud, _ = experiment(0.02 * float(clean.y.std()))
    assert upper_limit(loud, "zoh") < upper_limit(quiet, "zoh") <= 0.177 / TS


def test_moving_schedule_is_refused() -> None:
    noisy, clean = experiment(1e-6)
    moving = Experiment("r", TS, noisy.u, noisy.y, {}, frozenset(), True)
    with pytest.raises(IdentificationError, match="expected a constant schedule"):
        fitted(moving, clean)
    assert np.isnan(force_percent(declared_model(CONFIG), [moving], "zoh")).all()


def test_velocity_limit_is_where_noise_is_a_hundredth_of_the_velocity() -> None:
    rng, t = np.random.default_rng(2), TS * np.arange(ROWS)
    amplitude_m, f_hz, sd_m = 0.01, 2.0, 2e-6
    y = (amplitude_m * np.sin(2 * np.pi * f_hz * t) + sd_m * rng.normal(size=ROWS))[:, None]
    e = Experiment("r", TS, np.zeros((ROWS, 1)), y, {}, frozenset(), False)
    # Noise below f has the power 8 pi^2 Ts sd^2 f^3 / 3 of a velocity.
    power = 0.5 * (2 * np.pi * f_hz * amplitude_m) ** 2
    expected = (1e-4 * 3.0 * power / (8.0 * np.pi**2 * TS * sd_m**2)) ** (1.0 / 3.0)
    # The grid of Welch's segments is 0.25 Hz, and their window leaks a few per cent of a line.
    assert velocity_limit(e, np.array([sd_m])) == pytest.approx(expected, rel=0.05)
    assert velocity_limit(e, np.array([1e-9])) == 0.4 / TS


def test_velocity_limit_leaves_no_motion_out_that_is_above_its_noise() -> None:
    rng, t = np.random.default_rng(2), TS * np.arange(ROWS)
    slow, fast = (np.sin(2 * np.pi * f_hz * t) for f_hz in (2.0, 12.0))
    sd_m = 2e-4
    # The noise below 12 Hz is 20 % of the velocity's RMS, but the line at 12 Hz is half of it.
    y = (0.01 * slow + 0.0016 * fast + sd_m * rng.normal(size=ROWS))[:, None]
    e = Experiment("r", TS, np.zeros((ROWS, 1)), y, {}, frozenset(), False)
    assert 12.0 < velocity_limit(e, np.array([sd_m])) < 14.0
    alone = (0.01 * slow + sd_m * rng.normal(size=ROWS))[:, None]
    without = Experiment("r", TS, np.zeros((ROWS, 1)), alone, {}, frozenset(), False)
    # A line is 1.5 times the grid wide in the window of Welch's segments, and leaks beyond it.
    assert velocity_limit(without, np.array([sd_m])) < 8.0
