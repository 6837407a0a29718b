"""Test experiments from logs: moving schedules, noise correlations, attached models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from in_memory_log import cycle_log, without

from levid.config.model import ModelConfig, Scheduling, load_model
from levid.config.shipped import shipped
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.experiment_from_log import experiment_from_log
from levid.identification.greybox.prediction.noise_model import Noise
from levid.identification.greybox.prediction.prediction_errors import predict
from levid.identification.records.record import IdentificationError
from levid.identification.records.rig_model import rig_model
from levid.log.reader import Log
from levid.log.signals import cycle_dtype

TIME_S = 1e-3 * np.arange(4000)


def flown(beam_m: np.ndarray) -> Log:
    """Return a log in which only the beam moves, along `beam_m`."""
    rows = np.zeros(len(TIME_S), cycle_dtype(9, 9))
    rows["cycle"] = np.arange(len(rows))
    rows["time_s"] = TIME_S
    rows["beam_m"] = beam_m
    rows["beam_m_s"] = np.gradient(beam_m, TIME_S)
    return cycle_log("01-beam.mcap", rows)


def model_with_derived_beam_speed() -> ModelConfig:
    """Return the rig's model with the beam speed derived from its position."""
    model = load_model(shipped("models/rig.yaml"))
    v_b = Scheduling(unit="m/s", signal="beam_m", derivative=True)
    return model.model_copy(update={"scheduling": {**model.scheduling, "v_b": v_b}})


@pytest.mark.parametrize(
    ("beam_m", "moving"),
    [
        (np.full(4000, 0.05), False),
        (0.1 * TIME_S / 4, True),
        # Only 0.1 mm of a range of 200 mm, but 9 mm/s and 1.8 m/s^2.
        (0.05 + 5e-5 * np.sin(2 * np.pi * 30 * TIME_S), True),
        # The encoder's last digit toggles: up to 8 mm/s for a still beam.
        (0.05 + 2e-6 * np.random.default_rng(1).normal(size=4000).round(), False),
        (0.05 + 2e-6 * (TIME_S > 2.0), False),
    ],
    ids=["still", "slow", "oscillates", "encoder toggles", "one encoder step"],
)
def test_schedule_with_small_position_but_large_velocity_is_moving(
    beam_m: np.ndarray, moving: bool
) -> None:
    assert experiment_from_log(flown(beam_m), model_with_derived_beam_speed()).moving == moving


def test_velocity_of_the_drive_alone_makes_the_schedule_moving() -> None:
    log = flown(0.05 + 5e-5 * np.sin(2 * np.pi * 30 * TIME_S))
    rows = log.rows.copy()
    rows["beam_m"] = 0.05  # a coarse encoder; the drive measures its speed
    model = model_with_derived_beam_speed()
    assert experiment_from_log(replace(log, rows=rows), model).moving
    rows["beam_m_s"] = 0.0
    assert not experiment_from_log(replace(log, rows=rows), model).moving


def test_noise_correlations_follow_from_coil_and_sensor_positions() -> None:
    log, model = flown(np.full(4000, 0.05)), load_model(shipped("models/rig.yaml"))
    for correlations in experiment_from_log(log, model).correlations or ():
        np.testing.assert_allclose(correlations, np.eye(3), atol=1e-15)  # the grid is balanced
    # Without the corner at (R, R): sum x^2 = sum y^2 = 5 R^2, sum 1 = 8, sum x = sum y = -R,
    # sum x y = -R^2. The pose's correlations are those of the inverse.
    text = log.attachments["rig.yaml"]
    for axis in (b"x", b"y"):
        before, after = text.split(b"coil_%s_m: [0.12, " % axis)
        text = before + b"coil_%s_m: [" % axis + after
    cut = np.zeros(len(log.rows), cycle_dtype(8, 8))
    for name in cut.dtype.names or ():
        cut[name] = log.rows[name][..., 1:] if log.rows[name].ndim > 1 else log.rows[name]
    less = replace(log, rows=cut, attachments={**log.attachments, "rig.yaml": text})
    wrench, pose = experiment_from_log(less, model).correlations or ((), ())
    c, s = 1 / 5, 1 / np.sqrt(40)
    expected = np.array([[1, -c, -s], [-c, 1, -s], [-s, -s, 1]])
    np.testing.assert_allclose(wrench, expected, rtol=1e-12)
    inverse = np.linalg.inv(expected)
    size = np.sqrt(np.diag(inverse))
    np.testing.assert_allclose(pose, inverse / np.outer(size, size), rtol=1e-12)


def test_model_attached_to_the_log_is_used() -> None:
    log, shipped_model = flown(np.full(4000, 0.05)), load_model(shipped("models/rig.yaml"))
    assert rig_model(log) == shipped_model  # without model.yaml the shipped model is used
    own = shipped_model.model_copy(update={"name": "mine"})
    text = own.model_dump_json(exclude_none=True).encode()
    assert rig_model(replace(log, attachments={**log.attachments, "model.yaml": text})) == own
    assert rig_model(replace(log, attachments={})) is None
    broken = {**log.attachments, "model.yaml": b"levid: model\n"}
    with pytest.raises(IdentificationError, match=r"model\.yaml: name: required key is missing"):
        rig_model(replace(log, attachments=broken))


def test_constant_force_of_the_model_does_not_change_predictions() -> None:
    # Each record has its own fitted constant force, so the model's weight has no effect.
    log = flown(0.1 * np.sin(2 * np.pi * TIME_S))
    rng = np.random.default_rng(1)
    rows = log.rows.copy()
    rows["coil_n"] = rng.normal(8.0, 0.1, rows["coil_n"].shape)
    model = load_model(shipped("models/rig.yaml"))
    light = model.model_copy(update={"force": (*model.force[:2], 0.0)})
    experiment = experiment_from_log(replace(log, rows=rows), model)
    noise = Noise.independent(np.full(3, 1e-6), np.full(3, 1e-14))
    heavy, light = (
        predict(declared_model(one), experiment, "zoh", noise).errors for one in (model, light)
    )
    assert experiment.moving
    np.testing.assert_array_equal(heavy, light)


@pytest.mark.parametrize("name", ["psi_rad", "z_ref_m", "v_psi_n_m", "ff_z_n", "coil_n"])
def test_missing_field_of_the_fit_is_named(name: str) -> None:
    log = without(flown(np.full(4000, 0.05)), name)
    with pytest.raises(IdentificationError, match=f"found no field {name}, which the declared"):
        experiment_from_log(log, load_model(shipped("models/rig.yaml")))


def test_missing_signal_of_two_scheduling_variables_is_named_once() -> None:
    log = without(flown(np.full(4000, 0.05)), "beam_m_s")
    with pytest.raises(IdentificationError, match=r"found no beam_m_s$"):
        experiment_from_log(log, load_model(shipped("models/rig.yaml")))


def test_log_without_coil_excitation_has_none() -> None:
    log, model = flown(np.full(4000, 0.05)), load_model(shipped("models/rig.yaml"))
    whole, less = (
        experiment_from_log(one, model) for one in (log, without(log, "coil_excitation_n"))
    )
    np.testing.assert_array_equal(whole.loop.v, less.loop.v)


def test_missing_rows_without_cycle_numbers_are_an_error() -> None:
    log, model = flown(np.full(4000, 0.05)), load_model(shipped("models/rig.yaml"))
    kept = np.arange(4000) != 2000
    cut = replace(log, rows=log.rows[kept], log_time_ns=log.log_time_ns[kept])
    with pytest.raises(IdentificationError, match=r"missing samples: .* before row 2000"):
        experiment_from_log(without(cut, "cycle"), model)


def test_rate_that_contradicts_the_log_times_is_an_error() -> None:
    log = replace(flown(np.full(4000, 0.05)), rate_hz=900.0)
    with pytest.raises(IdentificationError, match=r"rate_hz: .* found 900 Hz"):
        experiment_from_log(log, load_model(shipped("models/rig.yaml")))
