"""Test what the full screen of `levid watch` shows, at many sizes and of many rigs."""

from __future__ import annotations

import time

import numpy as np
import pytest
from status_of_rig import rig_with, rows_in_flight, status_in_flight

from levid.cli.watch.bars import bar, chart, signed_bar
from levid.cli.watch.dashboard import draw
from levid.cli.watch.styled_lines import STYLES, Line, plain, width_of, wrap
from levid.cli.watch.view import View
from levid.daemon.control.faults import FAULTS, Fault
from levid.daemon.supervision.live_readings import live_readings

EVERY_S = 0.2
FAULT = {"state": "FAULT", "session": None, "step": None, "share": None, "left_s": None}


def seen(status, statuses: int = 1) -> View:
    view = View()
    for index in range(1 - statuses, 1):
        view.receive(status, time.monotonic() + EVERY_S * index)
    return view


def text_of(view: View, width: int = 80, height: int = 24) -> str:
    return plain(draw(view, width, height))


@pytest.mark.parametrize("channels", [3, 4, 9, 30])
@pytest.mark.parametrize("fault", [False, True])
def test_every_size_is_filled_exactly(channels: int, fault: bool) -> None:
    more = {"fault": "HEAT", "detail": "x " * 200, **FAULT} if fault else {}
    view = seen(status_in_flight(rig_with(channels, channels), **more), 30)
    for width in (20, 40, 60, 69, 70, 80, 100, 119, 120, 160, 250):
        for height in (3, 5, 10, 20, 24, 30, 50, 80):
            lines = draw(view, width, height)
            assert len(lines) == height
            assert {width_of(line) for line in lines} == {width}
            assert {style for line in lines for _, style in line} <= set(STYLES)
            assert "STOP" in plain(lines[-1:])


@pytest.mark.parametrize(("width", "height"), [(80, 24), (100, 30), (160, 50)])
def test_state_session_pose_coils_gaps_timing_recorder_and_events_are_seen(
    width: int, height: int
) -> None:
    view = seen(status_in_flight())
    view.free_bytes = 12_340_000_000
    text = text_of(view, width, height)
    for expected in (
        "EXCITING", "in flight", "session white-noise, step tilt", "25 %, 1 min 12 s left",
        "psi", "theta", "urad", "±6500", "12.3 um", "±850", "beam", "50.00 mm", "±100", "rotor",
        "coils in N: limit ±20, rms 14", "7.6", "rms   7.0", "gap in um: limit ±850",
        "lateness", "17", "45", "230", "late cycles 3 of 12345",
        "writing 01-tilt.mcap", "12.3 GB free", "events", "loopback at 1000 Hz",
    ):  # fmt: skip
        assert expected in text, expected
    rows = [line for line in text.splitlines() if "rms   7.0" in line]
    assert len(rows) == 9
    assert all(line.count("▕") >= 1 for line in rows)  # coil and sensor beside each other


def test_before_the_first_cycle_no_value_is_shown() -> None:
    rig = rig_with()
    heat = np.zeros(len(rig.geometry.coil_x_m))
    none = live_readings(rows_in_flight(rig)[:0], heat, rig)
    view = seen(status_in_flight(rig, state="SELF_TEST", session=None, **none), 3)
    for size in ((60, 20), (80, 24), (160, 50)):
        assert "SELF_TEST" in text_of(view, *size)


def test_a_large_screen_also_charts_the_pose() -> None:
    text = text_of(seen(status_in_flight(), 50), 160, 50)
    for name in ("psi", "theta", "z"):
        assert any(line.startswith(f"{name} ") and "last 10 s" in line for line in text.split("\n"))
    assert any(0x2800 < ord(c) <= 0x28FF for c in text)


def test_a_fault_is_explained_in_red_with_cause_and_remedy() -> None:
    for fault in set(Fault) - {Fault.NONE}:
        status = status_in_flight(fault=fault.name, detail="0.9 mm at sensor 3", **FAULT)
        lines = draw(seen(status), 80, 24)
        text = " ".join(plain(lines).split())
        assert f"FAULT {fault.name}: 0.9 mm at sensor 3" in text
        for part in (FAULTS[fault].cause, FAULTS[fault].check, FAULTS[fault].cleared):
            assert part in text
        assert any(f"FAULT {fault.name}" in t and s == "alarm" for line in lines for t, s in line)


def test_limits_are_shown_as_exceeded_in_flight_only() -> None:
    flying = status_in_flight()
    flying["gaps"] = {**flying["gaps"], "value": [-0.0009] * 9}
    assert text_of(seen(flying)).count("!") == 9
    at_rest = {**flying, "state": "IDLE", "session": None}
    text = text_of(seen(at_rest))
    assert "!" not in text
    assert "limits apply in flight" in text


def test_what_forbids_a_lift_off_is_shown_at_rest_with_its_remedy() -> None:
    failed = {"check": "cpu", "outcome": "failed", "found": "slow", "remedy": "stop programs"}
    at_rest = status_in_flight(preflight=[failed], state="IDLE", session=None)
    text = text_of(seen(at_rest))
    assert "not ready to lift off: cpu: slow" in text
    assert "stop programs" in text
    assert "not ready" not in text_of(seen(status_in_flight(preflight=[failed])))


def test_a_lost_daemon_is_never_shown_as_if_it_were_there() -> None:
    view = seen(status_in_flight())
    view.lose("no daemon responds at /run/levid.sock; start one with 'levid run RIG.yaml'")
    text = text_of(view)
    assert "NOT CONNECTED" in text
    assert "levid run RIG.yaml" in text
    assert "EXCITING" not in text
    view.receive(status_in_flight(), time.monotonic())
    text = text_of(view)
    assert "EXCITING" in text
    assert "connected to the daemon again" in text
    view.heard_s -= 10.0
    assert "NO ANSWER for 10 s" in text_of(view)


def test_readings_without_a_new_cycle_are_marked_as_old() -> None:
    view = seen(status_in_flight(), 2)
    view.cycled_s -= 5.0
    assert "pose, 5 s old" in text_of(view)


def test_changes_between_two_looks_are_events() -> None:
    view = seen(status_in_flight())
    view.receive(status_in_flight(step="lift", cycle=12400), time.monotonic())
    view.receive(
        status_in_flight(state="IDLE", session=None, step=None, cycle=12500), time.monotonic()
    )
    texts = [text for _, text in view.events()]
    assert texts == [
        "loopback at 1000 Hz", "step lift", "state IDLE (was EXCITING)", "end of white-noise",
    ]  # fmt: skip


def test_questions_and_help_leave_the_stop_key_in_sight() -> None:
    view = seen(status_in_flight())
    view.asking = "land"
    text = text_of(view)
    assert "Land now?" in text.splitlines()[-1]
    assert "y" in text.splitlines()[-1]
    view.asking, view.help = "", True
    text = text_of(view)
    assert "zero force at once" in text
    assert "STOP" in text.splitlines()[-1]


def plain_bar(line: Line) -> str:
    return "".join(text for text, _ in line)


def test_bars_are_full_at_the_limit_and_say_so_without_colour() -> None:
    assert plain_bar(bar(0.5, 11)) == "█████·····▏"
    assert plain_bar(bar(1.0, 11)) == "██████████▏"
    assert plain_bar(bar(1.01, 11)) == "██████████!"
    assert plain_bar(signed_bar(-1.2, 11)) == "!████│····▏"
    assert plain_bar(signed_bar(0.5, 11)) == "▕····│██··▏"
    assert plain_bar(signed_bar(-1.2, 11, applies=False)) == "▕████│····▏"
    assert bar(None, 5) == [("     ", "")]


def test_a_chart_spans_its_ranges_with_the_newest_at_the_right() -> None:
    assert chart([(0.0, 1.0)], 2, 1) == ["⠀⢸"]
    assert chart([(0.0, 0.0), None, (1.0, 1.0)], 2, 1) == ["⢀⠈"]
    assert chart([None], 2, 1) == ["⠀⠀"]


def test_text_is_wrapped_at_spaces() -> None:
    assert plain(wrap("one two three four", 9, indent=2)) == "one two\n  three\n  four"
    assert len(wrap("word " * 100, 20, most=2)) == 2
