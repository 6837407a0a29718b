"""Fly to the state in which a fault is injected, and bring the rig to rest afterwards."""

from __future__ import annotations

import contextlib
import json
import socket
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from levid.benchmarks.daemon.fault_list import Case
from levid.benchmarks.daemon.fault_rig import GIVE_UP_S, Rig
from levid.daemon.client import DaemonError

_LIFT = {"unload_s": 0.2, "ramp_s": 0.4, "settle_s": 0.2, "check_coils": False}
LANDING_S = 4.0
_AT_M, _MOVING_M_S = 0.01, 0.001
_RECORD_S = 120.0
_BEGINS_S = 10.0


class NotInjectedError(Exception):
    """The fault did not happen: no flight, or the injection failed."""


@dataclass
class Flight:
    """A flight: its first cycle, the status just before the fault, and the waiting client."""

    began: int
    status: dict[str, Any]
    client: socket.socket | None = None

    def hang_up(self) -> None:
        """Close the client's connection."""
        if self.client is not None:
            self.client.close()
            self.client = None


def lift_off(rig: Rig, case: Case, home: Path) -> Flight:
    """Fly until the fault is due; logs are in a folder of `home`. Raises NotInjectedError."""
    status = rig.until(_rests)
    if status is None:
        raise NotInjectedError("the rig is not at rest")
    rig.flights += 1
    rig.flight = home / f"flight-{rig.flights}"
    flight = Flight(status["cycle"], status)
    try:
        _take_off(rig, case, flight)
        due_s = time.monotonic() + case.delay_s
        found = rig.until(lambda s: s["state"] == case.state or s["fault"] != "NONE", _BEGINS_S)
        time.sleep(max(due_s - time.monotonic(), 0.0) if case.kind != "heat" else 0.0)
        flight.status = rig.ask("status")
    except DaemonError as refused:
        flight.hang_up()
        raise NotInjectedError(str(refused)) from None
    status = flight.status
    if found is None or status["state"] != case.state or status["fault"] != "NONE":
        flight.hang_up()
        what = f"{status['state']}, {status['fault']}: {status['detail']}"
        raise NotInjectedError(f"expected {case.state}, found {what}")
    return flight


def _rests(status: dict[str, Any]) -> bool:
    """Return whether the next flight may begin: a session ends when its last row is on disk."""
    return status["state"] == "IDLE" and status["fault"] == "NONE" and status["session"] is None


def _take_off(rig: Rig, case: Case, flight: Flight) -> None:
    out = str(rig.flight)
    gone = "land" if case.kind.endswith("land") else "go_on"
    if case.state == "EXCITING":
        session = yaml.safe_dump(_session(hot=case.kind == "heat"))
        flight.client = _begin(rig, "excite", session=session, out=out, client_gone=gone)
        return
    land = {"ramp_s": LANDING_S if case.state == "LANDING" else 0.3}
    rig.ask("levitate", levitate=_LIFT, land=land, out=out)
    if case.state == "MOVING":
        to_m = _AT_M if rig.ask("status")["beam_m"] < 0.0 else -_AT_M
        move = {"beam_m": to_m, "velocity_m_s": _MOVING_M_S}
        flight.client = _begin(rig, "move", move=move, client_gone=gone)
    elif case.state == "LANDING":
        rig.ask("land")


def _session(hot: bool) -> dict[str, Any]:
    """Return a session with a long record; a `hot` one exceeds the thermal limit of a coil."""
    quiet = {"input": "z", "rms_n": 0.3, "band_hz": [1.0, 20.0]}
    tone = {"signal": "multisine", "band_hz": [15.5, 16.5], "period_s": 1.0}
    hard = {"input": "coil:4", "rms_n": 7.0, **tone}
    record = {"name": "long", "duration_s": _RECORD_S, "excite": ["it"], "settle_s": 0.0}
    return {
        "levid": "session",
        "name": "fault",
        "excitations": {"it": hard if hot else quiet},
        "steps": [
            {"levitate": _LIFT},
            {"record": {**record, "fade_s": 0.1}},
            {"land": {"ramp_s": 0.3}},
        ],
    }


def _begin(rig: Rig, op: str, **more: Any) -> socket.socket:
    """Send a request that takes long, and do not wait for its end."""
    client = socket.socket(socket.AF_UNIX)
    client.settimeout(GIVE_UP_S)
    try:
        client.connect(str(rig.path))
        client.sendall(json.dumps({"op": op, **more}).encode() + b"\n")
    except OSError as error:
        client.close()
        raise DaemonError(f"{op}: {error}") from None
    return client


def come_to_rest(rig: Rig) -> int:
    """End the cause, clear the fault and wait until the daemon is idle; return requests to clear.

    A daemon that has ended is started again, as systemd would do. Raises RuntimeError on a timeout.
    """
    rig.say("clear")
    if not rig.daemon_is_there:
        rig.start_anew()
    if not rig.port_is_there():
        raise RuntimeError("the electronics' port did not come back")
    clears, refused, give_up_s = 0, "", time.monotonic() + GIVE_UP_S
    while time.monotonic() < give_up_s:
        with contextlib.suppress(DaemonError):  # it has just been started
            status = rig.ask("status")
            if status["fault"] != "NONE":
                clears += 1
                try:
                    rig.ask("clear")
                except DaemonError as error:
                    refused = str(error)
            elif _rests(status):
                return clears
        time.sleep(0.05)
    raise RuntimeError(f"not usable after {clears} clears in {GIVE_UP_S:g} s: {refused}")
