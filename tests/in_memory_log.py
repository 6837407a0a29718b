"""Build a log of the rig from rows in memory, without a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.lib.recfunctions import drop_fields

from levid.config.shipped import shipped
from levid.log.reader import Log


def cycle_log(file: str, rows: np.ndarray, **changes: object) -> Log:
    """Return a complete log NN-NAME.mcap of the loopback rig with these rows at 1 kHz."""
    log = Log(
        path=Path(file),
        rows=rows,
        log_time_ns=np.arange(len(rows), dtype=np.uint64) * 10**6,
        rate_hz=1000.0,
        schema_name="levid/msg/Cycle",
        metadata={"kind": "record", "name": Path(file).stem.partition("-")[2]},
        attachments={"rig.yaml": shipped("rigs/loopback.yaml").read_bytes()},
        complete=True,
        problem=None,
    )
    return replace(log, **changes)


def without(log: Log, *names: str) -> Log:
    """Return the log without these fields."""
    return replace(log, rows=drop_fields(log.rows, names, usemask=False))
