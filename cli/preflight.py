"""`levid check --preflight`: what the daemon checks before a lift-off, as far as it shows here."""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .progress import counted_progress, say

if TYPE_CHECKING:
    from ..config.rig import RigConfig
    from ..config.session import SessionConfig
    from ..daemon.control.preflight_findings import Finding

_WORDS = {"passed": "ok", "failed": "FAILED", "unknown": "unknown"}


def preflight(
    rig_path: Path, sessions: Sequence[Path], out: Path | None, as_json: bool = False
) -> int:
    """Print the checks of a rig and of sessions on it; return the exit code.

    A daemon that flies the rig is asked for what only it knows.
    """
    from ..config.rig import load_rig
    from ..config.session import load_session

    rig = load_rig(rig_path)
    findings = {str(rig_path): rig_findings(rig, rig_path)}
    for path in sessions:
        session = load_session(path)
        findings[str(path)] = session_findings(session, path, rig, rig_path, out or Path())
    if as_json:
        as_objects = {name: [f.as_json() for f in found] for name, found in findings.items()}
        click.echo(json.dumps(as_objects))
    else:
        for name, found in findings.items():
            _print(name, found)
    return 1 if any(f.failed for found in findings.values() for f in found) else 0


def rig_findings(rig: RigConfig, path: Path) -> list[Finding]:
    """Return the checks that need no session, from the rig's daemon if one runs."""
    from ..daemon.api.socket_paths import listens, socket_path
    from ..daemon.client import Client
    from ..daemon.control.loop_stability import loop_finding
    from ..daemon.control.preflight_findings import Check, Finding, Outcome
    from ..daemon.control.zero_force import NOT_READ_BACK
    from ..daemon.host.real_time_rights import real_time_rights
    from ..drivers.base import Context
    from ..drivers.open_backends import missing, reads_back

    socket = socket_path(rig)
    if listens(socket):
        with Client(socket) as client:
            answer = client.request("status")
        if answer["rig_crc32"] == zlib.crc32(path.read_bytes()):
            return [
                Finding(Check(f["check"]), Outcome(f["outcome"]), f["found"], f["remedy"])
                for f in answer["preflight"]
            ]
        say(f"the running daemon flies another rig or version of {path}; its checks are left out")
    context = Context(rig, 1 / rig.rate_hz, path.parent)
    lacking = missing(context)
    devices = Finding(
        Check.DEVICES, Outcome.UNKNOWN, "not tested: only the daemon (levid run) opens the devices"
    )
    if lacking:
        devices = Finding.of(Check.DEVICES, False, "; ".join(lacking), "see there")
    refused = real_time_rights(rig.realtime)
    return [
        devices,
        Finding(
            Check.AMPLIFIERS,
            Outcome.UNKNOWN,
            "no daemon runs" if reads_back(context) else NOT_READ_BACK,
        ),
        Finding(Check.RECORDER, Outcome.UNKNOWN, "no daemon runs"),
        Finding.of(
            Check.REAL_TIME,
            not refused,
            "; ".join(line.rpartition("; ")[0] for line in refused)  # each ends in its own remedy
            or "this user has the rights that RIG.yaml asks for",
            "run levid as the service, or allow it (rtprio and memlock in "
            "/etc/security/limits.conf)",
        ),
        Finding(
            Check.CPU, Outcome.UNKNOWN, "not measured: only the daemon (levid run) measures it"
        ),
        loop_finding(rig, 1 / rig.rate_hz),
    ]


def session_findings(
    session: SessionConfig, path: Path, rig: RigConfig, rig_path: Path, out: Path
) -> list[Finding]:
    """Return the predicted motion of a session, and the room that its logs need."""
    from ..daemon.planning.plan import plan_session
    from ..daemon.planning.planner import least_cycles
    from ..daemon.planning.predicted_motion import motion_finding
    from ..daemon.recording.log_size import most_log_bytes

    # The session is computed twice: its peak, then its motion.
    least = 2 * least_cycles(session, session.rate_hz or rig.rate_hz)
    with counted_progress(f"checking {path.name}", least) as report:
        plan = plan_session(session, rig, source=str(path), report=report)
        motion = motion_finding(rig, plan, report)
    return [motion, _disk(rig, rig_path, out, most_log_bytes(rig, plan.cycles))]


def _disk(rig: RigConfig, rig_path: Path, out: Path, needed_bytes: int) -> Finding:
    """Return whether the daemon takes the folder and its disk has room; create nothing."""
    from ..api.output_folder import nearest_existing
    from ..daemon.control.preflight_findings import Check, Finding
    from ..daemon.planning.log_folder import disk_finding, folder_problem

    root = rig.recording.root
    limit = None if root is None else rig_path.absolute().parent / root
    problem = folder_problem(out.absolute(), limit)
    if problem:
        return Finding.of(Check.DISK, False, problem, "choose another folder")
    return disk_finding(nearest_existing(out), needed_bytes)


def _print(name: str, findings: Sequence[Finding]) -> None:
    click.echo(f"{name}:")
    for f in findings:
        click.echo(f"  {_WORDS[f.outcome]:8}{f.check:10} {f.found}")
        if f.remedy:
            click.echo(f"{'':20} {f.remedy}")
