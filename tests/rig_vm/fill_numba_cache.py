"""Compiles what a flight compiles, into NUMBA_CACHE_DIR, and what the guests import."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import numpy as np

from levid.config.rig import load_rig
from levid.daemon.control.control_cycle import Controller
from levid.daemon.control.landing import Landing
from levid.daemon.ipc.timing_histograms import WakeUps
from levid.daemon.loop.clock import VirtualClock
from levid.daemon.loop.count_cycle_times import count_wake_up, memory_of
from levid.daemon.loop.virtual_flight import Flight
from levid.drivers.reading_checks import SensorWatch
from levid.wire.can.can_frames import load_frames

HERE = Path(__file__).parent
for name in (
    "cli.daemon_requests",
    "cli.excite",
    "daemon.loop.loop_process",
    "daemon.planning.planner_process",
    "daemon.recording.recorder_process",
    "daemon.supervision.supervisor",
    "drivers.can.backend",
    "report.session.session_page",
    "sim.electronics.drive_nodes",
    "sim.electronics.emulated_rig",
):
    import_module(f"levid.{name}")

rig = load_rig(HERE / "rig.yaml")
loopback = rig.amplifiers.model_validate({"backend": "loopback"})
roles = dict.fromkeys(("amplifiers", "sensors", "drives"), loopback)
with Flight(rig.model_copy(update=roles), HERE, rig.rate_hz, VirtualClock()) as flight:
    flight.idle(2)
# What the loop in real time has of its own.
Landing(Controller(rig, 1 / rig.rate_hz), rig.limits, 1 / rig.rate_hz)
memory_of(1e9 / rig.rate_hz)
count_wake_up(WakeUps(memoryview(bytearray(WakeUps.SIZE))).counts, 1)
values = np.zeros(9)
for fd in (False, True):
    frames = load_frames(None, 9, 9, fd)
    for can_id, data in frames.gap.encode(values, 0, 0):
        frames.gap.accept(can_id, data, 0)
    frames.gap.finish(values)
SensorWatch("", rig.geometry, 1e-3).judge(values)
