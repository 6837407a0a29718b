"""Test what the rig page is told: geometry and limits of any rig, spikes, readings that fail."""

from __future__ import annotations

import json

import numpy as np
import pytest

from levid.config.rig import RigConfig, load_rig
from levid.config.shipped import shipped
from levid.daemon.control.faults import FAULTS, Fault
from levid.daemon.ipc.row_ring import Ring
from levid.daemon.live.decimation import Decimator
from levid.daemon.live.flight_events import Event, FlightEvents, Level
from levid.daemon.live.page_data import bars_of, rig_data, row_data
from levid.log.signals import cycle_dtype

RIG = load_rig(shipped("rigs/loopback.yaml"))


def other_rig() -> RigConfig:
    """Return a rig with four coils, five sensors and few limits."""
    plain = RIG.model_dump()
    plain["geometry"] = {
        "coil_x_m": (0.1, 0.1, -0.1, -0.1),
        "coil_y_m": (0.1, -0.1, 0.1, -0.1),
        "sensor_x_m": (0.1, 0.1, -0.1, -0.1, 0.0),
        "sensor_y_m": (0.1, -0.1, 0.1, -0.1, 0.0),
    }
    plain["limits"] |= {"tilt_rad": None, "coil_rms_n": None}
    return RigConfig.model_validate(plain)


@pytest.mark.parametrize("rig", [RIG, other_rig()], ids=["shipped", "other"])
def test_a_spike_and_a_failed_reading_are_shown(rig: RigConfig) -> None:
    coils, sensors = len(rig.geometry.coil_x_m), len(rig.geometry.sensors_x_m)
    ring = Ring(cycle_dtype(coils, sensors), 4096)
    decimator, bars = Decimator(ring, 100), bars_of(rig)
    ring.rows["z_m"][:200], ring.rows["z_m"][37] = 1e-6, 5e-4  # a spike of one cycle
    ring.rows["lateness_s"][120] = 1e-3
    ring.rows["gap_m"][150, 1] = np.nan
    ring.head += 200
    rows = decimator.read()
    assert rows is not None
    data = json.loads(json.dumps(row_data(rows, bars, np.full(coils, 4.0)), allow_nan=False))
    names = [bar.name for bar in bars]
    assert names == ["psi", "theta", "z", "beam", "rotor"]
    assert data["bars"][names.index("z")] == [1.0, 0.0, 1.0, 500.0]
    assert data["late_us"] == [0.0, 1000.0]
    assert data["heat"] == [2.0] * coils
    assert data["gap_low"] == [None if k == 1 else 0.0 for k in range(sensors)]
    told = json.loads(json.dumps(rig_data(rig, control=False), allow_nan=False))
    assert len(told["coils"]) == coils
    assert len(told["sensors"]) == sensors


def test_limits_of_the_bars_are_those_of_the_rig() -> None:
    limits = {bar.name: (bar.limit, bar.unit) for bar in bars_of(RIG)}
    assert limits["z"] == (pytest.approx(850.0), "µm")
    assert limits["psi"] == (pytest.approx(6.5), "mrad")
    assert limits["beam"] == (pytest.approx(100.0), "mm")
    # Without tilt_rad: the tilt at which the outer sensors reach gap_m.
    assert {b.name: b.limit for b in bars_of(other_rig())}["psi"] == pytest.approx(8.5)


def status(**changed: object) -> dict[str, object]:
    calm = {"rig": "x", "rate_hz": 1000.0, "fault": "NONE", "detail": "", "late": 0, "step": None}
    return calm | {"session": None, "recording": "", "recorder_restarts": 0} | changed


@pytest.mark.parametrize("fault", [fault for fault in Fault if fault is not Fault.NONE])
def test_each_fault_is_an_event_with_cause_check_and_remedy(fault: Fault) -> None:
    seen: list[Event] = []
    events = FlightEvents(seen.append)
    events.status(status())
    events.status(status(fault=fault.name, detail="sensor 3"))
    events.status(status(fault=fault.name, detail="sensor 3"))
    text = FAULTS[fault]
    (found,) = seen[1:]
    assert found.level is Level.ERROR
    for part in (fault.name, text.cause, "sensor 3", text.check, text.cleared):
        assert part in found.text


def test_late_cycles_are_added_up_and_told_rarely() -> None:
    seen: list[Event] = []
    events = FlightEvents(seen.append)
    for late in range(100):
        events.status(status(late=late))
    assert [event.text for event in seen[1:]] == ["1 late cycle"]
