"""What a session leaves behind: its logs, and what stands at the head of each."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # a client that stops a flight does not wait for scipy
    from ...config.rig import RigConfig
    from ..planning.plan import Plan, PlannedStep


class RecordingError(Exception):
    """The flight went well but its log did not."""


@dataclass(frozen=True)
class FlightResult:
    """What a session left behind: its logs in order, its records, and the loop's misses.

    `stopped`: it was asked to land before its end. `unjudged_coils`: those that were pushed after
    lift-off and of which nobody knows what they moved, the loop having been too late.
    """

    logs: tuple[Path, ...]
    records: tuple[Path, ...]
    cycles: int
    late: int
    lost: int
    stopped: bool = False
    unjudged_coils: tuple[int, ...] = ()


def in_doubt(unjudged_coils: Iterable[int]) -> str:
    """Return in words which coils the check after lift-off could not judge; empty for none."""
    coils = ", ".join(map(str, unjudged_coils))
    return f"the check after lift-off could not judge all coils: not {coils}" if coils else ""


def log_metadata(plan: Plan, step: PlannedStep) -> dict[str, str]:
    """Return the pairs of the Metadata record `levid` for a step's log."""
    return {
        "format": "1",
        "kind": step.kind,
        "name": step.name,
        "step": str(step.index),
        "session": plan.name,
        "rate_hz": repr(plan.rate_hz),
    }


def attachments(rig: RigConfig, rig_text: bytes, session_text: bytes) -> dict[str, bytes]:
    """Return what goes to the head of every log: the configs, versions and the host.

    `rig_text` may name the model of `rig` by its path; the model itself goes beside it.
    """
    model = rig.model
    beside = {}
    if model is not None and not isinstance(model, str):  # JSON is YAML
        beside["model.yaml"] = model.model_dump_json(indent=1, exclude_none=True).encode()
    return {
        "rig.yaml": rig_text,
        **beside,
        "session.yaml": session_text,
        "versions.json": json.dumps(_versions(), indent=1, sort_keys=True).encode(),
        "host.json": json.dumps(_host(), indent=1, sort_keys=True).encode(),
    }


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in ("levid", "numpy", "scipy", "numba", "mcap"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def _host() -> dict[str, str]:
    return {
        "host": platform.node(),
        "system": platform.platform(),
        "machine": platform.machine(),
        "byteorder": sys.byteorder,
    }
