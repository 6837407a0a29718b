"""The daemon in real time: idles at zero force, flies the sessions it is asked for, lands."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..config.base import ConfigError, parse_text
from ..config.rig import RigConfig
from ..config.session import SessionConfig
from .clock import RealClock
from .faults import Fault, FlightFault
from .flight import Flight, FlightResult, attachments
from .plan import Plan, plan_session
from .server import Send, Server

_IDLE_S = 0.05
_PROGRESS_S = 0.5


class ServiceError(Exception):
    """A request that cannot be carried out now."""


@dataclass
class _Job:
    plan: Plan
    out: Path
    texts: Mapping[str, bytes]
    done: threading.Event = field(default_factory=threading.Event)
    step: str = ""
    share: float = 0.0
    result: FlightResult | None = None
    error: Exception | None = None


@dataclass
class _Recovery:
    done: threading.Event = field(default_factory=threading.Event)
    error: Exception | None = None


class Service:
    """Runs the loop in this thread until `stop` is called; requests come through the socket.

    Requests: status; excite (session: YAML text, out: folder); land (end the session at hand);
    clear (a fault).
    """

    def __init__(self, rig: RigConfig, rig_file: Path, socket_path: Path) -> None:
        self._rig, self._rig_file = rig, rig_file
        self._flight = Flight(rig, rig_file.parent, rig.rate_hz, RealClock(1.0 / rig.rate_hz))
        self._jobs: queue.Queue[_Job] = queue.Queue(maxsize=1)
        self._job: _Job | None = None
        self._recoveries: queue.Queue[_Recovery] = queue.Queue()
        self._fault = Fault.NONE
        self._detail = ""
        self._stopping = False
        self._busy = threading.Lock()
        self._server = Server(
            socket_path,
            {
                "status": self._status,
                "excite": self._excite,
                "land": self._land,
                "clear": self._clear,
            },
        )

    def run(self, ready: Callable[[], None] = lambda: None) -> None:
        """Fly until stopped; coils are at zero force on return, whatever happened.

        `ready` is called when requests are answered.
        """
        with self._flight:
            self._server.start()
            ready()
            try:
                while not self._stopping:
                    self._recover_if_asked()
                    try:
                        self._job = self._jobs.get_nowait()
                    except queue.Empty:
                        self._idle()
                        continue
                    if self._fault is Fault.NONE:
                        self._fly(self._job)
                    else:  # it came while the session was being planned
                        self._job.error = ServiceError(f"in fault {self._fault.name}")
                        self._job.done.set()
                    self._job = None
                    self._busy.release()
            finally:
                self._server.close()

    def stop(self) -> None:
        """Land if in flight, then return from `run`; may be called from a signal handler."""
        self._stopping = True
        self._flight.loop.stop_requested = True

    def _idle(self) -> None:
        fault = self._flight.idle(max(int(_IDLE_S * self._rig.rate_hz), 1))
        # Late cycles and stale readings at zero force harm nobody; they count, but do not fault.
        if fault not in (Fault.NONE, Fault.LATE, Fault.STALE):
            self._enter_fault(fault, self._flight.loop.detail)
            # A dead bus fails at once: wait as long as an idle stretch would have taken.
            time.sleep(_IDLE_S)

    def _recover_if_asked(self) -> None:
        """Recover the devices for a client that clears a fault: they belong to this thread."""
        try:
            recovery = self._recoveries.get_nowait()
        except queue.Empty:
            return
        try:
            self._flight.devices.recover()
            self._fault, self._detail = Fault.NONE, ""
            self._flight.latch(Fault.NONE)
        except Exception as error:  # noqa: BLE001 - the client is told, the fault stays
            recovery.error = error
        recovery.done.set()

    def _fly(self, job: _Job) -> None:
        def progress(step: str, done: int, total: int) -> None:
            job.step, job.share = step, done / max(total, 1)

        loop = self._flight.loop
        # A request to land belongs to one session; one to stop is never forgotten, not even if the
        # signal comes between these two lines.
        loop.stop_requested = False
        loop.stop_requested |= self._stopping
        try:
            job.result = self._flight.fly(job.plan, job.out, job.texts, progress)
        except FlightFault as error:
            job.error = error
            self._enter_fault(error.fault, error.detail)
        except Exception as error:  # noqa: BLE001 - the client is told, the daemon goes on
            self._flight.loop.zero()
            job.error = error
        finally:
            job.done.set()

    def _enter_fault(self, fault: Fault, detail: str) -> None:
        if self._fault is not Fault.NONE:
            return  # what came first is the cause
        self._fault, self._detail = fault, detail
        self._flight.latch(fault)

    def _status(self, request: Mapping[str, Any], send: Send) -> Mapping[str, Any]:  # noqa: ARG002
        job, loop = self._job, self._flight.loop
        return {
            "rig": self._rig.name,
            "rate_hz": self._rig.rate_hz,
            "cycle": loop.cycle,
            "late": loop.late,
            "stale": self._flight.devices.stale,
            "fault": self._fault.name,
            "detail": self._detail,
            "session": job.plan.name if job else None,
            "step": job.step if job else None,
            "share": job.share if job else None,
        }

    def _excite(self, request: Mapping[str, Any], send: Send) -> Mapping[str, Any]:
        if self._fault is not Fault.NONE:
            raise ServiceError(f"in fault {self._fault.name}: clear it first")
        # One session at a time, from its planning to its end: a plan begins where the beam is.
        if not self._busy.acquire(blocking=False):
            raise ServiceError("a session is being flown, or is about to be")
        try:
            job = self._new_job(request)
            self._jobs.put_nowait(job)
        except BaseException:
            self._busy.release()
            raise
        while not job.done.wait(_PROGRESS_S):
            send({"step": job.step, "share": job.share})
        if job.error is not None:
            raise ServiceError(str(job.error))
        assert job.result is not None
        result = job.result
        return {
            "logs": list(map(str, result.logs)),
            "records": list(map(str, result.records)),
            "cycles": result.cycles,
            "late": result.late,
            "lost": result.lost,
            "stopped": result.stopped,
        }

    def _new_job(self, request: Mapping[str, Any]) -> _Job:
        text, out = request.get("session"), request.get("out")
        if not isinstance(text, str) or not isinstance(out, str):
            raise ServiceError("excite: expected 'session' (YAML text) and 'out' (a folder)")
        self._check_rig(request.get("rig"))
        session = parse_text(text, SessionConfig, "session")
        if session.rate_hz not in (None, self._rig.rate_hz):
            raise ConfigError(
                f"session {session.name}: rate_hz: expected the daemon's {self._rig.rate_hz:g} Hz, "
                f"found {session.rate_hz:g} Hz"
            )
        plan = plan_session(session, self._rig, self._flight.beam_m, self._flight.rotor_rad)
        folder = Path(out)
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.glob("*.mcap")):
            raise ServiceError(f"{folder}: expected a folder without logs")
        return _Job(plan, folder, attachments(self._rig_file.read_bytes(), text.encode()))

    def _check_rig(self, text: object) -> None:
        """Refuse a session that was written for another rig than this daemon runs."""
        if text is None:
            return
        rig = parse_text(str(text), RigConfig, "rig")
        if rig != self._rig:
            raise ConfigError(
                f"rig {rig.name}: expected the rig that this daemon runs ({self._rig_file}), "
                "found another"
            )

    def _land(self, request: Mapping[str, Any], send: Send) -> Mapping[str, Any]:  # noqa: ARG002
        if self._job is None:
            return {"landing": False}
        self._flight.loop.stop_requested = True
        return {"landing": True}

    def _clear(self, request: Mapping[str, Any], send: Send) -> Mapping[str, Any]:  # noqa: ARG002
        cleared = self._fault
        if cleared is Fault.NONE:
            return {"cleared": cleared.name}
        recovery = _Recovery()
        self._recoveries.put(recovery)
        recovery.done.wait()
        if recovery.error is not None:
            raise ServiceError(f"the fault {cleared.name} stays: {recovery.error}")
        return {"cleared": cleared.name}
