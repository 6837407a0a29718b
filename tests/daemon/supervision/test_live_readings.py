"""Test what the status says of the newest rows: values, range, noise, limits."""

from __future__ import annotations

import json

import numpy as np
import pytest
from status_of_rig import rig_with, rows_in_flight

from levid.daemon.supervision.live_readings import last_cycle, live_readings, noise, recent_rows
from levid.daemon.supervision.recent_events import RecentEvents

HEAT = np.array([49.0, 0.0, 196.0, 1.0])


def test_values_limits_and_numbers_of_channels_are_those_of_the_rig() -> None:
    rig = rig_with(coils=4, sensors=5)
    rows = rows_in_flight(rig)
    found = live_readings(rows, HEAT, rig)
    psi, theta, z = found["pose"]
    assert [q["name"] for q in found["pose"]] == ["psi", "theta", "z"]
    assert (psi["unit"], z["unit"]) == ("rad", "m")
    assert z["value"] == rows["z_m"][-1]
    assert z["low"] == rows["z_m"].min() < z["value"] < z["high"] == rows["z_m"].max()
    assert theta["limit"] == rig.limits.tilt_rad
    assert z["limit"] == found["gaps"]["limit"] == rig.limits.gap_m
    assert [(q["name"], q["limit"]) for q in found["manipulator"]] == [
        ("beam", 0.1),
        ("rotor", None),
    ]
    assert found["gaps"]["value"] == rows["gap_m"][-1].tolist()
    assert len(found["gaps"]["value"]) == 5
    assert found["coils"]["rms"] == [7.0, 0.0, 14.0, 1.0]
    assert found["coils"]["value"] == pytest.approx([7.63] * 4)
    assert last_cycle(rows) == pytest.approx({"lateness_us": 17.0, "execution_us": 131.0})


def test_without_rows_every_value_is_none_and_json_can_say_it() -> None:
    rig = rig_with(coils=4)
    rows = rows_in_flight(rig)
    found = live_readings(rows[:0], HEAT, rig)
    assert all(q["value"] is None and q["noise"] is None for q in found["pose"])
    assert found["coils"]["value"] == [None] * 4
    assert last_cycle(rows[:0]) == {"lateness_us": None, "execution_us": None}
    rows["z_m"][-1] = np.nan  # a sensor without a reading
    z = live_readings(rows, HEAT, rig)["pose"][-1]
    assert z["value"] is z["low"] is z["noise"] is None
    json.dumps(found, allow_nan=False)


def test_noise_is_found_below_a_motion_that_is_a_thousand_times_larger() -> None:
    rng = np.random.default_rng(3)
    t_s = np.arange(128) / 1000.0
    motion = 1e-4 * np.sin(2 * np.pi * 3.0 * t_s)
    estimates = [noise(motion + rng.normal(0, 1e-7, t_s.size)) for _ in range(50)]
    # One estimate from 128 values has a standard deviation of about a sixth.
    assert np.mean(estimates) == pytest.approx(1e-7, rel=0.1)
    assert max(estimates) < 2e-7
    assert noise(motion[:8]) is None


def test_rows_of_a_quarter_of_a_second_are_read_but_never_many() -> None:
    rig = rig_with()
    assert recent_rows(rig) == 250
    assert recent_rows(rig.model_copy(update={"rate_hz": 10_000.0})) == 512
    assert recent_rows(rig.model_copy(update={"rate_hz": 10.0})) == 16


def test_the_newest_journal_lines_are_kept_and_all_are_logged() -> None:
    logged: list[str] = []
    events = RecentEvents(logged.append)
    for index in range(30):
        events(f"line {index}")
    events("x" * 1000)
    assert len(logged) == 31
    assert len(logged[-1]) == 1000
    assert [e["text"] for e in events.latest][:2] == ["line 19", "line 20"]
    assert len(events.latest[-1]["text"]) == 240
    assert all(e["time_s"] > 1e9 for e in events.latest)
