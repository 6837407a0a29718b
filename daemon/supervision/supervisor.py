"""The daemon: a supervisor that keeps its processes running and does what clients ask."""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ...config.rig import RigConfig
from ...drivers.base import Context
from ...drivers.registry import check_backends
from ..api.control_server import Reply, Server, ServerError
from ..api.prometheus_metrics import serve_metrics
from ..control.detection_times import expiry_warning
from ..control.faults import Fault
from ..control.feed_forward import feed_forward
from ..control.states import IN_FLIGHT, State
from ..host.access_control import Access
from ..host.child_process import Child, module_of
from ..host.clock_steps import ClockWatch
from ..host.process_clock import Awake
from ..host.resource_monitor import Burdens
from ..ipc.control_words import Word
from ..ipc.shared_memory import Shared
from ..planning.planner import RELOADED
from ..planning.planner_link import PlannerLink
from ..recording.coil_heat import HeatFile, state_folder
from ..recording.fault_recorder import fault_folder
from ..recording.recorder_link import RecorderLink
from ..recording.session_logs import attachments
from ..service.journal import moment
from ..service.systemd_notify import Notify
from .job_runner import Pilot
from .pending_clears import OPENING_S, Clearings
from .request_handlers import Requests
from .rig_reload import RigReader
from .stale_monitor import Silence

_TICK_S = 0.01
_STOP_S = 0.25
"""How long a loop that runs may take to see that it is to stop; it takes one cycle."""
_STOPPING_S = 2.0
_KILLED_S = 0.5
"""How long a killed loop is waited for: nothing flies any more."""
_LANDING_S = 10.0
_RECORDER_S = 30.0
_HEAT_S = 2.0


class Supervisor:
    """Runs in one thread from `run` to its return; requests come through the socket.

    Raises:
        ConfigError: the rig's backends, model or access cannot be as they are configured.
    """

    def __init__(
        self,
        rig: RigConfig,
        rig_file: Path,
        socket_path: Path,
        say: Callable[[str], None],
    ) -> None:
        self.rig, self.rig_file = rig, rig_file
        self.rig_text = rig_file.read_bytes()
        # Once: what the host is called is asked of files, and of a process.
        self.attachments = attachments(rig, self.rig_text, b"")
        folder = rig_file.parent.resolve()
        check_backends(Context(rig, 1.0 / rig.rate_hz, folder))
        feed_forward(rig, 1.0 / rig.rate_hz)
        self._say = say
        self._shared = Shared(rig)
        self.board = self._shared.board
        rig_json = rig.model_dump_json().encode()
        self._folder = folder
        self._loop = Child("loop", module_of("loop.loop_process"), rig_json)
        self.recorder = RecorderLink(
            rig_json, self._shared.fd, self.board, fault_folder(rig, folder), say
        )
        self.planner = PlannerLink(rig_json, len(rig.geometry.coil_x_m), say)
        self.pilot = Pilot(rig, self._shared, self.recorder, say)
        self._requests = Requests(self)
        self._server = Server(
            socket_path,
            self._requests.handlers,
            Access(rig.service),
            self.tell,
            self._requests.long,
        )
        self._mail: deque[Callable[[], None]] = deque()
        self._clearings = Clearings(self.board)
        # Signal handlers set these, in the thread that reads them: no lock can be taken there.
        self._stopping = self._reload = False
        self._failed = ""  # why the daemon has to end though nobody asked it to
        self._reader = RigReader(
            rig_file,
            lambda new, access: self.post(lambda: self._take_over(new, access)),
            lambda why: self.tell(f"RIG.yaml is not taken over: {why}"),
        )
        self._awake = Awake()
        self._loop_beat, self._loop_beat_s, self._busy_s = -1, 0.0, 0.0
        self._stop_s: float | None = None
        self._told = Fault.NONE
        self._clock = ClockWatch()
        self._burdens, self._silence = Burdens(say), Silence(say)
        self._notify = Notify()
        shared = self._shared
        self._heat = HeatFile(rig, state_folder(), shared.heat, shared.heated, self.tell)

    @property
    def stopping(self) -> bool:
        """Whether the daemon is about to end."""
        return self._stopping

    @property
    def manipulator(self) -> tuple[float, float]:
        """Where beam (m) and rotor (rad) were last told to be."""
        rows = self._shared.ring.last(1).rows
        if not len(rows):
            return 0.0, 0.0
        return float(rows["beam_ref_m"][0]), float(rows["rotor_ref_rad"][0])

    def post(self, action: Callable[[], None]) -> None:
        """Have something done in the supervisor's thread, soon; from any thread."""
        self._mail.append(action)

    def tell(self, words: str) -> None:
        """Have something said, soon; from any thread."""
        self.post(lambda: self._say(words))

    def stop(self) -> None:
        """Land if in flight, then return from `run`; may be called from a signal handler."""
        self._stopping = True

    def reload(self) -> None:
        """Read RIG.yaml again, soon; may be called from a signal handler."""
        self._reload = True

    def run(self, ready: Callable[[], None] = lambda: None) -> None:
        """Supervise until stopped; all processes have ended on return, whatever happened.

        `ready` is called when requests are answered and the self-test is over. Raises ServerError
        or MetricsError before any device is touched, and ServerError in the end where it answers
        no more.
        """
        self._server.start()
        close_metrics = None
        try:
            if self.rig.service.metrics_port is not None:
                close_metrics = serve_metrics(self.rig.service.metrics_port, self.status)
            if warning := expiry_warning(self.rig):
                self._say(f"warning: {warning}")
            self._reader.start()
            self.recorder.watch()
            self.planner.watch()
            self._heat.start()
            self.board[Word.HEAT_MONOTONIC_NS] = time.monotonic_ns()
            self._start_loop()
            waiting = True
            while not self._stopping:
                self._tick()
                if waiting and self.board.state not in (State.OFF, State.SELF_TEST):
                    waiting = False
                    self._notify.ready()
                    ready()
                time.sleep(_TICK_S)
            self._land_and_end()
        finally:
            self._notify.stopping()
            self._end_loop_at_once()
            self.planner.end()
            self.recorder.end(_RECORDER_S)
            self._burdens.end(self._shared.lost)
            self._heat.close(_HEAT_S)
            self._server.close()
            if close_metrics is not None:
                close_metrics()
            self._shared.close()
        if self._failed:
            raise ServerError(self._failed)

    def clear(self, reply: Reply, stops: int) -> None:
        """Clear the fault at hand; answered when the loop has tried.

        `stops`: Word.STOPS when it was asked for; a stop of after that is not taken back.
        """
        board = self.board
        fault = board.fault
        if fault is Fault.NONE and not board[Word.ZERO]:
            reply.done(cleared=Fault.NONE.name)
            return
        self.pilot.note_fault()  # before it is gone
        self._stop_s = None
        if not self._loop.running:
            board[Word.CLEAR_STOPS] = stops
            board.take_back_stop()
            board[Word.FAULT] = Fault.NONE
            try:
                self._start_loop()
            except OSError as error:  # no memory, too many processes: another try may do
                board[Word.BUSY] = 0
                board[Word.STATE], board[Word.FAULT] = State.FAULT, Fault.LOOP
                reply.refuse(f"the loop cannot be started: {error}")
                return
        else:
            board.clear(stops)
        self._clearings.add(reply, fault)

    def status(self) -> dict[str, Any]:
        """Return what the daemon is doing."""
        board, pilot = self.board, self.pilot
        job = pilot.job  # may end while this is put together
        rows = self._shared.ring.last(1).rows
        pose = {
            name: _number(rows[name][0]) if len(rows) else None
            for name in ("psi_rad", "theta_rad", "z_m", "beam_m", "rotor_rad")
        }
        return {
            "rig": self.rig.name,
            "rate_hz": self.rig.rate_hz,
            "state": board.state.name,
            "cycle": board[Word.CYCLE],
            "late": board[Word.LATE],
            "stale": board[Word.STALE],
            "lost": self._shared.lost,
            "fault": board.fault.name,
            "detail": board.detail,
            "fault_log": self.recorder.last_fault_log,
            "session": job.plan.name if job else None,
            "step": pilot.step_of(job) if job else None,
            "share": pilot.share_of(job) if job else None,
            "clock_stepped_s": round(self._clock.stepped_s, 1),
            "recording": self.recorder.problem,
            "recorder_restarts": max(self.recorder.restarts, 0),
            "clients_gone": pilot.clients_gone,
            "flooded_s": round(self._burdens.flooded_s, 1),
            "memory_stalled_s": round(self._burdens.memory_stalled_s, 1),
            "stolen_s": round(self._burdens.stolen_s, 2),
            "pids": {
                "supervisor": os.getpid(),
                "loop": self._loop.pid,
                "recorder": self.recorder.pid,
                "planner": self.planner.pid,
            },
            **pose,
            "timing": {
                **self._shared.timing.figures(),
                "wake_up_us": self._shared.wake_ups.figures(),
            },
        }

    def journal_fields(self) -> dict[str, str]:
        """Return what an entry of the journal says of this moment; empty where there is nothing."""
        job = self.pilot.job
        session = job.plan.name if job is not None else ""
        return {**moment(self.rig.name, self.board), "LEVID_SESSION": session}

    def _tick(self) -> None:
        """One look at everything; nothing in here waits."""
        self.board[Word.BEAT] += 1
        while self._mail:
            self._mail.popleft()()
        if self._server.dead and not self._stopping:
            self._failed = "nobody answers at the control socket any more"
            self._say(f"{self._failed}: landing, then ending")
            self._stopping = True
        self._watch_loop()
        self.recorder.watch()
        self.planner.watch()
        self.pilot.tick()
        self._clearings.answer()
        self._say_faults()
        if step_s := self._clock.look():
            self._say(f"the clock was set by {step_s:+.1f} s; times in logs go on as before")
        self._burdens.look(time.monotonic(), self._server.requests, self._shared.lost)
        board = self.board
        resting = board.state not in IN_FLIGHT
        self._silence.look(time.monotonic(), board[Word.CYCLE], board[Word.STALE], resting)
        if self._reload:
            self._reload = False
            self._reader.ask()
        self._requests.tick(time.monotonic(), self.status)

    def _start_loop(self) -> None:
        board = self.board
        board[Word.STATE] = State.OFF
        board[Word.BUSY] = 1
        self._busy_s = self._awake.look(time.monotonic())
        fd = self._shared.fd
        self._loop.start((fd, os.getpid(), self._folder), (fd,))

    def _watch_loop(self) -> None:
        """Notice a loop that died, hangs, or does not stop when told to."""
        # A machine that stood still did so for the loop too: that is no silence.
        board, now_s = self.board, self._awake.look(time.monotonic())
        if not self._loop.running:
            asked_to = self.stopping and board.state is State.OFF
            if board.fault is not Fault.LOOP and not asked_to:
                stopped = board[Word.BUSY] and board[Word.ZERO]
                why = "it was stopped while its devices were being opened; " if stopped else ""
                self._loop_is_gone(f"{why}{self._loop.end}")
            return
        if board.fault is Fault.LOOP:  # the kernel does not let go of it yet
            self._loop.kill(0.0)
            return
        beat = board[Word.CYCLE] + board[Word.WAITING]
        if beat != self._loop_beat or board[Word.BUSY]:
            self._loop_beat, self._loop_beat_s = beat, now_s
            self._notify.alive()
        if board[Word.BUSY]:
            if board[Word.ZERO]:
                self._loop.terminate()  # it may be homing, and sees nothing else
            if now_s - self._busy_s > OPENING_S:
                self._end_loop(f"its devices did not open within {OPENING_S:g} s")
            return
        self._busy_s = now_s
        if now_s - self._loop_beat_s > self.rig.service.loop_s:
            self._end_loop(f"it did not advance for {now_s - self._loop_beat_s:.1f} s")
        elif board[Word.ZERO] and board.fault is Fault.NONE:
            self._stop_s = now_s if self._stop_s is None else self._stop_s
            if now_s - self._stop_s > _STOP_S:
                self._end_loop("it did not stop when told to")
        else:
            self._stop_s = None

    def _end_loop_at_once(self) -> None:
        """Whatever brought the supervisor here: a loop that still runs goes to zero, then ends."""
        if self._loop.running:
            self.board.stop(Fault.SUPERVISOR, "it ends")
            self.board[Word.END] = 1
            if self.board[Word.BUSY]:
                self._loop.terminate()
            self._loop.wait(_STOPPING_S)
        self._loop.kill()

    def _end_loop(self, why: str) -> None:
        self._loop.kill(_KILLED_S)
        self._loop_is_gone(f"{why}; {self._loop.end}")

    def _loop_is_gone(self, why: str) -> None:
        """Speak for a loop that no longer can: its devices go to zero force by themselves."""
        board = self.board
        board.detail = why
        board[Word.FAULT_CYCLE], board[Word.FAULT_PLAN] = board[Word.CYCLE], board[Word.PLAN]
        board[Word.BUSY] = 0
        board[Word.STATE], board[Word.FAULT] = State.FAULT, Fault.LOOP
        self.pilot.abort(Fault.LOOP, why)
        self.recorder.fault(Fault.LOOP)

    def _say_faults(self) -> None:
        fault = self.board.fault
        if fault is not self._told:
            self._told = fault
            detail = f": {self.board.detail}" if self.board.detail else ""
            self._say(f"fault {fault.name}{detail}" if fault is not Fault.NONE else "fault cleared")
        self._notify.status(fault.name if fault is not Fault.NONE else self.board.state.name)

    def _take_over(self, new: RigConfig, access: Access) -> None:
        """Take over what can change while it runs: who may ask, and what a client's end means."""
        changed = {key: getattr(new.service, key) for key in RELOADED}
        service = self.rig.service.model_copy(update=changed)
        others = [
            key
            for key in type(new).model_fields
            if getattr(new, key) != (service if key == "service" else getattr(self.rig, key))
        ]
        self.rig = self.rig.model_copy(update={"service": service})
        self._server.admit(access)
        taken = ", ".join(f"service.{key}" for key in RELOADED)
        self._say(f"RIG.yaml: {taken} are taken over")
        if others:
            self._say(f"RIG.yaml: changes of {', '.join(others)} need a new start")

    def _land_and_end(self) -> None:
        """Land, whatever further signals come; then let every process end."""
        board = self.board
        board[Word.END] = 1
        planned_s = (board[Word.LAND_RAMP] + board[Word.LAND_RELEASE]) / self.rig.rate_hz
        if board.state in IN_FLIGHT:
            self._say("landing")
        give_up_s = time.monotonic() + planned_s + _LANDING_S
        while self._loop.running and time.monotonic() < give_up_s:
            if board[Word.BUSY]:  # with devices: it does not look at the board, and nothing flies
                self._loop.terminate()
            self._tick()
            time.sleep(_TICK_S)
        if self._loop.running:
            self._say("the loop did not end: it is killed, and the devices go to zero")
            self._loop.kill()
        # Jobs and clients are told how it ended.
        give_up_s = time.monotonic() + _LANDING_S
        while self.pilot.job is not None and time.monotonic() < give_up_s:
            board[Word.BEAT] += 1
            self._notify.alive()  # there is no loop any more whose advance could say so
            self.recorder.watch()
            self.pilot.tick()
            time.sleep(_TICK_S)


def _number(value: float) -> float | None:
    """Return a number that JSON has: what was never read is None."""
    return float(value) if math.isfinite(value) else None
