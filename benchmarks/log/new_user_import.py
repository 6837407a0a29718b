"""Import a file as a new user does: draft, edit what the draft asks for, import."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from levid.log.importing.draft_signals import Draft, draft_signals
from levid.log.importing.header_units import header_cell
from levid.log.importing.importer import Imported, import_file

from .instrument_files import Export

MODEL = """
levid: model
name: mass-on-spring
dof: [{name: x_m, unit: m}]
inputs: [{name: f_n, unit: N}]
parameters:
  m: {value: 3.0, unit: kg, min: 0.01, max: 100}
  d: {value: 5.0, unit: N s/m, min: 0.0, max: 1000}
  k: {value: 100.0, unit: N/m, min: 0.1, max: 10000}
M: [[m]]
D: [[d]]
K: [[k]]
"""


def import_as_new_user(folder: Path, name: str, export: Export) -> tuple[Draft, Imported]:
    """Write the file, draft its SIGNALS.yaml, set roles, names and scales, and import it."""
    data = folder / f"{name}{export.suffix}"
    data.write_bytes(export.content)
    draft = draft_signals(data)
    signals: dict[str, Any] = yaml.safe_load(draft.text)
    signals.update(export.known)
    for column in signals["columns"]:
        if column["role"] == "time" and export.tick_s is not None:
            column |= {"unit": "s", "scale": export.tick_s}
        for channel, role, field, unit in (
            (export.force, "input", "f_n", "N"),
            (export.position, "output", "x_m", "m"),
        ):
            named = header_cell(str(column["column"])).name
            if channel.column not in (column["column"], named):
                continue
            if channel.scale is not None:
                column |= {"unit": unit, "scale": channel.scale}
            column |= {"role": role, "name": field}
            break
        else:
            if column["role"] in ("input", "output"):
                column["role"] = "other"
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(signals, allow_unicode=True))
    return draft, import_file(data, path, folder / f"{name}.mcap")
