"""Test the report on a flight, also from truncated and unusual logs."""

from __future__ import annotations

import json

import numpy as np
import pytest

from levid.daemon.control.faults import Fault
from levid.daemon.control.states import State
from levid.log.errors import LogError
from levid.log.signals import cycle_dtype
from levid.log.writer import LogWriter
from levid.report.plotting.figure_to_svg import to_svg
from levid.report.session import session_page
from levid.report.session.flight_data import read_session
from levid.report.session.session_page import session_report, session_words
from levid.report.session.time_plot import session_plot

pytestmark = pytest.mark.usefixtures("no_warnings")

DTYPE = cycle_dtype(9, 9)
RATE_HZ = 500.0


def rows_of(states, start_s, dtype=DTYPE):
    """Return rows in the given states, at rest at the working point."""
    rows = np.zeros(len(states), dtype)
    rows["time_s"] = start_s + np.arange(len(states)) / RATE_HZ
    rows["cycle"] = np.arange(len(states)) + round(start_s * RATE_HZ)
    rows["state"] = states
    rows["coil_n"] = 7.6
    return rows


def write(path, rows, dtype=DTYPE, **metadata):
    times = 10**18 + (rows["cycle"] * (1e9 / RATE_HZ)).astype(np.uint64)
    versions = json.dumps({"levid": "9.9"}).encode()
    facts = {"session": "a-session", "kind": "record", "name": path.stem} | metadata
    with LogWriter(
        path, dtype, rate_hz=RATE_HZ, metadata=facts, attachments={"versions.json": versions}
    ) as log:
        log.write(rows, times)
    return path


@pytest.fixture
def logs(tmp_path):
    """Return logs of lift-off, excitation of psi with the beam on the left, a sweep, landing."""
    rng = np.random.default_rng(4)
    up = rows_of([State.IDLE] * 100 + [State.LEVITATING] * 900, 0.0)
    up["z_m"][:400], up["gap_m"][:400] = -0.9e-3, -0.9e-3
    excited = rows_of([State.LEVITATING] * 500 + [State.EXCITING] * 2500, 2.0)
    excited["beam_m"] = -0.1
    excited["v_psi_n_m"][500:] = rng.normal(0, 0.1, 2500)
    excited["psi_rad"][500:] = rng.normal(0, 1e-4, 2500)
    excited["gap_m"][700, 3] = 0.42e-3
    swept = rows_of([State.MOVING] * 2000, 8.0)
    swept["beam_m"] = 0.08 * np.sin(np.arange(2000) * 0.01)
    swept["theta_rad"] = 1e-3 * swept["beam_m"]
    down = rows_of([State.LANDING] * 500, 12.0)
    names = ("00-levitate", "01-left-psi", "02-sweep", "03-land")
    kinds = ("levitate", "record", "record", "land")
    parts = (up, excited, swept, down)
    return [
        write(tmp_path / f"{name}.mcap", rows, kind=kind, name=name[3:])
        for name, kind, rows in zip(names, kinds, parts, strict=True)
    ]


def test_session_is_reported_as_flown(logs):
    session = read_session(logs)
    assert [step.name for step in session.steps] == ["levitate", "left-psi", "sweep", "land"]
    assert session.name == "a-session"
    assert session.versions == {"levid": "9.9"}
    assert session.timing is None  # virtual time: lateness is logged as 0
    excited = session.steps[1]
    assert excited.excited == ("v_psi_n_m",)
    # The rms of 2500 samples of 0.1 N m scatters by 1.4 %.
    assert excited.excitation_rms[0] == pytest.approx(0.1, rel=0.06)
    assert excited.peak_gap_m == pytest.approx(0.42e-3)
    assert excited.beam_m == pytest.approx((-0.1, -0.1, -0.1, -0.1))
    assert excited.remarks == ()
    assert [span.state for span in session.spans] == [
        State.IDLE,
        State.LEVITATING,
        State.EXCITING,
        State.MOVING,
        State.LANDING,
    ]
    assert list(session.beam_records) == ["sweep"]
    assert "The session excited ψ in turn, with the beam at −100" in session_words(session)


def test_limit_of_the_gap_has_a_prefix_of_its_own():
    small = session_page._farthest(7.93e-7, 8.5e-4)
    assert (small.value, small.meaning.partition("; ")[2]) == ("793 nm", "limit 850 µm")


def test_logs_in_any_order_give_the_same_session(logs):
    forward, backward = read_session(logs), read_session(logs[::-1])
    assert to_svg(session_plot(forward)) == to_svg(session_plot(backward))


def test_page_of_a_session(logs, tmp_path):
    page = session_report(logs, tmp_path / "report")
    text = page.read_text(encoding="utf-8")
    for expected in (
        "Session &#39;a-session&#39;",
        "What was flown",
        "The moving beam",
        "Next:",
    ):
        assert expected in text
    assert "420 µm" in text.replace("\u00a0", " ")
    assert "levid identify" in text
    assert sorted(f.name for f in (tmp_path / "report/figures").iterdir()) == [
        "beam-1.svg",
        "session.svg",
    ]
    again = session_report(logs, tmp_path / "again")
    assert again.read_bytes() == page.read_bytes()


def test_page_of_ten_minutes_at_1_khz_is_below_300_kb(tmp_path):
    paths = []
    rng = np.random.default_rng(5)
    for number in range(6):
        rows = rows_of([State.EXCITING] * 50_000, 100.0 * number)
        for name in ("psi_rad", "theta_rad", "z_m", "v_psi_n_m", "v_theta_n_m", "v_z_n", "beam_m"):
            rows[name] = rng.normal(0, 1e-3, len(rows))
        rows["coil_n"] += rng.normal(0, 0.1, rows["coil_n"].shape)
        paths.append(write(tmp_path / f"{number}.mcap", rows))
    assert len(to_svg(session_plot(read_session(paths)))) < 300_000


def test_names_from_logs_are_escaped(tmp_path):
    nasty = '<b>&"x"</b>$\\alpha$\x07'
    rows = rows_of([State.EXCITING] * 400, 0.0)
    rows["v_z_n"] = 1.0
    path = write(tmp_path / "x.mcap", rows, name=nasty, session=nasty)
    text = session_report([path], tmp_path / "out").read_text(encoding="utf-8")
    assert "<b>" not in text
    assert "\x07" not in text
    assert "&lt;b&gt;&amp;" in text


def test_problems_give_remarks(tmp_path):
    rows = rows_of([State.EXCITING] * 300 + [State.FAULT] * 100, 0.0)
    rows["saturated"][10:13] = 2
    rows["skipped"][50] = 7
    rows["fault"][300:] = Fault.GAP
    path = write(tmp_path / "x.mcap", rows)
    step = read_session([path]).steps[0]
    assert "a coil at its limit in 3 cycles" in step.remarks
    assert "7 periods skipped" in step.remarks
    assert any("GAP" in remark for remark in step.remarks)
    text = session_report([path], tmp_path / "out").read_text(encoding="utf-8")
    assert "a coil at its limit in 3 cycles" in text
    assert text.count('class="bad"') == 2
    assert "See the remarks on x before you use these records." in text
    assert "The records are good" not in text


def test_truncated_log_is_drawn_up_to_its_end(logs, tmp_path):
    whole = logs[1].read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    session = read_session([cut])
    assert 0 < session.steps[0].rows < 3000
    assert any("incomplete" in remark for remark in session.steps[0].remarks)
    session_report([cut], tmp_path / "out")


def test_missing_readings_are_left_out(tmp_path):
    rows = rows_of([State.EXCITING] * 400, 0.0)
    rows["gap_m"], rows["psi_rad"], rows["beam_m"], rows["v_psi_n_m"] = [np.nan] * 4
    rows["z_m"][::2] = np.inf
    step = read_session([write(tmp_path / "x.mcap", rows)]).steps[0]
    assert step.peak_gap_m is None
    assert step.beam_m is None
    session_report([tmp_path / "x.mcap"], tmp_path / "out")


def test_page_of_a_real_time_session_has_a_timing_section(tmp_path):
    rows = rows_of([State.EXCITING] * 400, 0.0)
    rows["lateness_s"], rows["execution_s"] = 14e-6, 6e-6
    path = write(tmp_path / "x.mcap", rows)
    timing = read_session([path]).timing
    assert timing is not None
    assert timing.lateness.sum() == timing.execution.sum() == 400
    assert "Timing" in session_report([path], tmp_path / "out").read_text(encoding="utf-8")


def test_log_of_other_signals_has_no_time_plot_and_no_states(tmp_path):
    dtype = np.dtype([("cycle", "<u8"), ("u1", "<f8"), ("y1", "<f8")])
    rows = np.zeros(100, dtype)
    rows["cycle"] = np.arange(100)
    session = read_session([write(tmp_path / "x.mcap", rows, dtype, kind="import")])
    assert session.signals == {}
    assert session.duration_s == pytest.approx(99 / RATE_HZ)
    session_report([tmp_path / "x.mcap"], tmp_path / "out")


def test_missing_and_invalid_logs_are_errors(tmp_path):
    with pytest.raises(ValueError, match="at least one log"):
        read_session([])
    with pytest.raises(LogError, match=r"nowhere\.mcap"):
        read_session([tmp_path / "nowhere.mcap"])
