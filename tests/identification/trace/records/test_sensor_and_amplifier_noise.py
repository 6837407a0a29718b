"""Test estimates of sensor and amplifier noise, tones in the noise, and held-out records.

Records come from tests/independent_rig_simulation.py, which shares no code with levid.
"""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from effect_test_helpers import rig_places

from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.covariance_scaling import correlation
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.control_loop import ControlLoop
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.free_run.free_run_noise_floor import motion_covariance
from levid.identification.greybox.prediction.noise_model import Noise
from levid.identification.greybox.prediction.prediction_errors import predict
from levid.identification.trace.records.record_from_log import TraceRecord, split
from levid.identification.trace.records.sensor_and_amplifier_noise import disturbance, sensor_noise
from levid.identification.trace.records.spectral_lines import spectral_lines
from levid.model.controller import pi_controller
from levid.model.effects.base import Places

TS = 1e-3
MODEL = declared_model(load_model(shipped("models/rig.yaml")))
PLACES = rig_places()
WITHOUT_A_CORNER = rig_places(lacks=1)
"""The rig without the coil and the sensor of one corner."""
X_B = 0.05


def record(
    rig: ModuleType,
    seed: int,
    v: np.ndarray,
    *,
    v_logged: bool = False,
    name: str = "still",
    places: Places = PLACES,
) -> TraceRecord:
    """Fly v (N, 3) with the beam at 50 mm; the log contains v only if `v_logged`."""
    shape = places.sensor_shape
    # 2 s are many times the slowest time constant of the loop.
    settle = 2000
    y, u = rig.simulate(
        rig.sampled_plant(X_B, TS), np.vstack([np.zeros((settle, 3)), v]), seed=seed, places=shape
    )
    y, u, rows = y[settle:], u[settle:], len(v)
    # Independent sensor noise e has a part T e in the pose and a non-rigid part, which are
    # independent. So the non-rigid part can be drawn separately from the flown pose.
    own = np.random.default_rng([seed, 1]).normal(0.0, rig.SENSOR_NOISE_M, (rows, len(shape)))
    gap = y @ shape.T + own - own @ places.decoupling.T @ shape.T
    nothing = np.zeros((rows, 3))
    schedule = {"x_b": np.full(rows, X_B), "v_b": np.zeros(rows), "a_b": np.zeros(rows)}
    controller = pi_controller(rig.KP, rig.KI, TS)
    loop = ControlLoop(v if v_logged else nothing, nothing, nothing, nothing, controller)
    e = Experiment(name, TS, u, y, schedule, frozenset({"a_b"}), False, 1, loop, hold="zoh")
    beam = np.zeros((rows, 3))
    beam[:, 0] = X_B
    return TraceRecord(
        e, places, np.arange(rows) * TS, gap, u @ np.linalg.pinv(shape),
        np.zeros((rows, len(shape))), beam, nothing, None, "wrench" if v_logged else "still",
    )  # fmt: skip


def force_noise(rig: ModuleType, places: Places = PLACES) -> np.ndarray:
    """Return the two-sided density of the wrench noise of all amplifiers."""
    shape = places.coil_shape
    return shape.T @ shape * rig.COIL_NOISE_N**2 * rig.COIL_NOISE_HELD_S


def still(
    rig: ModuleType, seed: int, seconds: float = 20.0, places: Places = PLACES
) -> TraceRecord:
    return record(rig, seed, np.zeros((round(seconds / TS), 3)), places=places)


def mains_hum(rows: int, force_n: float) -> np.ndarray:
    v = np.zeros((rows, 3))
    v[:, 2] = force_n * np.sin(2 * np.pi * 50.0 * np.arange(rows) * TS)
    return v


FALLBACK = 20.0
"""Ratio of the initial guess of the force noise to the true force noise."""


def test_still_records_determine_sensor_and_amplifier_noise(rig: ModuleType) -> None:
    fallback = Noise(FALLBACK * force_noise(rig), 1e-13 * np.eye(3))
    found = disturbance(MODEL, [still(rig, seed) for seed in (1, 2)], fallback)
    assert found.measured
    # A median over thousands of bins is accurate to 1 %; quantisation adds 0.5 %.
    assert found.sensor_sd == pytest.approx(rig.SENSOR_NOISE_M, rel=0.02)
    T = PLACES.decoupling
    np.testing.assert_allclose(
        found.noise.output_variance, np.diag(T @ T.T) * found.sensor_sd**2, rtol=1e-12
    )
    # The positions are symmetric, so noise of different DOF is uncorrelated.
    for covariance in (found.noise.force_density, found.noise.output_covariance):
        np.testing.assert_allclose(correlation(covariance), np.eye(3), atol=1e-15)
    # 20 s have about 400 lines below 80 Hz, 1200 with three DOF, with correlated neighbours: the
    # level is known to 3 %, plus a share for the spectrum's shape; four of these.
    np.testing.assert_allclose(found.noise.force_psd, np.diag(force_noise(rig)), rtol=0.15)


def test_noise_of_asymmetric_positions_is_correlated_between_dof(rig: ModuleType) -> None:
    made = [still(rig, seed, places=WITHOUT_A_CORNER) for seed in (1, 2)]
    fallback = Noise.independent(
        FALLBACK * np.diag(force_noise(rig, WITHOUT_A_CORNER)), np.full(3, 1e-13)
    )
    noise = disturbance(MODEL, made, fallback).noise
    np.testing.assert_allclose(
        correlation(noise.force_density),
        correlation(force_noise(rig, WITHOUT_A_CORNER)),
        rtol=1e-12,
    )
    np.testing.assert_allclose(
        np.diag(noise.force_density), np.diag(force_noise(rig, WITHOUT_A_CORNER)), rtol=0.15
    )
    for r in made:
        errors = predict(MODEL, r.experiment, "zoh", noise).errors
        # 20 000 rows determine a variance to 1 %, a correlation to 0.7 %: five of these. If the
        # correlation of the sensor noise is ignored, 0.22 remains between two DOF.
        np.testing.assert_allclose(np.cov(errors.T), np.eye(3), atol=0.05)


@pytest.mark.parametrize("force_n", [0.05, 1.0])
def test_mains_hum_does_not_change_the_noise_estimates(rig: ModuleType, force_n: float) -> None:
    rows = 20_000
    # In its bin, hum of 0.05 N is 10^6 times the amplifiers' density, 1 N nearly 10^9.
    plain, humming = (
        disturbance(
            MODEL,
            [record(rig, 3, mains_hum(rows, size))],
            Noise(FALLBACK * force_noise(rig), 1e-13 * np.eye(3)),
        )
        for size in (0.0, force_n)
    )
    assert humming.sensor_sd == pytest.approx(plain.sensor_sd, rel=0.01)
    # A line 10^9 above the noise leaks through the Hann window into 30 of 400 bins on either side,
    # which shifts the median of the scattered levels.
    np.testing.assert_allclose(humming.noise.force_psd, plain.noise.force_psd, rtol=0.15)


def test_noise_of_one_worse_sensor_does_not_affect_the_others(
    rig: ModuleType,
) -> None:
    made = still(rig, 4)
    gap = made.gap.copy()
    gap[:, 3] += np.random.default_rng(9).normal(0.0, 2e-6, made.rows)
    found = sensor_noise([replace(made, gap=gap)])
    assert found[3] == pytest.approx(2e-6, rel=0.05)
    others = np.delete(found, 3)
    np.testing.assert_allclose(others, rig.SENSOR_NOISE_M, rtol=0.05)


def test_force_noise_without_a_still_record_is_that_of_the_fit(rig: ModuleType) -> None:
    v = np.random.default_rng(1).normal(0.0, rig.EXCITATION_RMS, (8000, 3))
    fallback = Noise.independent(np.array([1.0, 2.0, 3.0]), np.full(3, 1e-13))
    found = disturbance(MODEL, [record(rig, 5, v, v_logged=True)], fallback)
    assert not found.measured
    np.testing.assert_array_equal(found.noise.force_psd, fallback.force_psd)
    # Above 250 Hz, white forces move the platform by less than the noise.
    assert found.sensor_sd == pytest.approx(rig.SENSOR_NOISE_M, rel=0.1)


@pytest.mark.parametrize("places", [PLACES, WITHOUT_A_CORNER], ids=["all", "without a corner"])
def test_noise_floor_equals_the_motion_in_a_long_flight(rig: ModuleType, places: Places) -> None:
    rows = 300_000
    plant, shape, T = rig.sampled_plant(X_B, TS), places.sensor_shape, places.decoupling
    y, _ = rig.simulate(plant, np.zeros((rows, 3)), seed=7, places=shape)
    noise = Noise(
        force_noise(rig, places), T @ T.T * (rig.SENSOR_NOISE_M**2 + rig.SENSOR_STEP_M**2 / 12)
    )
    # 60 s, so that the start with its known state is negligible.
    floor = motion_covariance(MODEL, still(rig, 1, 60.0).experiment, "zoh", noise)
    # Sensor noise is independent of the platform's motion.
    seen = np.cov(y[5000:].T) - noise.output_covariance
    size = np.sqrt(np.diag(floor))
    # Modes of 3 to 10 Hz decay within about 0.1 s: 300 s have 3000 independent values, which
    # determine a variance to 2.6 %; four of these.
    np.testing.assert_allclose(seen / size / size[:, None], floor / size / size[:, None], atol=0.1)


def test_tone_frequency_is_found_between_the_bins(rig: ModuleType) -> None:
    made = still(rig, 12, 10.0)
    t = made.time_s
    for f_hz in (17.03, 49.87, 120.44):
        line = 5e-8 * np.sin(2 * np.pi * f_hz * t)
        found = spectral_lines([replace(made, gap=made.gap + line[:, None])])
        # Bins are 1 / 9 Hz apart; interpolation of three bins of a Hann window is accurate to a
        # twentieth of that for a line 100 times above the noise.
        assert len(found) == 1
        assert found[0] == pytest.approx(f_hz, abs=0.006)


def test_tones_in_one_sensor_and_in_all_sensors_are_found(rig: ModuleType) -> None:
    made = still(rig, 12, 10.0)
    gap = made.gap.copy()
    gap[:, 5] += 5e-8 * np.sin(2 * np.pi * 30.0 * made.time_s)
    gap += 1e-7 * np.sin(2 * np.pi * 50.0 * made.time_s)[:, None]
    found = spectral_lines([replace(made, gap=gap)])
    assert len(found) == 2
    assert found[0] == pytest.approx(50.0, abs=0.006)  # the strongest first
    assert found[1] == pytest.approx(30.0, abs=0.02)


def test_white_noise_and_excited_records_give_no_tone(rig: ModuleType) -> None:
    made = still(rig, 20, 8.0)
    # A bin exceeds 30 times the mean of 26 neighbours (about half of them independent) with
    # probability (1 + 30 / 13)^-13 = 2e-7: 0.05 in 8 records with 10 spectra of 3500 bins.
    for seed in range(8):
        noise = np.random.default_rng(seed).normal(0.0, 1e-7, made.gap.shape)
        assert spectral_lines([replace(made, gap=noise)]) == ()
    assert spectral_lines([record(rig, 30, mains_hum(8000, 1.0), v_logged=True)]) == ()


def test_platform_motion_by_noise_gives_no_tone(rig: ModuleType) -> None:
    assert spectral_lines([still(rig, 100 + seed, 8.0) for seed in range(20)]) == ()


def named(record: TraceRecord, name: str, kind: str) -> TraceRecord:
    return replace(record, kind=kind, experiment=replace(record.experiment, name=name))


def test_every_fourth_record_of_a_kind_is_held_out(rig: ModuleType) -> None:
    made = still(rig, 1, 4.0)
    kinds = ["a", "b", "a", "a", "b", "a", "a", "a"]
    train, held = split([named(made, str(i), kind) for i, kind in enumerate(kinds)])
    # The second and the sixth of six records of kind a; the second of two of kind b.
    assert [r.name for r in held] == ["2", "4", "7"]
    assert [r.name for r in train] == ["0", "1", "3", "5", "6"]
    assert all(r.rows == made.rows for r in (*train, *held))


def test_single_record_of_a_kind_is_split_without_overlap(rig: ModuleType) -> None:
    made = still(rig, 1, 4.0)
    (train,), (held,) = split([made])
    assert train.rows == 3000
    assert train.rows + held.rows == made.rows
    np.testing.assert_array_equal(np.vstack([train.gap, held.gap]), made.gap)
    np.testing.assert_array_equal(
        np.vstack([train.experiment.y, held.experiment.y]), made.experiment.y
    )
    assert held.time_s[0] - train.time_s[-1] == pytest.approx(TS)


def test_record_too_short_to_split_is_fitted_whole(rig: ModuleType) -> None:
    short = still(rig, 1, 2.0)  # its last quarter is 0.5 s, less than 1 s
    train, held = split([short])
    assert held == []
    assert train[0] is short


def test_equal_records_are_distinguished_by_their_order(rig: ModuleType) -> None:
    made = still(rig, 1, 3.0)
    same = [
        replace(made) for _ in range(4)
    ]  # equal names, kinds and times, as from repeated sessions
    train, held = split(same)
    assert [next(i for i, r in enumerate(same) if r is t) for t in train] == [0, 2, 3]
    assert held[0] is same[1]


def test_force_noise_is_found_from_an_initial_guess_far_off(rig: ModuleType) -> None:
    # The initial guess may be a factor of a million too large, which needs several iterations.
    records = [still(rig, 1)]
    near, far = (
        disturbance(MODEL, records, Noise(times * force_noise(rig), 1e-13 * np.eye(3)))
        for times in (FALLBACK, 1e6)
    )
    np.testing.assert_allclose(far.noise.force_psd, near.noise.force_psd, rtol=1e-3)
