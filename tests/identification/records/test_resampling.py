"""Logs of real time made even: what was read when, and which command acted when."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cycle_log import cycle_log
from numpy.lib.recfunctions import drop_fields

from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.greybox.experiment import experiment_from_log
from levid.identification.records.command_alignment import acted
from levid.identification.records.from_log import from_log
from levid.identification.records.missing_samples import bridged, filled
from levid.identification.records.record import IdentificationError
from levid.identification.records.resampling import without_gaps
from levid.log.reader import Log
from levid.log.signals import Stale, cycle_dtype

LAG = 0.96
NOISE_N = 1e-3
NOISE_M = 1e-7
# What a force of a coil does to the sensors in a period squared, some 1 / (7 kg) of 1 ms squared.
EFFECT = 1.4e-7 * np.random.default_rng(7).uniform(0.5, 1.5, (9, 9))


def flown(n: int, acting: np.ndarray | None = None) -> Log:
    """A log of white forces: readback and heights follow from `acting`, rows that acted in time."""
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


def heard_late(n: int, first: int, end: int) -> np.ndarray:
    """Rows that acted where periods first .. end were skipped and a command waits for its cycle."""
    acting = np.arange(n)
    acting[first - 1 : end - 1] = first - 2
    acting[end - 1] = first - 1
    return acting


def test_a_log_without_gaps_is_left_alone() -> None:
    log = flown(1000)
    assert without_gaps(log) == (log, ())


@pytest.mark.parametrize("own_clock", [False, True], ids=["waits for its cycle", "own clock"])
def test_in_skipped_periods_those_commands_act_that_the_readback_shows(own_clock: bool) -> None:
    n, first, end = 1000, 100, 105
    acting = heard_late(n, first, end)
    if own_clock:  # the amplifier takes the last command over in time, and holds it
        acting[first - 1 : end] = first - 1
    log = flown(n, acting)
    filled_in, remarks = without_gaps(skipping(log, list(range(first, end))))
    assert remarks[0] == "5 of 1000 periods were skipped (0.50%)"
    np.testing.assert_array_equal(filled_in.rows["cycle"], log.rows["cycle"])
    np.testing.assert_array_equal(filled_in.rows["coil_n"], log.rows["coil_n"][acting])
    np.testing.assert_array_equal(filled_in.rows["v_z_n"], log.rows["v_z_n"][acting])
    np.testing.assert_allclose(filled_in.rows["time_s"], log.rows["time_s"], rtol=1e-12)
    assert len(filled_in.log_time_ns) == n


def test_command_that_was_lost_on_the_way_did_not_act() -> None:
    acting = np.arange(1000)
    acting[[300, 500, 501]] = 299, 499, 499
    rows = without_gaps(skipping(flown(1000, acting), [700]))[0].rows
    np.testing.assert_array_equal(rows["coil_n"][:699], flown(1000).rows["coil_n"][acting[:699]])
    remarks = without_gaps(skipping(flown(1000, acting), [700]))[1]
    assert "3 commands acted late, as the amplifiers' readback tells" in remarks


def test_setpoints_that_did_not_arrive_are_looked_for_though_nothing_else_lacks() -> None:
    acting = np.arange(1000)
    acting[[300, 500, 501]] = 299, 499, 499
    log = flown(1000, acting)
    log.rows["stale"][[300, 500, 501]] = Stale.SETPOINTS
    found, remarks = without_gaps(log)
    np.testing.assert_array_equal(found.rows["coil_n"], flown(1000).rows["coil_n"][acting])
    assert remarks == ("3 commands acted late, as the amplifiers' readback tells",)


def test_without_a_readback_nobody_knows_which_command_acted() -> None:
    log = flown(1000)
    rows = drop_fields(log.rows, "coil_readback_n", usemask=False)
    found, remarks = without_gaps(skipping(replace(log, rows=rows), [700]))
    assert remarks[0] == "1 of 1000 periods were skipped (0.10%)"
    assert found.rows["coil_n"][700] == pytest.approx(log.rows["coil_n"][699])


def test_readback_that_follows_no_command_decides_nothing() -> None:
    log = flown(1000)
    log.rows["coil_readback_n"] = np.random.default_rng(3).normal(size=(1000, 9))
    n, absent = 1000, np.zeros(1000, bool)
    found = acted(
        log.rows["coil_n"].astype(float),
        log.rows["coil_readback_n"].astype(float),
        ~absent,
        absent,
        absent,
    )
    np.testing.assert_array_equal(found.row, np.arange(n))
    assert (found.late, found.unexplained) == (0, 0)


def test_readings_of_an_earlier_cycle_are_filled_in_as_well_as_the_sensors_measure() -> None:
    truth, log = flown(4000), flown(4000)
    rng = np.random.default_rng(5)
    at = np.flatnonzero(rng.uniform(size=3900) < 0.02) + 20
    runs = np.unique(np.concatenate([at, [1000, 1001, 1002, 1003, 1004, 1005]]))
    for row in runs:
        log.rows["gap_m"][row] = log.rows["gap_m"][row - 1]
        log.rows["z_m"][row] = log.rows["z_m"][row - 1]
        log.rows["stale"][row] = Stale.SENSORS | Stale.AMPLIFIERS
    off_before = (log.rows["gap_m"] - truth.rows["gap_m"])[runs]
    rows, remarks = without_gaps(log)
    off = (rows.rows["gap_m"] - truth.rows["gap_m"])[runs]
    # The difference has the noise of the reading that was taken out, and that of the curve, which
    # is less: it goes through 24 rows. The old readings are off by what moves in a period.
    assert np.std(off) < 1.5 * NOISE_M
    assert np.std(off_before) > 5 * NOISE_M
    np.testing.assert_allclose(rows.rows["z_m"], rows.rows["gap_m"].mean(axis=1), atol=1e-10)
    assert any(f"{len(runs)} of 4000 rows had no heights" in text for text in remarks)
    np.testing.assert_array_equal(rows.rows["coil_n"], truth.rows["coil_n"])


def test_readings_of_cycles_that_took_longer_than_a_period_are_of_no_known_time() -> None:
    acting = heard_late(1000, 401, 404)
    truth, log = flown(1000, acting), flown(1000, acting)
    log.rows["execution_s"][400] = 4e-3
    log.rows["gap_m"][400] += 1e-5
    rows = without_gaps(skipping(log, [401, 402, 403]))[0].rows
    assert np.abs(rows["gap_m"][400] - truth.rows["gap_m"][400]).max() < 1e-6


def test_logs_from_before_there_was_the_field_are_read_as_ever() -> None:
    log = flown(1000)
    names = [name for name in log.rows.dtype.names or () if name != "stale"]
    old = replace(log, rows=log.rows[names].copy())
    assert without_gaps(old) == (old, ())
    assert from_log(old).v.shape == (1000, 3)


def test_records_and_experiments_are_evenly_spaced_and_say_what_was_filled() -> None:
    log = skipping(flown(1000), [100, 101, 500])
    record = from_log(log)
    assert record.v.shape == (1000, 3)
    assert any("3 of 1000 periods" in text for text in record.remarks)
    experiment = experiment_from_log(log, load_model(shipped("models/rig.yaml")))
    assert len(experiment.u) == len(experiment.y) == 1000
    assert {len(values) for values in experiment.schedule.values()} == {1000}
    assert sum("periods" in text for text in experiment.remarks) == 1


def test_record_is_cut_where_readings_are_missing_for_long() -> None:
    log = skipping(flown(1000), list(range(300, 320)))
    rows, remarks = without_gaps(log)
    np.testing.assert_array_equal(rows.rows["cycle"], 7000 + np.arange(320, 1000))
    assert len(rows.log_time_ns) == 680
    assert remarks[0].startswith("cut to its 680 rows from 320 on, of 1000")


def test_record_is_cut_to_what_excites_and_not_to_rest() -> None:
    log = skipping(flown(1000), list(range(600, 620)))
    log.rows["v_z_n"][:595] = 0.0  # the other columns of the wrench are zero as well
    rows, remarks = without_gaps(log)
    np.testing.assert_array_equal(rows.rows["cycle"], 7000 + np.arange(620, 1000))
    assert remarks[0].startswith("cut to its 380 rows from 620 on, of 1000")
    log.rows["v_z_n"] = 0.0
    log.rows["coil_excitation_n"][:300, 4] = 1.0
    rows, _ = without_gaps(log)
    np.testing.assert_array_equal(rows.rows["cycle"], 7000 + np.arange(600))


def test_record_is_cut_at_a_gap_whose_sides_do_not_fit_together() -> None:
    """Whatever happened there, a force that nobody knows of pushed the platform."""
    log = flown(1000)
    log.rows["gap_m"][405:] += 1e-6 * np.arange(595)[:, None]
    rows, remarks = without_gaps(skipping(log, [400, 401, 402, 403, 404, 700]))
    np.testing.assert_array_equal(rows.rows["cycle"], 7000 + np.arange(405, 1000))
    assert remarks[0].startswith("cut to its 595 rows from 405 on, of 1000")


def test_too_much_missing_is_an_error_that_names_the_log() -> None:
    rng = np.random.default_rng(2)
    sparse = flown(2000)
    sparse.rows["stale"][rng.uniform(size=2000) < 0.15] = Stale.SENSORS
    with pytest.raises(IdentificationError, match=r"02-z\.mcap: .*at most 10% without heights"):
        from_log(sparse)
    stalls = [k for k in range(20, 1980) if k % 100 < 15]
    with pytest.raises(IdentificationError, match=r"100 of 2000 rows between one stall"):
        from_log(skipping(flown(2000), stalls))
    acting = np.arange(2000)
    acting[200:1800:100] -= 50  # forces of long ago: nobody commanded them then
    strange = flown(2000, acting)
    strange.rows["stale"][10] = Stale.SENSORS
    with pytest.raises(IdentificationError, match="16 rows whose readback fits no command"):
        from_log(strange)


def test_cycle_numbers_that_do_not_rise_are_an_error() -> None:
    log = flown(1000)
    log.rows["cycle"][10:] -= 5
    with pytest.raises(IdentificationError, match=r"cycle: expected numbers that rise.*in row 10"):
        without_gaps(log)


def test_gaps_are_bridged_where_enough_is_left_around_them() -> None:
    missing = np.zeros(100, bool)
    missing[[3, 50, 51, 52]] = True  # the first is too near to the begin for a curve
    missing[70:90] = True
    expected = np.zeros(100, bool)
    expected[50:53] = True
    np.testing.assert_array_equal(bridged(missing, 10), expected)


def test_filling_knows_no_force_and_fills_smooth_motion_all_the_same() -> None:
    t = np.arange(600.0)
    values = np.stack([1e-4 * np.sin(0.02 * t), 1e-6 * t], axis=1)
    missing = np.zeros(600, bool)
    missing[200:206] = True
    spoiled = np.where(missing[:, None], 7.0, values)
    found = filled(spoiled, missing, np.zeros((600, 0))).values
    np.testing.assert_allclose(found, values, atol=1e-9)
