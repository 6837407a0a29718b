"""Write the SIGNALS.yaml beside an exported CSV file: units, roles and origin of its columns.

It is documentation for people, and `levid import` reads it: the numbers come back as they were.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from ...config.escaping import one_line
from ..importing.signals_yaml import attached_signals
from ..log_stream import LogStream
from .columns import TIME, Column

_ROLES = {
    **dict.fromkeys(("psi_rad", "theta_rad", "z_m"), "output"),
    **dict.fromkeys(("tau_psi_n_m", "tau_theta_n_m", "tau_z_n"), "input"),
    **dict.fromkeys(("psi_ref_rad", "theta_ref_rad", "z_ref_m"), "reference"),
    "beam_m": "scheduling",
}
_EXCITATION = {
    "v_psi_n_m": "tau_psi_n_m",
    "v_theta_n_m": "tau_theta_n_m",
    "v_z_n": "tau_z_n",
}
_NOT_IMPORTED = (TIME, "cycle")
"""`levid import` writes these fields itself."""


def description_path(path: Path) -> Path:
    """Return the path of the SIGNALS.yaml of a CSV file: flight.csv has flight.signals.yaml."""
    return path.with_suffix(".signals.yaml")


def import_description(
    log: LogStream, columns: Sequence[Column], facts: Mapping[str, str], begin_s: float
) -> str:
    """Return the text of the SIGNALS.yaml of an exported table that begins at `begin_s`."""
    known = _imported_roles(log)
    names = {c.name for c in columns}
    entries: list[dict[str, Any]] = []
    if TIME in names:
        entry = {"column": TIME, "name": "logged_time_s", "unit": "s", "role": "time"}
        entries.append(entry)
    for column in columns:
        if column.name in _NOT_IMPORTED:
            continue
        entry = known.get(column.name) or _role(column.name, names)
        entry = {"role": "other"} if entry.get("of") not in (None, *names) else entry
        entries += [
            {"column": name, "name": name, "unit": column.unit or "1", **entry}
            for name in column.flat_names
        ]
    lines = [f"# {one_line(key)}: {json.dumps(value)}" for key, value in facts.items()]
    lines += ["levid: signals", f"rate_hz: {float(facts['rate_hz'])!r}", f"begins_s: {begin_s!r}"]
    if attached_signals(log.attachments) is None:
        lines.append("loop: {controller: unknown}")
    lines.append("columns:")
    lines += [f"  - {_flow(entry)}" for entry in entries]
    return "\n".join(lines) + "\n"


def _role(name: str, names: set[str]) -> dict[str, Any]:
    if name in _EXCITATION and _EXCITATION[name] in names:
        return {"role": "excitation", "of": _EXCITATION[name]}
    return {"role": _ROLES.get(name, "other")}


def _imported_roles(log: LogStream) -> dict[str, dict[str, Any]]:
    """Return role, noise and resolution of each column of an imported log."""
    signals = attached_signals(log.attachments)
    if signals is None:
        return {}
    found = {}
    for column in signals.columns:
        kept = {
            key: getattr(column, key)
            for key in ("role", "of", "noise_sd", "resolution")
            if getattr(column, key) is not None
        }
        found[column.name] = {"role": "other"} if column.role == "time" else kept
    return found


def _flow(entry: Mapping[str, Any]) -> str:
    text: str = yaml.safe_dump(dict(entry), default_flow_style=True, sort_keys=False, width=10_000)
    return text.strip()
