"""Fly a session on the simulator in virtual time, in this process."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ...config.base import ConfigError
from ...config.files.folders import make_folder
from ...config.rig import RigConfig
from ...config.session import SessionConfig
from ...drivers.open_backends import ROLES
from ..planning.plan import checked_note, plan_session
from ..recording.log_metadata import FlightResult, attachments
from .clock import VirtualClock
from .virtual_flight import Flight, Progress


def fly_virtually(
    rig: RigConfig,
    rig_file: Path,
    session: SessionConfig,
    session_text: bytes,
    out: Path,
    progress: Progress | None = None,
    source: str | None = None,
    note: str = "",
) -> FlightResult:
    """Fly `session` on `rig` (read from `rig_file`) and log into the folder `out`.

    `source` names the session in errors. `note` is the user's, for the logs.

    Raises:
        ConfigError: a role has a backend other than loopback, or the session does not fit the rig.
        FlightFault, RecordingError: see Flight.fly.
    """
    for role in ROLES:
        backend = getattr(rig, role).backend
        if backend != "loopback":
            raise ConfigError(
                f"{rig_file}: {role}.backend: expected loopback for virtual time, found {backend}"
            )
    rate_hz = session.rate_hz or rig.rate_hz
    texts = attachments(rig, rig_file.read_bytes(), session_text)
    with Flight(rig, rig_file.parent, rate_hz, VirtualClock()) as flight:
        plan = plan_session(session, rig, flight.beam_m, flight.rotor_rad, source)
        plan = replace(plan, note=checked_note(note))
        # After planning: a session that does not fit the rig creates no files.
        make_folder(out)
        return flight.fly(plan, out, texts, progress)
