"""Checks what the daemon logged: flights without a fault, and one with the fault it was given."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from levid.daemon.control.faults import Fault
from levid.log.reader import read_log

# A guest that stalls for 4 to 11 ms now and then skips cycles of 4 ms, and is late in the one
# before: as many may be stale, and a few more of stalls that skip none. A role that answers late by
# itself, or to every other cycle only, is stale in half of them.
STALE_SHARE = 0.05

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
    stale = int((rows["stale"] != 0).sum())
    share = stale / len(rows)
    print(
        f"{name}: {len(rows)} cycles in the record, {skipped} skipped, {stale} stale "
        f"({share:.1%}), {weight:.2f} N carried"
    )
    assert stale <= skipped + STALE_SHARE * len(rows), f"{name}: {share:.1%} stale"
rows = read_log(out / "tripped" / "01-tilt.mcap").rows
at = int(np.flatnonzero(rows["fault"])[0])
assert rows["fault"][at] == Fault.AMPLIFIER
assert not rows["coil_n"][at:].any(), "force after the fault"
print(f"tripped: fault {Fault(int(rows['fault'][at])).name} in the log, zero force from there on")
