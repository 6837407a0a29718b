"""Test loading: names, signals, records, errors, display, pickling."""

from __future__ import annotations

import gc
import pickle
from pathlib import Path

import numpy as np
import pytest

import levid
from levid.config.shipped import shipped
from levid.log.reader import read_log


def test_session_states_what_was_flown(session: levid.Session, flown: Path) -> None:
    assert session.name == "short"
    assert session.logs == tuple(sorted(flown.glob("*.mcap")))
    assert session.names == ("psi", "theta", "z")
    assert [r.kind for r in session.steps] == ["levitate", *["record"] * 3, "land"]
    assert session.rate_hz == 500.0
    # A record flies 9 s of noise, and rests before and after it.
    assert session.duration_s == sum(len(r) for r in session) / 500.0 > 27.0
    assert session.rig is not None
    assert session.rig.name == "loopback"
    assert session.rig.coil_xy_m[0] == (0.12, 0.12)
    assert session.rig.sensor_xy_m == session.rig.coil_xy_m


def test_signals_have_unit_role_and_meaning(session: levid.Session) -> None:
    gap = session.signals["gap_m"]
    assert (gap.unit, gap.role, gap.length) == ("m", "output", 9)
    assert "height" in gap.meaning
    assert gap.columns == tuple(f"gap_m_{k}" for k in range(9))
    assert [s.name for s in session.signals.with_role("input")] == [
        *("tau_psi_n_m", "tau_theta_n_m", "tau_z_n"),
        "coil_n",
    ]
    assert "gap_m_8" in session.columns
    assert "time_s" not in session.columns  # the index of a data frame
    with pytest.raises(KeyError, match="gap_m"):
        session.signals["gap"]


def test_record_gives_signals_as_arrays(session: levid.Session) -> None:
    record = session["z"]
    assert record is session.record(2)
    log = read_log(record.path)
    np.testing.assert_array_equal(record["gap_m"], log.rows["gap_m"])
    np.testing.assert_array_equal(record["gap_m_3"], log.rows["gap_m"][:, 3])
    np.testing.assert_array_equal(record.time_s, log.rows["time_s"])
    assert session.record("levitate").kind == "levitate"
    assert record.problem is None


def test_imported_data_have_roles(imported: levid.Session) -> None:
    assert imported.names == ("data",)
    assert imported.rig is None
    assert {s.name: (s.unit, s.role) for s in imported.signals if s.role} == {
        "u_n": ("N", "input"),
        "y_m": ("m", "output"),
    }


def test_equal_names_of_two_sessions_are_told_apart(flown: Path, tmp_path: Path) -> None:
    (tmp_path / "again").symlink_to(flown)
    both = levid.load([flown, tmp_path / "again"])
    assert len(both) == 6
    assert both.names[0] == "short/psi"
    assert both.names[3] == "again/psi"


def test_errors_say_what_was_expected_and_what_to_do(
    session: levid.Session, flown: Path, measured: Path, tmp_path: Path
) -> None:
    with pytest.raises(levid.LogError, match="at least one log, found an empty list"):
        levid.load([])
    with pytest.raises(levid.LogError, match=r"folder with logs .*found none"):
        levid.load(tmp_path)
    with pytest.raises(levid.LogError, match=f"there are logs in {flown}"):
        levid.load(flown.parent)
    with pytest.raises(levid.LogError, match=r"none\.mcap"):
        levid.load(tmp_path / "none.mcap")
    with pytest.raises(levid.LogError, match=r"signals=SIGNALS\.yaml"):
        levid.load(measured / "data.csv")
    (tmp_path / "bad.mcap").write_text("no log")
    with pytest.raises(levid.LogError, match=r"bad\.mcap"):
        levid.load(tmp_path / "bad.mcap")
    with pytest.raises(levid.LogError, match="levitate, psi, theta, z, land; found 'x'"):
        session.record("x")
    with pytest.raises(levid.LogError, match="from 0 to 2, found 3"):
        session.record(3)
    with pytest.raises(levid.LogError, match=r"found 'gap_mm'; there is gap_m"):
        session.record(0)["gap_mm"]
    only_land = levid.load(flown / "04-land.mcap")
    with pytest.raises(levid.LogError, match="found only land"):
        only_land.to_pandas()
    assert "0 records" in repr(only_land)


def test_records_of_several_rates_have_no_common_rate(flown: Path, imported: levid.Session) -> None:
    mixed = levid.Session([*levid.load(flown).logs, *imported.logs])
    with pytest.raises(levid.LogError, match="500 Hz in psi, 100 Hz in data"):
        _ = mixed.rate_hz
    assert "500 Hz, 100 Hz" in repr(mixed)


def test_session_displays_as_text_and_html(session: levid.Session) -> None:
    text, page = repr(session), session._repr_html_()
    assert text.startswith("<Session short: 3 records, ")
    assert page.count("<tr>") == 1 + 5
    for name in ("levitate", "psi", "theta", "z", "land"):
        assert name in text
        assert name in page
    assert "gap_m [9]" in repr(session.signals)
    assert "<table>" in session.signals._repr_html_()
    assert "psi" in repr(session[0])
    assert "<table>" in session[0]._repr_html_()


def test_session_is_pickled_as_its_paths(session: levid.Session) -> None:
    packed = pickle.dumps(session)
    assert len(packed) < 1000
    assert pickle.loads(packed).names == session.names
    assert pickle.loads(pickle.dumps(session[1])).name == "theta"


def test_temporary_flight_lives_as_long_as_the_session_or_a_record() -> None:
    steps = [{"levitate": {"settle_s": 0.1}}, {"land": {}}]
    done: list[float] = []
    flight = levid.fly(
        {"levid": "session", "name": "hop", "rate_hz": 200, "seed": 1, "steps": steps},
        progress=lambda _, share: done.append(share),
    )
    folder = flight.logs[0].parent
    assert done[-1] == pytest.approx(1.0, abs=0.05)
    land = flight.record("land")
    del flight
    gc.collect()
    assert len(land["z_m"]) == len(land)
    del land
    gc.collect()
    assert not folder.exists()


def test_flights_never_overwrite_logs(flown: Path) -> None:
    session = shipped("sessions/beam.yaml")
    with pytest.raises(levid.ConfigError, match="without logs, found 5 "):
        levid.fly(session, out=flown)


def test_plots_are_figures_that_notebooks_show(
    session: levid.Session, imported: levid.Session, no_warnings: None
) -> None:
    for figure in (
        session.plot(),
        session.plot(["z_m", "gap_m", "coil_n_2"]),
        imported.plot(),
        session[0].plot("z_m"),
    ):
        assert figure._repr_png_().startswith(b"\x89PNG")
    assert len(imported.plot().axes) == 2  # input and output
