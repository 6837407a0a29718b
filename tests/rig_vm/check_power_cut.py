"""Checks the log of a daemon whose machine lost its power while it recorded."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from levid.log.reader import read_log

# The recorder holds back 0.9 s, and the disk is asked every 0.5 s: docs/daemon.md says so.
LOST_S = 1.4

out = Path(sys.argv[1])
cut = json.loads((out / "cut").read_text())
log = read_log(out / "cut-logs" / "01-tilt.mcap")
assert not log.complete, "a log that was closed: the power was not cut while it recorded"
cycles = log.rows["cycle"]
assert (np.diff(cycles.astype(int)) > 0).all()
lost_s = (cut["cycle"] - int(cycles[-1])) / cut["rate_hz"]
# A guest that stood still did so for its recorder and its disk.
stood_s = int(log.rows["skipped"].max()) / cut["rate_hz"]
assert lost_s < LOST_S + stood_s, f"{lost_s:.2f} s before the cut are missing"
assert not log.rows["fault"].any()
print(
    f"power cut: the log opens, {len(cycles)} rows, {max(lost_s, 0):.2f} s before the cut missing"
)
