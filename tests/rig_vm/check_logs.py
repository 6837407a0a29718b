"""Checks what the daemon logged: flights without a fault, and one with the fault it was given."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from levid.daemon.faults import Fault
from levid.log.reader import read_log

out = Path(sys.argv[1])
for name in ("first", "again"):
    for path in sorted((out / name).glob("*.mcap")):
        log = read_log(path)
        assert log.complete, path
        assert not log.rows["fault"].any(), path
    rows = read_log(out / name / "01-tilt.mcap").rows
    assert np.abs(rows["gap_m"]).max() < 5e-4, "it did not fly: the stops are at 0.9 mm"
    weight = rows["coil_readback_n"].sum(axis=1).mean()
    assert abs(weight - 7.0 * 9.81) < 1.5, f"the coils carried {weight} N"
    skipped = int(rows["skipped"].sum())
    print(f"{name}: {len(rows)} cycles in the record, {skipped} skipped, {weight:.2f} N carried")
rows = read_log(out / "tripped" / "01-tilt.mcap").rows
at = int(np.flatnonzero(rows["fault"])[0])
assert rows["fault"][at] == Fault.AMPLIFIER
assert not rows["coil_n"][at:].any(), "force after the fault"
print(f"tripped: fault {Fault(int(rows['fault'][at])).name} in the log, zero force from there on")
