"""Suggest a shipped session to the rig that flew a session."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..config.base import ConfigError, parse_text
from ..config.command_line import command_line, unused
from ..config.rig import RigConfig
from ..config.shipped import shipped, shipped_names

if TYPE_CHECKING:
    from .session import Session

_SIMULATED = "loopback"


def next_flight(session: Session, name: str) -> str:
    """Return the command by which the session's rig flies the shipped session `name`.

    The text is empty for a rig that levid does not ship: its limits may be others, and the logs do
    not say where its RIG.yaml is.
    """
    first = session.steps[0]
    text = first.attachments.get("rig.yaml")
    if text is None:
        return ""
    try:
        rig = parse_text(text, RigConfig, "rig.yaml")
    except ConfigError:
        return ""
    if rig.name not in shipped_names("rig"):
        return ""
    ours = parse_text(shipped(f"rigs/{rig.name}.yaml").read_text(), RigConfig, rig.name)
    if rig.geometry != ours.geometry:
        return ""
    out = unused(first.path.parent.absolute().parent / name)
    simulated = rig.amplifiers.backend == _SIMULATED
    return command_line("excite", name, virtual=simulated, out=out)
