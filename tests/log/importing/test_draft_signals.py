"""Test drafts of SIGNALS.yaml: names, units, roles, time and rate; each draft loads."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
import scipy.io

from levid.config.base import ConfigError, parse_text
from levid.log.errors import LogError
from levid.log.importing.draft_signals import FILL_IN, draft_signals
from levid.log.importing.signals_yaml import SignalsFile

pytestmark = pytest.mark.usefixtures("mat_in_this_process")

T = np.arange(60) * 0.01
U, Y = np.sin(T), np.cos(T)


def parsed(draft):
    return parse_text(draft.text, SignalsFile, "draft")


def csv(path, header, *columns):
    np.savetxt(path, np.stack(columns, axis=1), "%.9g", delimiter=",", header=header, comments="")
    return path


def test_roles_and_units_follow_the_header(tmp_path):
    path = csv(
        tmp_path / "a.csv", "Time (ms),Motor voltage [V],Speed [rpm],Status", 1e3 * T, U, Y, T
    )
    draft = draft_signals(path)
    t, voltage, speed, status = parsed(draft).columns
    assert (t.role, t.unit, t.column) == ("time", "ms", "Time (ms)")
    assert (voltage.role, voltage.name, voltage.unit) == ("input", "motor_voltage_v", "V")
    assert (speed.role, speed.name, speed.unit) == ("output", "speed_rad_s", "rad/s")
    assert speed.scale == pytest.approx(np.pi / 30, rel=1e-9)
    assert (status.role, status.name) == ("other", "status")
    assert "# The time column gives the rate, 100 Hz." in draft.text
    assert draft.fill_in == ()
    assert draft.check == ("motor_voltage_v: check: role", "speed_rad_s: check: role")


def test_current_beside_a_voltage_may_be_input_or_output(tmp_path):
    path = csv(tmp_path / "a.csv", "t,voltage,current,position,position_ref", T, U, Y, Y, Y)
    _, _, current, _, reference = parsed(draft_signals(path)).columns
    assert current.role == "other"
    assert reference.role == "reference"
    assert "check: input if the current is controlled, output if the voltage is" in (
        draft_signals(path).text
    )


@pytest.mark.parametrize(
    "header",
    [
        "Weg über Grund,Ärger",
        "on,no",
        "cycle,time_s",
        "a,a",
        '"a: b","c # d"',
        "1st,2nd",
        "'x',{y}",
        "&a,*b",
    ],
)
def test_draft_loads_whatever_the_names(tmp_path, header):
    path = csv(tmp_path / "a.csv", header, U, Y)
    draft = draft_signals(path)
    assert "rate_hz: samples per second" in draft.fill_in
    with pytest.raises(ConfigError, match=rf"rate_hz: expected a number, found '{FILL_IN}'"):
        parsed(draft)
    found = parse_text(draft.text.replace(FILL_IN, "100"), SignalsFile, "draft")
    assert len(found.columns) == 2


def test_variables_and_rate_of_a_mat_file(tmp_path):
    path = tmp_path / "a.mat"
    scipy.io.savemat(
        path, {"run": {"u": U, "y": Y[:, None]}, "fs": 250.0, "gains": np.eye(3), "by": "me"}
    )
    draft = draft_signals(path)
    found = parsed(draft)
    assert [c.column for c in found.columns] == ["run.u", "run.y"]
    assert [c.role for c in found.columns] == ["input", "output"]
    assert found.rate_hz == 250.0
    assert "rate_hz: 250   # check: from fs = 250 Hz" in draft.text
    for other in ("#   gains: 3 x 3", "#   by: text 'me'"):
        assert other in draft.text


def test_matrix_with_samples_in_columns(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, D=np.stack([T, U, Y]))
    found = parsed(draft_signals(path))
    assert found.samples == "columns"
    assert [c.column for c in found.columns] == [0, 1, 2]
    assert found.columns[0].role == "time"
    assert "values -0" not in draft_signals(path).text.splitlines()[7]


def test_irregular_time_is_commented_with_the_key_to_set(tmp_path):
    t = np.cumsum(np.random.default_rng(1).uniform(0.5, 1.5, 60))
    draft = draft_signals(csv(tmp_path / "a.csv", "t,u,y", t, U, Y))
    assert "# resample: true" in draft.text
    assert not parsed(draft).resample


def test_dates_are_the_time(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "when,u,y\n"
        + "".join(f"2024-05-01 10:00:{k / 4:06.3f},{k % 3},{k % 5}\n" for k in range(60))
    )
    draft = draft_signals(path)
    assert parsed(draft).columns[0].role == "time"
    assert "the rate, 4 Hz" in draft.text


def test_dates_of_arrays_are_the_time(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, when=np.datetime64("2024-05-17") + (T * 1e9).astype("timedelta64[ns]"), u=U, y=Y)
    draft = draft_signals(path)
    assert [c.role for c in parsed(draft).columns] == ["time", "input", "output"]
    assert "the rate, 100 Hz" in draft.text


def test_column_named_as_a_unit_of_time_is_the_time(tmp_path):
    t = parsed(draft_signals(csv(tmp_path / "a.csv", "ms,u,y", 1e3 * T, U, Y))).columns[0]
    assert (t.role, t.unit) == ("time", "ms")
    s = parsed(draft_signals(csv(tmp_path / "b.csv", "t,s,u", T, U, Y))).columns[1]
    assert s.role == "other"


def test_line_that_cannot_be_read_is_shown(tmp_path):
    path = csv(tmp_path / "a.csv", "t,u,y", T, U, Y)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:30], "0.3,0.1", *lines[30:]]) + "\n")
    assert draft_signals(path).check[0].startswith("check: line 31: expected 3 cells")


def test_range_of_a_wrapped_angle_is_shown(tmp_path):
    path = csv(tmp_path / "a.csv", "t,u,angle [deg]", T, U, 2000 * T % 360)
    assert "may begin again after 360 (key wraps)" in draft_signals(path).text


def test_words_above_a_table_of_white_space_are_no_header(tmp_path):
    path = tmp_path / "a.log"
    path.write_text(
        "== log of 2024 05 17 ==\n" + "".join(f"{k / 10} {k % 3} {k % 5}\n" for k in range(60))
    )
    assert '"== log' not in draft_signals(path).text
    assert "column: 0, name: t" in draft_signals(path).text


def test_file_without_numbers_is_refused(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("just,text\nand,more\n")
    with pytest.raises(LogError, match="expected columns of numbers of one length, found column 0"):
        draft_signals(path)
    (tmp_path / "empty.csv").touch()
    with pytest.raises(LogError, match="found nothing"):
        draft_signals(tmp_path / "empty.csv")


def test_short_and_strange_tables_are_drafted_or_refused(tmp_path):
    rng, path = np.random.default_rng(0), tmp_path / "a.csv"
    cells = [
        "",
        "1",
        "-9999",
        "nan",
        "x",
        "1e308",
        "2024-05-17",
        "12:00:00",
        "360",
        "1,5",
        "-1e308",
    ]
    for _ in range(300):
        rows, width = rng.integers(1, 14), rng.integers(1, 5)
        path.write_text("\n".join(";".join(rng.choice(cells, width)) for _ in range(rows)))
        with contextlib.suppress(LogError):
            draft_signals(path)
