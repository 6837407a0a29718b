"""Supervisor of the daemon: start and monitor its processes, execute client requests."""

from __future__ import annotations

import os
import time
import zlib
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ...config.rig import RigConfig
from ...drivers.base import Context
from ...drivers.open_backends import check_backends, reads_back
from ..api.control_server import Reply, Server, ServerError
from ..api.prometheus_metrics import serve_metrics
from ..control.faults import Fault
from ..control.feed_forward import feed_forward
from ..control.states import IN_FLIGHT, State
from ..control.watchdog_times import expiry_warning
from ..control.zero_force import ZeroForce, zero_force
from ..host.child_process import Child, module_of
from ..host.peer_credentials import Access
from ..host.rate_limited_log import RateLimitedLog
from ..host.resource_monitor import ResourceMonitor
from ..host.wall_clock_jumps import ClockWatch
from ..ipc.shared_memory import SharedMemory
from ..ipc.shared_status_words import Word
from ..live.live_link import LiveLink
from ..planning.planner_link import PlannerLink
from ..planning.refused_request import RELOADED
from ..recording.coil_heat_file import HeatFile, state_folder
from ..recording.fault_recorder import fault_folder
from ..recording.log_metadata import attachments
from ..recording.recorder_link import RecorderLink
from ..service.journal import moment
from ..service.systemd_notify import Notify
from .fault_clearing import PendingClears
from .flight_runner import JobRunner
from .live_readings import last_cycle, live_readings, recent_rows
from .loop_monitor import LoopMonitor
from .missing_readings_at_rest import StaleMonitor
from .preflight import Preflight
from .recent_events import RecentEvents
from .request_handlers import Requests
from .rig_reload import RigReader

_TICK_S = 0.01
_LANDING_S = 10.0
_RECORDER_S = 30.0
_HEAT_S = 2.0


class Supervisor:
    """Run the daemon in one thread, from `run` to its return; clients use the control socket.

    Raises:
        ConfigError: a backend, the model or the access rights of the rig are invalid.
    """

    def __init__(
        self,
        rig: RigConfig,
        rig_file: Path,
        socket_path: Path,
        log: Callable[[str], None],
    ) -> None:
        self.rig, self.rig_file = rig, rig_file
        self.rig_text = rig_file.read_bytes()
        self._rig_crc32 = zlib.crc32(self.rig_text)
        # Only once: finding the host's data reads files and runs a process.
        self.attachments = attachments(rig, self.rig_text, b"")
        folder = rig_file.parent.resolve()
        check_backends(Context(rig, 1.0 / rig.rate_hz, folder))
        feed_forward(rig, 1.0 / rig.rate_hz)
        self._reads_back = reads_back(Context(rig, 1.0 / rig.rate_hz, folder))
        self.preflight = Preflight(self, rig, folder)
        self._log = log = RecentEvents(log)
        self._rarely = RateLimitedLog(log)
        self._shared = SharedMemory(rig)
        self.control_words = self._shared.control_words
        rig_json = rig.model_dump_json().encode()
        self._folder = folder
        self._notify = Notify()
        self._loop = LoopMonitor(
            Child("loop", module_of("loop.loop_process"), rig_json),
            self.control_words,
            rig.service.loop_s,
            self._notify.alive,
            self._loop_lost,
        )
        self.recorder = RecorderLink(
            rig_json, self._shared.fd, self.control_words, fault_folder(rig, folder), log
        )
        self.planner = PlannerLink(rig_json, len(rig.geometry.coil_x_m), log)
        self.job_runner = JobRunner(rig, self._shared, self.recorder, log)
        self._requests = Requests(self)
        self._server = Server(
            socket_path,
            self._requests.handlers,
            Access(rig.service),
            self.log_soon,
            self._requests.on_long,
        )
        self._live = LiveLink(rig, self._shared, self._server, socket_path.parent, log)
        self._actions: deque[Callable[[], None]] = deque()
        self._pending_clears = PendingClears(self.control_words)
        # Set by signal handlers, which must not take a lock.
        self._stopping = self._reload = False
        self._failed = ""  # error that ends the daemon
        self._reader = RigReader(
            rig_file,
            lambda new, access: self.post(lambda: self._apply_rig(new, access)),
            lambda error: self.log_soon(f"RIG.yaml is not reloaded: {error}"),
        )
        self._logged_fault = Fault.NONE
        self._clock = ClockWatch()
        self._resources, self._stale_monitor = ResourceMonitor(log), StaleMonitor(log)
        shared = self._shared
        self._heat = HeatFile(rig, state_folder(), shared.heat, shared.heated, self.log_soon)

    @property
    def stopping(self) -> bool:
        """Whether the daemon is about to end."""
        return self._stopping

    @property
    def zero_force(self) -> ZeroForce:
        """Whether the amplifiers confirm zero force."""
        rows = self._shared.ring.last(recent_rows(self.rig)).rows
        return zero_force(rows, self.control_words[Word.CYCLE], self.rig, self._reads_back)

    @property
    def manipulator(self) -> tuple[float, float]:
        """Last setpoints of beam (m) and rotor (rad)."""
        rows = self._shared.ring.last(1).rows
        if not len(rows):
            return 0.0, 0.0
        return float(rows["beam_ref_m"][0]), float(rows["rotor_ref_rad"][0])

    @property
    def loop_pid(self) -> int | None:
        """Process id of the loop, None if it does not run."""
        return self._loop.pid

    @property
    def log_root(self) -> Path | None:
        """Folder below which all logs are, None if they may be anywhere."""
        root = self.rig.recording.root
        return None if root is None else self._folder / root

    def log_folder(self, out: str) -> Path:
        """Return the folder for the logs of a request; a relative one is below `log_root`."""
        root = self.log_root
        return Path(out) if root is None else root / out

    @property
    def _present_log_folder(self) -> str:
        """Folder of the log being written, else of all logs, else of flight recordings."""
        log, root = self.recorder.writing, self.log_root
        return str(Path(log).parent if log else root or fault_folder(self.rig, self._folder))

    def timing(self) -> dict[str, Any]:
        """Return the times of the cycles so far, as in the status."""
        return self._shared.timing.figures()

    def post(self, action: Callable[[], None]) -> None:
        """Run `action` in the supervisor's thread at its next tick; call from any thread."""
        self._actions.append(action)

    def log_soon(self, line: str) -> None:
        """Log a line at the next tick; call from any thread."""
        self.post(lambda: self._log(line))

    def stop(self) -> None:
        """Land if in flight, then return from `run`; safe in a signal handler."""
        self._stopping = True

    def reload(self) -> None:
        """Reload RIG.yaml at the next tick; safe in a signal handler."""
        self._reload = True

    def run(self, ready: Callable[[], None] = lambda: None) -> None:
        """Supervise until stopped; all processes have ended on return, also after an error.

        `ready` is called when requests are answered and the self-test has ended.

        Raises:
            ServerError, MetricsError: a socket cannot be opened; no device was opened.
            ServerError: the control socket failed later.
        """
        self._server.start()
        close_metrics = None
        try:
            if self.rig.service.metrics_port is not None:
                close_metrics = serve_metrics(self.rig.service.metrics_port, self.status)
            if warning := expiry_warning(self.rig):
                self._log(f"warning: {warning}")
            self._reader.start()
            self.recorder.watch()
            self.planner.watch()
            self._heat.start()
            self.control_words[Word.HEAT_MONOTONIC_NS] = time.monotonic_ns()
            self._start_loop()
            self._live.announce()
            self.preflight.compute()
            waiting = True
            while not self._stopping:
                self._tick()
                if waiting and self.control_words.state not in (State.OFF, State.SELF_TEST):
                    waiting = False
                    self._notify.ready()
                    ready()
                time.sleep(_TICK_S)
            self._land_and_end()
        finally:
            self._notify.stopping()
            self._loop.end_at_once()
            self.planner.end()
            self._live.end()
            self.recorder.end(_RECORDER_S)
            self._resources.end(self._shared.lost)
            self._heat.close(_HEAT_S)
            self._server.close()
            if close_metrics is not None:
                close_metrics()
            self._shared.close()
        if self._failed:
            raise ServerError(self._failed)

    def clear(self, reply: Reply, stops: int) -> None:
        """Clear the current fault; `reply` is answered when the loop has tried.

        `stops`: value of Word.STOPS at the request; later stops are not cancelled.
        """
        control_words = self.control_words
        fault = control_words.fault
        if fault is Fault.NONE and not control_words[Word.ZERO]:
            reply.done(cleared=Fault.NONE.name)
            return
        self.job_runner.note_fault()  # before it is cleared
        self._loop.forget_stop()
        if not self._loop.running:
            control_words[Word.CLEAR_STOPS] = stops
            control_words.cancel_stop()
            control_words[Word.FAULT] = Fault.NONE
            try:
                self._start_loop()
            except OSError as error:  # no memory, too many processes: the user may try again
                control_words[Word.BUSY] = 0
                control_words[Word.STATE], control_words[Word.FAULT] = State.FAULT, Fault.LOOP
                reply.refuse(f"cannot start the loop: {error}")
                return
        else:
            control_words.clear(stops)
        self._pending_clears.add(reply, fault)

    def status(self) -> dict[str, Any]:
        """Return the status of the daemon, with the keys listed in docs/daemon.md."""
        control_words, job_runner = self.control_words, self.job_runner
        job = job_runner.job  # a local reference: the job may end meanwhile
        timing = self.timing()
        rows = self._shared.ring.last(recent_rows(self.rig)).rows
        readings = live_readings(rows, self._shared.heat, self.rig)
        return {
            "rig": self.rig.name,
            "rig_crc32": self._rig_crc32,
            "rate_hz": self.rig.rate_hz,
            "state": control_words.state.name,
            "cycle": control_words[Word.CYCLE],
            "late": control_words[Word.LATE],
            "stale": control_words[Word.STALE],
            "lost": self._shared.lost,
            "fault": control_words.fault.name,
            "detail": control_words.detail,
            "fault_log": self.recorder.last_fault_log,
            "session": job.plan.name if job else None,
            "step": job_runner.step_of(job) if job else None,
            "share": job_runner.share_of(job) if job else None,
            "left_s": job_runner.left_s_of(job) if job else None,
            "clock_stepped_s": round(self._clock.stepped_s, 1),
            "recording": self.recorder.problem,
            "log_lost": self.recorder.lost,
            "log": self.recorder.writing,
            "log_folder": self._present_log_folder,
            "recorder_restarts": max(self.recorder.restarts, 0),
            "clients_gone": job_runner.clients_gone,
            "flooded_s": round(self._resources.flooded_s, 1),
            "memory_stalled_s": round(self._resources.memory_stalled_s, 1),
            "stolen_s": round(self._resources.stolen_s, 2),
            "pids": {
                "supervisor": os.getpid(),
                "loop": self._loop.pid,
                "recorder": self.recorder.pid,
                "planner": self.planner.pid,
                **({} if self.rig.live is None else {"live": self._live.pid}),
            },
            **{
                f"{quantity['name']}_{quantity['unit']}": quantity["value"]
                for quantity in (*readings["pose"], *readings["manipulator"])
            },
            **readings,
            "zero_force": self.zero_force.as_json(),
            "events": list(self._log.latest),
            "preflight": [finding.as_json() for finding in self.preflight.findings(timing)],
            "timing": {
                **timing,
                "wake_up_us": self._shared.wake_ups.figures(),
                "last": last_cycle(rows),
            },
        }

    def journal_fields(self) -> dict[str, str]:
        """Return the present journal fields; empty values are left out of the entry."""
        job = self.job_runner.job
        session = job.plan.name if job is not None else ""
        return {**moment(self.rig.name, self.control_words), "LEVID_SESSION": session}

    def _tick(self) -> None:
        """Monitor all processes and advance the current request; never waits."""
        self.control_words[Word.BEAT] += 1
        while self._actions:
            self._actions.popleft()()
        if self._server.dead and not self._stopping:
            self._failed = "the control socket failed"
            self._log(f"{self._failed}: landing, then ending the daemon")
            self._stopping = True
        self._loop.watch(self._stopping)
        self.recorder.watch()
        self.planner.watch()
        self._live.watch()
        self.job_runner.tick()
        self._pending_clears.answer()
        self._log_fault()
        if step_s := self._clock.poll():
            clock = f"the system clock was set by {step_s:+.1f} s; log times are not affected"
            self._rarely.line("clock", time.monotonic(), clock)
        self._rarely.flush(time.monotonic())
        self._resources.poll(time.monotonic(), self._server.requests, self._shared.lost)
        control_words = self.control_words
        resting = control_words.state not in IN_FLIGHT
        self._stale_monitor.poll(
            time.monotonic(), control_words[Word.CYCLE], control_words[Word.STALE], resting
        )
        if self._reload:
            self._reload = False
            self._reader.request()
        self._requests.tick(time.monotonic(), self.status)

    def _start_loop(self) -> None:
        fd = self._shared.fd
        self._loop.start((fd, os.getpid(), self._folder), (fd,))

    def _loop_lost(self, reason: str) -> None:
        self.job_runner.abort(Fault.LOOP, reason)
        self.recorder.fault(Fault.LOOP)

    def _log_fault(self) -> None:
        fault = self.control_words.fault
        if fault is not self._logged_fault:
            self._logged_fault = fault
            detail = f": {self.control_words.detail}" if self.control_words.detail else ""
            self._log(f"fault {fault.name}{detail}" if fault is not Fault.NONE else "fault cleared")
        self._notify.status(
            fault.name if fault is not Fault.NONE else self.control_words.state.name
        )

    def _apply_rig(self, new: RigConfig, access: Access) -> None:
        """Apply the RELOADED keys of a new rig; log which other keys need a restart."""
        changed = {key: getattr(new.service, key) for key in RELOADED}
        service = self.rig.service.model_copy(update=changed)
        not_applied = [
            key
            for key in type(new).model_fields
            if getattr(new, key) != (service if key == "service" else getattr(self.rig, key))
        ]
        self.rig = self.rig.model_copy(update={"service": service})
        self._server.set_access(access)
        applied = ", ".join(f"service.{key}" for key in RELOADED)
        self._log(f"RIG.yaml: reloaded {applied}")
        if not_applied:
            self._log(f"RIG.yaml: changes of {', '.join(not_applied)} need a restart of the daemon")

    def _land_and_end(self) -> None:
        """Land, ignoring further signals; then end all processes."""
        control_words = self.control_words
        control_words[Word.END] = 1
        planned_s = (
            control_words[Word.LAND_RAMP] + control_words[Word.LAND_RELEASE]
        ) / self.rig.rate_hz
        if control_words.state in IN_FLIGHT:
            self._log("landing")
        deadline_s = time.monotonic() + planned_s + _LANDING_S
        while self._loop.running and time.monotonic() < deadline_s:
            self._loop.interrupt_opening()
            self._tick()
            time.sleep(_TICK_S)
        if self._loop.running:
            self._log("killed the loop: it did not end; the devices switch to zero force")
            self._loop.kill()
        # Complete the job and answer its client.
        deadline_s = time.monotonic() + _LANDING_S
        while self.job_runner.job is not None and time.monotonic() < deadline_s:
            control_words[Word.BEAT] += 1
            self._notify.alive()  # normally sent while the loop advances
            self.recorder.watch()
            self.job_runner.tick()
            time.sleep(_TICK_S)
