"""Fly sessions on the simulated rig, in virtual time, in this process."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from ..config.base import parse_text
from ..config.rig import load_rig
from ..config.session import SessionConfig, load_session
from ..config.shipped import find_file
from ..daemon.control.faults import FlightFault
from ..daemon.loop.virtual_session import fly_virtually
from .output_folder import folder_without_logs
from .session import Progress, Session, load

if TYPE_CHECKING:
    from ..daemon.recording.log_metadata import FlightResult


def fly(
    session: str | Path | Mapping[str, Any],
    rig: str | Path | None = None,
    sim: str | Path | None = None,
    out: str | Path | None = None,
    *,
    note: str = "",
    progress: Progress | None = None,
) -> Session:
    """Fly a session on the simulated rig, as fast as the code runs, and load its logs.

    Args:
        session: SESSION.yaml, the name of a shipped session, or its contents as a dict.
        rig: RIG.yaml, or the name of a shipped rig; default: the shipped loopback rig.
        sim: SIM.yaml, or the name of a shipped one, the simulated plant; default: the one that the
            rig names.
        out: folder for the logs, without logs in it; default: a temporary folder, which is deleted
            when the returned session and its records are no longer used.
        note: a line on this flight, for its logs and `levid list`.
        progress: called with the step and the completed fraction of the flight.

    Commands in `then` of the session are not run: call `identify` and `trace`.

    Raises:
        ConfigError: a file is wrong, the rig cannot fly the session, or `out` has logs already.
        FlightFault: the flight ended in a fault; its logs are in `out`.
    """
    config, text, source = _session(session)
    keep, folder = None, Path() if out is None else Path(out)
    if out is None:
        keep = tempfile.TemporaryDirectory(prefix="levid-")
        folder = Path(keep.name)
    else:
        folder_without_logs(folder)
    try:
        result = fly_session(config, text, source, rig, sim, folder, progress, note)
    except FlightFault as fault:
        where = "pass out=FOLDER to keep them" if out is None else str(folder)
        fault.add_note(f"logs up to 0.5 s after the fault: {where}")
        raise
    return Session(result.logs, keep=keep) if keep else load(list(result.logs))


def fly_session(
    config: SessionConfig,
    text: bytes,
    source: str,
    rig: str | Path | None,
    sim: str | Path | None,
    out: Path,
    progress: Progress | None = None,
    note: str = "",
) -> FlightResult:
    """Fly a parsed session into the folder `out`; `text` is attached to the logs.

    `source` names the session in errors.

    Raises:
        ConfigError: a file is wrong, or the rig cannot fly the session.
        FlightFault: the flight ended in a fault; its logs are in `out`.
    """
    rig_file = find_file("loopback" if rig is None else rig, "rig")
    flown = load_rig(rig_file)
    if sim is not None:
        flown = flown.model_copy(update={"sim": str(find_file(sim, "sim").resolve())})
    report = progress or (lambda _step, _share: None)
    return fly_virtually(
        flown,
        rig_file,
        config,
        text,
        out,
        lambda step, done, total: report(step, done / total),
        source=source,
        note=note,
    )


def _session(session: str | Path | Mapping[str, Any]) -> tuple[SessionConfig, bytes, str]:
    """Return the parsed session, its text for the logs, and its name in errors."""
    if isinstance(session, Mapping):
        text = yaml.safe_dump(dict(session), sort_keys=False).encode()
        return parse_text(text, SessionConfig, "session"), text, "session"
    path = find_file(session, "session")
    return load_session(path), path.read_bytes(), str(path)
