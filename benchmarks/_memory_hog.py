"""Holds most of the memory that is free until its input ends; where memory is short it goes first.

On its own: `python _memory_hog.py BYTES` says on a line how much it holds once it does.
"""

from __future__ import annotations

import mmap
import sys
from pathlib import Path

SHARE = 0.9
SAFETY = 1 << 30
"""Left free whatever else: a machine that swaps or kills is another experiment."""
_BLOCK = 4 << 20
"""So little at a time that a virtual machine's host is not asked for much at once."""


def available() -> int:
    """Return the bytes that could be had without swapping."""
    (line,) = (
        one for one in Path("/proc/meminfo").read_text().splitlines() if "MemAvailable" in one
    )
    return 1024 * int(line.split()[1])


def to_take(free: int, most: int | None = None) -> int:
    """Return how many of so many free bytes to hold: SHARE of them less SAFETY, at most `most`."""
    wanted = max(int(SHARE * free) - SAFETY, 0)
    return wanted if most is None else min(wanted, most)


def hold(wanted: int) -> list[mmap.mmap]:
    """Return blocks of so many bytes that are really there; fewer where others take them too."""
    blocks: list[mmap.mmap] = []
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | mmap.MAP_POPULATE
    while _BLOCK * len(blocks) < wanted and available() > SAFETY:
        blocks.append(mmap.mmap(-1, _BLOCK, flags=flags))
    return blocks


if __name__ == "__main__":
    Path("/proc/self/oom_score_adj").write_text("1000")
    held = hold(int(sys.argv[1]))
    print(_BLOCK * len(held), flush=True)
    sys.stdin.read()
