"""Test resampling of real-time logs: missing readings and late commands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from in_memory_log import cycle_log
from numpy.lib.recfunctions import drop_fields

from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.greybox.experiment.experiment_from_log import experiment_from_log
from levid.identification.records.command_alignment import align_commands
from levid.identification.records.from_log import from_log
from levid.identification.records.missing_samples import fill_missing, fillable
from levid.identification.records.record import IdentificationError
from levid.identification.records.resampling import resample
from levid.log.reader import Log
from levid.log.signals import Stale, cycle_dtype

LAG = 0.96
NOISE_N = 1e-3
NOISE_M = 1e-7
# Displacement of the sensors per coil force in one period: about (1 ms)^2 / (7 kg).
EFFECT = 1.4e-7 * np.random.default_rng(7).uniform(0.5, 1.5, (9, 9))


def flown(n: int, acting: np.ndarray | None = None) -> Log:
    """Return a log of white forces; row `acting[k]` is the command that acted in period k."""
    rng = np.random.default_rng(0)
    rows = np.zeros(n, cycle_dtype(9, 9))
    rows["cycle"] = 7000 + np.arange(n)
    rows["time_s"] = 7.0 + 1e-3 * np.arange(n)
    rows["v_z_n"] = rng.normal(size=n)
    rows["tau_z_n"] = rows["v_z_n"]
    rows["coil_n"] = rng.normal(size=(n, 9))
    rows["beam_m"] = 0.05
    forces = rows["coil_n"][np.arange(n) if acting is None else acting].astype(float)
    readback, height, speed = np.zeros((n, 9)), np.zeros((n, 9)), np.zeros(9)
    for k in range(2, n):
        readback[k] = readback[k - 1] + LAG * (forces[k - 2] - readback[k - 1])
    for k in range(1, n):
        push = forces[k - 2] @ EFFECT * (k > 1) - 4e-4 * height[k - 1]
        height[k] = height[k - 1] + speed + 0.5 * push
        speed = speed + push
    rows["coil_readback_n"] = readback + NOISE_N * rng.normal(size=(n, 9))
    rows["gap_m"] = height + NOISE_M * rng.normal(size=(n, 9))
    rows["z_m"] = rows["gap_m"].mean(axis=1)
    return cycle_log("02-z.mcap", rows)


def skipping(log: Log, rows: list[int]) -> Log:
    keep = np.delete(np.arange(len(log.rows)), rows)
    return replace(log, rows=log.rows[keep], log_time_ns=log.log_time_ns[keep])


def held_until_next_cycle(n: int, first: int, end: int) -> np.ndarray:
    """Return the acting rows if commands start with a cycle and first to end are skipped."""
    acting = np.arange(n)
    acting[first - 1 : end - 1] = first - 2
    acting[end - 1] = first - 1
    return acting


def test_log_without_missing_rows_is_unchanged() -> None:
    log = flown(1000)
    assert resample(log) == (log, ())


@pytest.mark.parametrize("own_clock", [False, True], ids=["waits for its cycle", "own clock"])
def test_readback_decides_which_command_acted_in_skipped_periods(own_clock: bool) -> None:
    n, first, end = 1000, 100, 105
    acting = held_until_next_cycle(n, first, end)
    if own_clock:  # the amplifier applies the last command on its own clock and holds it
        acting[first - 1 : end] = first - 1
    log = flown(n, acting)
    filled_in, remarks = resample(skipping(log, list(range(first, end))))
    assert remarks[0] == "5 of 1000 periods were skipped (0.50%)"
    np.testing.assert_array_equal(filled_in.rows["cycle"], log.rows["cycle"])
    np.testing.assert_array_equal(filled_in.rows["coil_n"], log.rows["coil_n"][acting])
    np.testing.assert_array_equal(filled_in.rows["v_z_n"], log.rows["v_z_n"][acting])
    np.testing.assert_allclose(filled_in.rows["time_s"], log.rows["time_s"], rtol=1e-12)
    assert len(filled_in.log_time_ns) == n


def test_lost_command_did_not_act() -> None:
    acting = np.arange(1000)
    acting[[300, 500, 501]] = 299, 499, 499
    rows = resample(skipping(flown(1000, acting), [700]))[0].rows
    np.testing.assert_array_equal(rows["coil_n"][:699], flown(1000).rows["coil_n"][acting[:699]])
    remarks = resample(skipping(flown(1000, acting), [700]))[1]
    assert "3 commands acted late, by the amplifiers' readback" in remarks


def test_lost_setpoints_alone_start_the_resampling() -> None:
    acting = np.arange(1000)
    acting[[300, 500, 501]] = 299, 499, 499
    log = flown(1000, acting)
    log.rows["stale"][[300, 500, 501]] = Stale.SETPOINTS
    found, remarks = resample(log)
    np.testing.assert_array_equal(found.rows["coil_n"], flown(1000).rows["coil_n"][acting])
    assert remarks == ("3 commands acted late, by the amplifiers' readback",)


def test_without_readback_the_earlier_command_acted_in_a_skipped_period() -> None:
    log = flown(1000)
    rows = drop_fields(log.rows, "coil_readback_n", usemask=False)
    found, remarks = resample(skipping(replace(log, rows=rows), [700]))
    assert remarks[0] == "1 of 1000 periods were skipped (0.10%)"
    assert found.rows["coil_n"][700] == pytest.approx(log.rows["coil_n"][699])


def test_readback_that_is_not_a_number_is_ignored() -> None:
    log = flown(1000)
    log.rows["coil_readback_n"] = np.nan
    found, remarks = resample(skipping(log, [700]))
    assert remarks[0] == "1 of 1000 periods were skipped (0.10%)"
    assert found.rows["coil_n"][700] == pytest.approx(log.rows["coil_n"][699])


def test_readback_that_does_not_follow_commands_is_ignored() -> None:
    log = flown(1000)
    log.rows["coil_readback_n"] = np.random.default_rng(3).normal(size=(1000, 9))
    n, absent = 1000, np.zeros(1000, bool)
    found = align_commands(
        log.rows["coil_n"].astype(float),
        log.rows["coil_readback_n"].astype(float),
        ~absent,
        absent,
        absent,
    )
    np.testing.assert_array_equal(found.source_row, np.arange(n))
    assert (found.late, found.unexplained) == (0, 0)


def test_stale_readings_are_filled_in_with_errors_of_the_sensor_noise() -> None:
    truth, log = flown(4000), flown(4000)
    rng = np.random.default_rng(5)
    at = np.flatnonzero(rng.uniform(size=3900) < 0.02) + 20
    runs = np.unique(np.concatenate([at, [1000, 1001, 1002, 1003, 1004, 1005]]))
    for row in runs:
        log.rows["gap_m"][row] = log.rows["gap_m"][row - 1]
        log.rows["z_m"][row] = log.rows["z_m"][row - 1]
        log.rows["stale"][row] = Stale.SENSORS | Stale.AMPLIFIERS
    off_before = (log.rows["gap_m"] - truth.rows["gap_m"])[runs]
    rows, remarks = resample(log)
    off = (rows.rows["gap_m"] - truth.rows["gap_m"])[runs]
    # The difference has the noise of the removed reading and the smaller noise of the curve
    # through 24 rows. A stale reading is wrong by the motion in one period.
    assert np.std(off) < 1.5 * NOISE_M
    assert np.std(off_before) > 5 * NOISE_M
    np.testing.assert_allclose(rows.rows["z_m"], rows.rows["gap_m"].mean(axis=1), atol=1e-10)
    assert any(f"{len(runs)} of 4000 rows had no valid heights" in text for text in remarks)
    np.testing.assert_array_equal(rows.rows["coil_n"], truth.rows["coil_n"])


def test_readings_of_cycles_longer_than_a_period_are_replaced() -> None:
    acting = held_until_next_cycle(1000, 401, 404)
    truth, log = flown(1000, acting), flown(1000, acting)
    log.rows["execution_s"][400] = 4e-3
    log.rows["gap_m"][400] += 1e-5
    rows = resample(skipping(log, [401, 402, 403]))[0].rows
    assert np.abs(rows["gap_m"][400] - truth.rows["gap_m"][400]).max() < 1e-6


def test_old_logs_without_the_field_stale_are_read() -> None:
    log = flown(1000)
    names = [name for name in log.rows.dtype.names or () if name != "stale"]
    old = replace(log, rows=log.rows[names].copy())
    assert resample(old) == (old, ())
    assert from_log(old).v.shape == (1000, 3)


def test_records_and_experiments_are_evenly_spaced_and_report_skipped_periods() -> None:
    log = skipping(flown(1000), [100, 101, 500])
    record = from_log(log)
    assert record.v.shape == (1000, 3)
    assert any("3 of 1000 periods" in text for text in record.remarks)
    experiment = experiment_from_log(log, load_model(shipped("models/rig.yaml")))
    assert len(experiment.u) == len(experiment.y) == 1000
    assert {len(values) for values in experiment.schedule.values()} == {1000}
    assert sum("periods" in text for text in experiment.remarks) == 1


def test_record_is_cut_at_a_long_stall() -> None:
    log = skipping(flown(1000), list(range(300, 320)))
    rows, remarks = resample(log)
    np.testing.assert_array_equal(rows.rows["cycle"], 7000 + np.arange(320, 1000))
    assert len(rows.log_time_ns) == 680
    assert remarks[0].startswith("cut to 680 of 1000 rows, from row 320 on")


def test_record_is_cut_to_its_excited_part() -> None:
    log = skipping(flown(1000), list(range(600, 620)))
    log.rows["v_z_n"][:595] = 0.0  # the other columns of the wrench are zero as well
    rows, remarks = resample(log)
    np.testing.assert_array_equal(rows.rows["cycle"], 7000 + np.arange(620, 1000))
    assert remarks[0].startswith("cut to 380 of 1000 rows, from row 620 on")
    log.rows["v_z_n"] = 0.0
    log.rows["coil_excitation_n"][:300, 4] = 1.0
    rows, _ = resample(log)
    np.testing.assert_array_equal(rows.rows["cycle"], 7000 + np.arange(600))


def test_record_is_cut_at_missing_rows_that_known_forces_do_not_explain() -> None:
    """An unknown force acted on the platform there."""
    log = flown(1000)
    log.rows["gap_m"][405:] += 1e-6 * np.arange(595)[:, None]
    rows, remarks = resample(skipping(log, [400, 401, 402, 403, 404, 700]))
    np.testing.assert_array_equal(rows.rows["cycle"], 7000 + np.arange(405, 1000))
    assert remarks[0].startswith("cut to 595 of 1000 rows, from row 405 on")


def test_too_many_missing_rows_are_an_error() -> None:
    rng = np.random.default_rng(2)
    sparse = flown(2000)
    sparse.rows["stale"][rng.uniform(size=2000) < 0.15] = Stale.SENSORS
    with pytest.raises(IdentificationError, match=r"02-z\.mcap: .*no heights in \d+ of \d+ rows"):
        from_log(sparse)
    stalls = [k for k in range(20, 1980) if k % 100 < 15]
    with pytest.raises(IdentificationError, match=r"100 of 2000 rows between two stalls"):
        from_log(skipping(flown(2000), stalls))
    acting = np.arange(2000)
    acting[200:1800:100] -= 50  # forces from too long ago for a late command
    unexplained = flown(2000, acting)
    unexplained.rows["stale"][10] = Stale.SENSORS
    with pytest.raises(IdentificationError, match="16 rows whose readback fits no command"):
        from_log(unexplained)


def test_decreasing_cycle_numbers_are_an_error() -> None:
    log = flown(1000)
    log.rows["cycle"][10:] -= 5
    with pytest.raises(IdentificationError, match=r"cycle: expected increasing numbers.*in row 10"):
        resample(log)


def test_missing_rows_are_fillable_if_enough_rows_around_them_are_known() -> None:
    missing = np.zeros(100, bool)
    missing[[3, 50, 51, 52]] = True  # row 3 is too near to the start for a curve
    missing[70:90] = True
    expected = np.zeros(100, bool)
    expected[50:53] = True
    np.testing.assert_array_equal(fillable(missing, 10), expected)


def test_smooth_motion_is_filled_in_without_known_forces() -> None:
    t = np.arange(600.0)
    values = np.stack([1e-4 * np.sin(0.02 * t), 1e-6 * t], axis=1)
    missing = np.zeros(600, bool)
    missing[200:206] = True
    spoiled = np.where(missing[:, None], 7.0, values)
    found = fill_missing(spoiled, missing, np.zeros((600, 0))).values
    np.testing.assert_allclose(found, values, atol=1e-9)
