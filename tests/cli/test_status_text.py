"""Test the text of `levid status` and the lines of `levid watch`."""

from __future__ import annotations

import pytest
from status_of_rig import rig_with, status_in_flight

from levid.cli.readable_values import duration, scale_of
from levid.cli.status_text import WIDTH, status_lines, watch_line
from levid.daemon.control.faults import FAULTS, Fault


@pytest.mark.parametrize(
    ("unit", "noise", "limit", "value", "text", "unit_shown"),
    [
        ("m", 1e-7, 0.00085, 12.3456e-6, "12.3", "um"),
        ("m", 2e-6, 0.00085, 12.3456e-6, "12", "um"),
        ("m", 3e-8, 0.00085, 12.3456e-6, "12.3", "um"),
        ("rad", 3.4e-7, 0.0065, -1.2345e-3, "-1234", "urad"),
        ("m", 1e-6, 0.1, 0.0501234, "50.123", "mm"),
        ("m", 0.0, 0.1, 0.0501234, "50.12", "mm"),
        ("rad", None, None, 1.23456789, "1.2346", "rad"),
        ("N", None, 20.0, 7.63211, "7.63", "N"),
        ("N", None, 20.0, -1e-9, "0.00", "N"),
        ("N", None, 20.0, None, "-", "N"),
    ],
)
def test_values_have_the_digits_that_their_noise_supports(
    unit, noise, limit, value, text, unit_shown
) -> None:
    scale = scale_of(unit, noise, limit)
    assert (scale.text(value), scale.unit) == (text, unit_shown)


def test_digits_do_not_flicker_when_the_noise_is_near_a_power_of_ten() -> None:
    scale = scale_of("m", 0.9e-7, 0.00085)
    for noise in (1.1e-7, 0.9e-7, 1.5e-7, 0.8e-7):
        scale = scale_of("m", noise, 0.00085, scale)
        assert scale.decimals == 1
    assert scale_of("m", 1e-6, 0.00085, scale).decimals == 0


def test_durations_are_short() -> None:
    assert [duration(s) for s in (0.4, 59.4, 72, 3725)] == [
        "0 s", "59 s", "1 min 12 s", "1 h 02 min",
    ]  # fmt: skip


@pytest.mark.parametrize("coils", [3, 9, 25])
def test_status_shows_pose_beam_coils_and_gaps_in_80_columns(coils: int) -> None:
    lines = list(status_lines(status_in_flight(rig_with(coils, coils + 1))))
    assert lines[0] == ("loopback at 1000 Hz: session white-noise, tilt, 25 %, 1 min 12 s left")
    table = {line.split()[0]: line.split()[1:] for line in lines if line[:1].isalpha()}
    assert table["psi"][1:] == ["urad", "6500"]
    assert float(table["psi"][0]) == pytest.approx(-45, abs=2)
    assert float(table["z"][0]) == pytest.approx(12.3, abs=0.5)
    assert table["z"][1:] == ["um", "850"]
    assert table["beam"] == ["50.00", "mm", "100"]
    values = [
        float(cell)
        for line in lines if line.startswith("force N")
        for cell in line.split()[2:-1]
    ]  # fmt: skip
    assert values == [7.63] * coils
    heads = [line.split()[1:-1] for line in lines if line.startswith("sensor ")]
    assert [int(cell) for line in heads for cell in line] == list(range(coils + 1))
    assert max(map(len, lines)) <= WIDTH


def test_status_explains_every_fault_with_the_words_of_the_table() -> None:
    for fault in set(Fault) - {Fault.NONE}:
        text = "\n".join(status_lines(status_in_flight(fault=fault.name, detail="sensor 3")))
        assert f"fault {fault.name} (sensor 3)" in text
        assert FAULTS[fault].cause in text
        assert FAULTS[fault].check in text
        assert FAULTS[fault].cleared in text


def test_a_status_of_an_older_daemon_is_printed_as_before() -> None:
    new = ("pose", "manipulator", "coils", "gaps", "left_s", "log", "log_folder", "events")
    old = {key: value for key, value in status_in_flight().items() if key not in new}
    assert next(status_lines(old)).endswith("session white-noise, tilt, 25 %")


def test_lines_of_watch_fit_80_columns() -> None:
    detail = "drive 3 does not follow its setpoints by 4.2 mm, and its encoder reports an error"
    for more in (
        {},
        {"fault": "DRIVE", "detail": detail},
        {"cycle": 10**10, "late": 10**6, "stale": 12},
        {"z_m": None, "beam_m": None},
        {"session": "a-session-with-a-long-name-" * 4},
    ):
        line = watch_line(status_in_flight(**more))
        assert len(line) <= WIDTH
    line = watch_line(status_in_flight())
    assert line.startswith("    12345    3 late  z   12.3 um  beam  50.00 mm  session white-noise")
