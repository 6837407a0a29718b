"""Test `levid plot`: peaks are kept, spectra have the right level, files are figures."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from levid.config.shipped import shipped
from levid.log.errors import LogError
from levid.log.log_stream import LogStream
from levid.log.reader import read_log
from levid.log.writer import LogWriter
from levid.report.logs.signal_data import named_columns, signal_spectra, signals_over_time
from levid.report.logs.signal_figure import time_figure_of_logs

RATE_HZ = 1000.0


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A log of 60 s: white noise of 2 um, a peak of one row, three gaps, and a state."""
    dtype = np.dtype(
        [("time_s", "<f8"), ("noise_m", "<f8"), ("gap_m", "<f4", (3,)), ("state", "u1")]
    )
    rows = np.zeros(60_000, dtype)
    rows["time_s"] = 5.0 + np.arange(60_000) / RATE_HZ
    rows["noise_m"] = 2e-6 * np.random.default_rng(0).standard_normal(60_000)
    rows["gap_m"] = 1e-5 * np.sin(rows["time_s"])[:, None] * [1, 2, 3]
    rows["gap_m"][33_333, 1] = 5e-4
    path = tmp_path / "made.mcap"
    units = {"noise_m": "m", "gap_m": "m", "time_s": "s", "state": "1"}
    with LogWriter(
        path, dtype, rate_hz=RATE_HZ, metadata={}, attachments={}, units=units
    ) as writer:
        writer.write(rows, (rows["time_s"] * 1e9).astype(np.uint64))
    return path


def test_envelopes_keep_a_peak_of_one_row(log: Path) -> None:
    stream = LogStream(log)
    found = {s.signal.name: s.values for s in signals_over_time(stream, stream_columns(stream))}
    assert set(found) == {"noise_m", "gap_m_0", "gap_m_1", "gap_m_2"}
    gap = found["gap_m_1"]
    assert len(gap.t) < 3000
    assert gap.high.max() == pytest.approx(5e-4)
    assert gap.t[gap.high.argmax()] == pytest.approx(5 + 33.333, abs=0.05)
    # A short range is drawn row by row.
    part = signals_over_time(stream, named_columns(stream, ["gap_m_1"]), 38.0, 38.999)[0].values
    assert part.is_line
    assert len(part.t) == 1000


def stream_columns(stream: LogStream) -> Any:
    return named_columns(stream, ["noise_m", "gap_m"])


def test_the_density_of_white_noise_is_its_deviation_over_the_root_of_half_the_rate(
    log: Path,
) -> None:
    stream = LogStream(log)
    (found,) = signal_spectra(stream, named_columns(stream, ["noise_m"]))
    level = np.sqrt(np.mean(found.density**2))
    assert level == pytest.approx(2e-6 / np.sqrt(RATE_HZ / 2), rel=0.02)


@pytest.mark.usefixtures("no_warnings")
def test_figures_are_written_where_the_command_says(
    log: Path, tmp_path: Path, levid: Callable[..., Any]
) -> None:
    assert levid("plot", log).out.strip() == str(log.with_suffix(".svg"))
    assert "gap_m" in log.with_suffix(".svg").read_text()
    heads = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}
    for kind, head in heads.items():
        path = tmp_path / f"figure.{kind}"
        code, _, err = levid("plot", log, "gap_m", "state", "--spectrum", "-o", path)
        assert code == 0, err
        assert path.read_bytes().startswith(head)


@pytest.mark.usefixtures("no_warnings")
@pytest.mark.parametrize("spectrum", [False, True])
def test_several_logs_share_panels_from_their_begin(
    log: Path, tmp_path: Path, levid: Callable[..., Any], spectrum: bool
) -> None:
    other = tmp_path / "other" / "made.mcap"
    other.parent.mkdir()
    other.write_bytes(log.read_bytes())
    more = ("--spectrum",) if spectrum else ("--begin-s", "10", "--end-s", "20")
    code, out, err = levid("plot", log, other, "noise_m", "gap_m_1", *more)
    assert code == 0, err
    file = log.with_name(f"made-compared{'-spectrum' if spectrum else ''}.svg")
    assert out.strip() == str(file)
    text = file.read_text()
    assert "other/made" in text  # the legend tells logs of one name apart by their folder
    assert f"{tmp_path.name}/made" in text
    assert "time since the log began [s]" in text or spectrum


def test_a_log_twice_or_without_the_signal_is_an_error(
    log: Path, tmp_path: Path, levid: Callable[..., Any]
) -> None:
    code, _, err = levid("plot", log, log, "noise_m")
    assert code == 2
    assert "found one twice" in err
    other = tmp_path / "other.mcap"
    other.write_bytes(log.read_bytes())
    assert levid("plot", log, other).code == 0
    code, _, err = levid("plot", log, other, "pose")
    assert code == 1
    assert "pose" in err


def test_a_figure_of_two_plants_says_so(
    log: Path, tmp_path: Path, levid: Callable[..., Any]
) -> None:
    rows = read_log(log)
    other = tmp_path / "other.mcap"
    rig = shipped("rigs/loopback.yaml").read_bytes()
    with LogWriter(
        other, rows.rows.dtype, rate_hz=RATE_HZ, metadata={}, attachments={"rig.yaml": rig},
        units={"noise_m": "m", "gap_m": "m", "time_s": "s", "state": "1"},
    ) as writer:  # fmt: skip
        writer.write(rows.rows[:2000], rows.log_time_ns[:2000])
    code, _, err = levid("plot", log, other, "noise_m")
    assert code == 0
    assert "note: these logs are not of one plant" in err
    assert "'loopback'" in err


def test_logs_of_rigs_with_other_numbers_of_sensors_are_an_error(log: Path) -> None:
    stream = LogStream(log)
    three = signals_over_time(stream, named_columns(stream, ["gap_m"]))
    with pytest.raises(LogError, match="only one of a and b has gap_m_2"):
        time_figure_of_logs({"a": three, "b": three[:2]})


def test_wrong_names_and_ranges_are_errors(
    log: Path, tmp_path: Path, levid: Callable[..., Any]
) -> None:
    for arguments, text in (
        (("gab_m",), "did you mean gap_m"),
        (("gap_m", "-o", tmp_path / "a.gif"), ".svg, .png or .pdf"),
        (("gap_m", "--begin-s", "100"), "expected a part of 5 to 64.999 s"),
    ):
        code, _, err = levid("plot", log, *arguments)
        assert code == 1
        assert text in err
