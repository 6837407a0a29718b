"""Check before a lift-off that the daemon can fly: devices, recorder, real time, processor, loop.

Two further checks need the flight: the predicted motion (`planning.predicted_motion`) and the room
on the disk (`planning.planner_process`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...config.daemon_settings import Realtime
from ...drivers.base import Context
from ...drivers.open_backends import emulated
from ..control.faults import Fault
from ..control.preflight_findings import Check, Finding, Outcome, refusing
from ..control.states import IN_FLIGHT, State
from ..control.zero_force import ZeroForce
from ..ipc.shared_status_words import Word
from ..planning.refused_request import RefusedError, override_hint

if TYPE_CHECKING:
    from ...config.rig import RigConfig
    from .supervisor import Supervisor

_PROC = Path("/proc")
_ENOUGH_S = 2.0
"""Time of cycles at rest after which their processor time is known."""


class Preflight:
    """Make the checks that need no session."""

    def __init__(self, supervisor: Supervisor, rig: RigConfig, folder: Path) -> None:
        self._supervisor = supervisor
        self._context = Context(rig, 1.0 / rig.rate_hz, folder)
        self._loop = Finding(Check.LOOP, Outcome.UNKNOWN, "not computed yet")

    def compute(self) -> None:
        """Compute the stability of the loop: once, at rest, while the devices are being opened."""
        from ..control.loop_stability import loop_finding  # scipy, for which no process waits

        rig = self._context.rig
        self._loop = loop_finding(rig, 1.0 / rig.rate_hz)

    def findings(self, timing: Mapping[str, Any] | None = None) -> list[Finding]:
        """Return the outcome of each check now; timing: figures of the cycles, if known already."""
        supervisor, rig = self._supervisor, self._context.rig
        words = supervisor.control_words
        return [
            devices_finding(words.state, words.fault, words.detail),
            amplifiers_finding(words.state, supervisor.zero_force),
            recorder_finding(supervisor.recorder.gone, supervisor.recorder.problem),
            real_time_finding(
                rig.realtime, supervisor.loop_pid if words.state is not State.OFF else None
            ),
            cpu_finding(timing or supervisor.timing(), words[Word.CYCLE], rig.rate_hz),
            self._loop,
        ]

    def require(self, overridden: Sequence[str]) -> list[str]:
        """Return the failed checks that do not forbid a lift-off, as journal lines.

        Raises:
            RefusedError: a check failed, and the client does not override it.
        """
        findings = self.findings()
        all_emulated = emulated(self._context)
        refused = refusing(findings, overridden, all_emulated)
        if refused:
            raise RefusedError(
                f"not ready to lift off: {'; '.join(map(str, refused))}"
                f"{override_hint(*(f.check for f in refused))}"
            )
        return [f"preflight check failed, {_why(f, overridden)}: {f}" for f in findings if f.failed]


def _why(finding: Finding, overridden: Sequence[str]) -> str:
    if finding.check in overridden:
        return "overridden by the client"
    return "only a warning, as all devices are emulated"


def devices_finding(state: State, fault: Fault, detail: str) -> Finding:
    """Return whether all devices are open and have passed the self-test."""
    found = "open, readings at rest as expected"
    if fault is Fault.NONE and state in (State.OFF, State.SELF_TEST):
        return Finding(Check.DEVICES, Outcome.UNKNOWN, "not tested yet")
    if fault is not Fault.NONE:
        found = f"fault {fault.name}{f' ({detail})' if detail else ''}"
    return Finding.of(
        Check.DEVICES, fault is Fault.NONE, found, "see the table of faults; then `levid clear`"
    )


def amplifiers_finding(state: State, zero: ZeroForce) -> Finding:
    """Return whether all coils read back zero force at rest."""
    if state in IN_FLIGHT:
        return Finding(Check.AMPLIFIERS, Outcome.UNKNOWN, "in flight")
    if zero.confirmed is None:
        return Finding(Check.AMPLIFIERS, Outcome.UNKNOWN, zero.found)
    return Finding.of(
        Check.AMPLIFIERS,
        zero.confirmed,
        zero.found if zero.confirmed else f"{zero.found}, expected zero",
        "switch off the supply of the coil's amplifier; repair it or its wiring",
    )


def recorder_finding(gone: str, problem: str) -> Finding:
    """Return whether the recorder runs.

    What it could not write last is told, but forbids no flight: the next log shows whether it can.
    """
    return Finding.of(
        Check.RECORDER,
        not gone,
        gone or (f"running, but failed last: {problem}" if problem else "running"),
        "wait for the daemon to restart it; the journal says why it ended",
    )


def real_time_finding(settings: Realtime, pid: int | None) -> Finding:
    """Return whether the loop has the priority and the locked memory that RIG.yaml asks for."""
    if pid is None:
        return Finding(Check.REAL_TIME, Outcome.UNKNOWN, "the loop does not run")
    try:
        policy = os.sched_getscheduler(pid)
        locked = _locked_kb(pid)
    except OSError:
        return Finding(Check.REAL_TIME, Outcome.UNKNOWN, "the loop does not run")
    lacking = []
    if settings.priority and policy != os.SCHED_FIFO:
        lacking.append("no real-time priority")
    if settings.lock_memory and not locked:
        lacking.append("memory not locked")
    return Finding.of(
        Check.REAL_TIME,
        not lacking,
        ", ".join(lacking) or "as RIG.yaml asks for",
        "run levid as the service, or allow it (rtprio and memlock in /etc/security/limits.conf)",
    )


def cpu_finding(timing: Mapping[str, Any], cycles: int, rate_hz: float) -> Finding:
    """Return whether nearly all cycles end within their own period.

    timing: lateness and execution time of the cycles so far, in us, as in the status.
    """
    period_us = 1e6 / rate_hz
    if cycles < _ENOUGH_S * rate_hz:
        return Finding(Check.CPU, Outcome.UNKNOWN, f"fewer than {_ENOUGH_S:g} s of cycles")
    late_us, took_us = (timing[f"{name}_us"]["p99.9"] for name in ("lateness", "execution"))
    return Finding.of(
        Check.CPU,
        late_us + took_us < period_us,
        f"of 1000 cycles, 999 begin within {late_us:.0f} us and take {took_us:.0f} us, of a period "
        f"of {period_us:.0f} us",
        "stop other programs, give the loop a processor (realtime.cpus), or lower rate_hz",
    )


def _locked_kb(pid: int) -> int:
    for line in (_PROC / str(pid) / "status").read_text().splitlines():
        if line.startswith("VmLck:"):
            return int(line.split()[1])
    return 0
