"""Metadata and attachments of a session's logs, and the result of a flight."""

from __future__ import annotations

import json
import platform
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # `levid stop` must not wait for the import of scipy
    from ...config.rig import RigConfig
    from ..planning.plan import Plan, PlannedStep


class RecordingError(Exception):
    """Report that a log could not be written although the flight succeeded."""


@dataclass(frozen=True)
class FlightResult:
    """List the logs of a session in order, its records, and the counts of the loop.

    `late`: late cycles. `lost`: rows missing in the logs. `stopped`: a landing was requested before
    the end. `unjudged_coils`: coils that the check after lift-off skipped; `coil_check`: a sentence
    that says why, and what to do.
    """

    logs: tuple[Path, ...]
    records: tuple[Path, ...]
    cycles: int
    late: int
    lost: int
    stopped: bool = False
    unjudged_coils: tuple[int, ...] = ()
    coil_check: str = ""


def log_metadata(plan: Plan, step: PlannedStep) -> dict[str, str]:
    """Return the key-value pairs of the Metadata record `levid` in a step's log."""
    noted = {"note": plan.note} if plan.note else {}
    return {
        "format": "1",
        "kind": step.kind,
        "name": step.name,
        "step": str(step.index),
        "steps": str(len(plan.steps)),
        "session": plan.name,
        "rate_hz": repr(plan.rate_hz),
        **noted,
    }


def attachments(rig: RigConfig, rig_text: bytes, session_text: bytes) -> dict[str, bytes]:
    """Return the attachments of every log by name: configuration, versions, host.

    `rig_text` may refer to the model of `rig` by its path: the model is attached too.
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
    from importlib.metadata import PackageNotFoundError, version  # slow: `levid stop` must not wait

    versions = {"python": platform.python_version()}
    for package in ("levid", "numpy", "scipy", "numba", "mcap"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return versions


def _host() -> dict[str, str]:
    return {
        "host": platform.node(),
        "system": platform.platform(),
        "machine": platform.machine(),
        "byteorder": sys.byteorder,
    }
