"""Skipped periods: rows come back at their time, commands held, measurements in between."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.data import IdentificationError
from levid.identification.from_log import from_log
from levid.identification.gaps import without_gaps
from levid.identification.greybox.experiment import experiment_from_log
from levid.log.reader import Log
from levid.log.signals import cycle_dtype


def _log(n: int = 1000) -> Log:
    rng = np.random.default_rng(0)
    rows = np.zeros(n, cycle_dtype(9, 9))
    rows["cycle"] = 7000 + np.arange(n)
    rows["time_s"] = 7.0 + 1e-3 * np.arange(n)
    rows["v_z_n"] = rng.normal(size=n)
    rows["tau_z_n"] = rows["v_z_n"]
    rows["coil_n"] = rng.normal(size=(n, 9))
    rows["z_m"] = 1e-6 * np.arange(n)
    rows["gap_m"] = 1e-6 * np.arange(n)[:, None] * np.arange(1, 10)
    rows["beam_m"] = 0.05
    return Log(
        path=Path("02-z.mcap"),
        rows=rows,
        log_time_ns=np.arange(n, dtype=np.uint64) * 10**6,
        rate_hz=1000.0,
        schema_name="levid/msg/Cycle",
        metadata={"kind": "record", "name": "z"},
        attachments={"rig.yaml": Path(shipped("rigs/loopback.yaml")).read_bytes()},
        complete=True,
        problem=None,
    )


def _skipping(log: Log, rows: list[int]) -> Log:
    keep = np.delete(np.arange(len(log.rows)), rows)
    return replace(log, rows=log.rows[keep], log_time_ns=log.log_time_ns[keep])


def test_missing_cycles_are_filled_with_the_last_command_and_measurements_between():
    log = _log()
    filled, remarks = without_gaps(_skipping(log, [100, 101, 500]))
    assert remarks == (
        "3 of 1000 periods (0.30%) were skipped: commands repeated there, measurements "
        "interpolated",
    )
    np.testing.assert_array_equal(filled.rows["cycle"], log.rows["cycle"])
    # Straight lines are interpolated exactly, to the rounding of float32.
    for name in ("time_s", "z_m", "gap_m"):
        np.testing.assert_allclose(filled.rows[name], log.rows[name], rtol=1e-6)
    for name in ("v_z_n", "coil_n"):
        for row, last in ((100, 99), (101, 99), (500, 499)):
            np.testing.assert_array_equal(filled.rows[name][row], log.rows[name][last])
        np.testing.assert_array_equal(filled.rows[name][102:500], log.rows[name][102:500])
    assert len(filled.log_time_ns) == 1000


def test_records_and_experiments_are_evenly_spaced_and_say_what_was_filled():
    log = _skipping(_log(), [100, 101, 500])
    record = from_log(log)
    assert record.v.shape == (1000, 3)
    assert any("3 of 1000 periods" in text for text in record.remarks)
    experiment = experiment_from_log(log, load_model(shipped("models/rig.yaml")))
    assert len(experiment.u) == len(experiment.y) == 1000
    assert {len(values) for values in experiment.schedule.values()} == {1000}
    assert sum("periods" in text for text in experiment.remarks) == 1


def test_a_log_without_gaps_is_left_alone():
    log = _log()
    assert without_gaps(log) == (log, ())


def test_more_than_two_percent_missing_is_an_error_that_names_the_log():
    log = _skipping(_log(), list(range(100, 130)))
    with pytest.raises(IdentificationError, match=r"02-z\.mcap: .* 30 of 1000 periods \(3\.00%\)"):
        from_log(log)


def test_cycle_numbers_that_do_not_rise_are_an_error():
    log = _log()
    log.rows["cycle"][10:] -= 5
    with pytest.raises(IdentificationError, match=r"cycle: expected numbers that rise.*in row 10"):
        without_gaps(log)
