"""A record as the declared model sees it: when its schedule moves, what its noise has in common."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cycle_log import cycle_log

from levid.config.model import ModelConfig, Scheduling, load_model
from levid.config.shipped import shipped
from levid.identification.greybox.experiment import experiment_from_log
from levid.identification.greybox.model_file import declared_model
from levid.identification.greybox.noise_model import Noise
from levid.identification.greybox.prediction_errors import predict
from levid.identification.records.from_log import rig_model
from levid.identification.records.record import IdentificationError
from levid.log.reader import Log
from levid.log.signals import cycle_dtype

TIME_S = 1e-3 * np.arange(4000)


def flown(beam_m: np.ndarray) -> Log:
    """Return the log of a beam that went that way, and of nothing else."""
    rows = np.zeros(len(TIME_S), cycle_dtype(9, 9))
    rows["cycle"] = np.arange(len(rows))
    rows["time_s"] = TIME_S
    rows["beam_m"] = beam_m
    rows["beam_m_s"] = np.gradient(beam_m, TIME_S)
    return cycle_log("01-beam.mcap", rows)


def derived() -> ModelConfig:
    """Return the rig's model with the beam's speed from its place, as for a drive without it."""
    model = load_model(shipped("models/rig.yaml"))
    v_b = Scheduling(unit="m/s", signal="beam_m", derivative=True)
    return model.model_copy(update={"scheduling": {**model.scheduling, "v_b": v_b}})


@pytest.mark.parametrize(
    ("beam_m", "moving"),
    [
        (np.full(4000, 0.05), False),
        (0.1 * TIME_S / 4, True),
        # 0.1 mm of a range of 200 mm, but with 9 mm/s and 1.8 m/s^2.
        (0.05 + 5e-5 * np.sin(2 * np.pi * 30 * TIME_S), True),
        # An encoder's last digit: of a beam that stands, up to 8 mm/s.
        (0.05 + 2e-6 * np.random.default_rng(1).normal(size=4000).round(), False),
        (0.05 + 2e-6 * (TIME_S > 2.0), False),
    ],
    ids=["stands", "goes slowly", "shakes", "jitters", "one digit more"],
)
def test_a_schedule_moves_by_its_derivatives_too(beam_m: np.ndarray, moving: bool) -> None:
    assert experiment_from_log(flown(beam_m), derived()).moving == moving


def test_an_acceleration_alone_moves_the_schedule() -> None:
    log = flown(0.05 + 5e-5 * np.sin(2 * np.pi * 30 * TIME_S))
    rows = log.rows.copy()
    rows["beam_m"] = 0.05  # as read by a coarse encoder; the drive knows its speed
    model = derived()
    assert experiment_from_log(replace(log, rows=rows), model).moving
    rows["beam_m_s"] = 0.0
    assert not experiment_from_log(replace(log, rows=rows), model).moving


def test_noise_of_wrench_and_pose_is_correlated_as_the_places_are() -> None:
    log, model = flown(np.full(4000, 0.05)), load_model(shipped("models/rig.yaml"))
    for correlations in experiment_from_log(log, model).correlations or ():
        np.testing.assert_allclose(correlations, np.eye(3), atol=1e-15)  # the grid is balanced
    # Without the corner at (R, R) sums of x^2 and y^2 are 5 R^2, of 1 are 8, of x, y, x y are -R,
    # -R, -R^2; sensors average by the inverse.
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


def test_logs_are_identified_with_the_model_of_the_rig_that_flew_them() -> None:
    log, shipped_one = flown(np.full(4000, 0.05)), load_model(shipped("models/rig.yaml"))
    assert rig_model(log) == shipped_one  # its rig.yaml is alone: what is shipped stands in
    own = shipped_one.model_copy(update={"name": "mine"})
    text = own.model_dump_json(exclude_none=True).encode()
    assert rig_model(replace(log, attachments={**log.attachments, "model.yaml": text})) == own
    assert rig_model(replace(log, attachments={})) is None
    broken = {**log.attachments, "model.yaml": b"levid: model\n"}
    with pytest.raises(IdentificationError, match=r"model\.yaml: name: required key is missing"):
        rig_model(replace(log, attachments=broken))


def test_a_constant_force_of_the_model_changes_no_prediction() -> None:
    # The weight, say: a record has a constant force of its own, fitted whatever the model has.
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
