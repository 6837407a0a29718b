"""A daemon that flies one session after the other for half an hour: does it leak, lose or tire?

Memory and open files of each process after every session, and the line through them; rows that the
loop wrote and that are missing in any log; processes that had to be started anew. --quick takes a
minute, in which memory can be seen to jump but not to creep.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from levid.benchmarks.harness import table
from levid.benchmarks.harness.flown_rows import Flown, Found, compare
from levid.benchmarks.harness.real_time import Rights
from levid.benchmarks.harness.running_daemon import Daemon, running
from levid.benchmarks.harness.table import Figure, Met, Target
from levid.benchmarks.harness.trend import trend
from levid.config.shipped import shipped
from levid.daemon.client import Client, DaemonError
from levid.log.errors import LogError

SESSION = """
levid: session
name: soak
excitations: {{psi: {{input: psi, rms_n_m: 0.05}}}}
steps:
  - levitate: {{unload_s: 0.3, ramp_s: 1.0, settle_s: 0.5, check_coils: {{}}}}
  - move: {{beam_m: 0.02, settle_s: 0.2}}
  - record: {{name: tilt, duration_s: {record_s}, settle_s: 0.2, excite: [psi]}}
  - move: {{beam_m: 0.0, settle_s: 0.2}}
  - land: {{ramp_s: 0.5, release_s: 0.3}}
"""
PROCESSES = ("supervisor", "loop", "recorder")
MOST_MB_H = 1.0
"""At that a month takes 0.7 GB, which the small computer of a rig may still have."""
MOST_GROWN_MB = 1.0
"""Less than the rows of one short session, were they kept: 5 s at 1 kHz of 273 bytes."""
_SETTLED = 2
"""Sessions that fill caches: memory is looked at after them."""
_LEAST_H = 0.4
"""What a trend has to rest on: pages come and go, 0.1 MB at a time."""


@dataclass(frozen=True)
class Size:
    """Memory of a process's own in MB, and its open files."""

    mb: float
    files: int

    @classmethod
    def of(cls, pid: int) -> Size:
        """Return what a process holds; what it shares with others is not counted."""
        text = Path(f"/proc/{pid}/smaps_rollup").read_text()
        own = ("Anonymous:", "Swap:")
        kib = sum(int(line.split()[1]) for line in text.splitlines() if line.startswith(own))
        return cls(kib / 1024, len(list(Path(f"/proc/{pid}/fd").iterdir())))


@dataclass
class Soak:
    """What came of all sessions: sizes of each process after each of them, when in h, and rows."""

    at_h: list[float] = field(default_factory=list)
    sizes: dict[str, list[Size]] = field(default_factory=lambda: {n: [] for n in PROCESSES})
    found: Found = field(default_factory=Found)
    rights: Rights = field(default_factory=lambda: Rights(0, 0.0))
    cleared: int = 0
    restarted: int = 0
    late: int = 0
    failed: str = ""


def measure(quick: bool) -> Iterator[Figure]:
    soak = Soak()
    whole_s, record_s = (60.0, 1.5) if quick else (1800.0, 50.0)
    try:
        fly_sessions(soak, whole_s, record_s)
    except BaseException:
        yield from figures(soak)
        raise
    yield from figures(soak)


def fly_sessions(
    soak: Soak, whole_s: float, record_s: float, service: Mapping[str, Any] | None = None
) -> None:
    """Fly session after session for so long, or until one fails; `service` as in RIG.yaml."""
    with tempfile.TemporaryDirectory() as name:
        file, path = _rig(Path(name), service or {}), Path(name) / "levid.sock"
        try:
            with running(file, path) as daemon:
                soak.rights, soak.cleared = Rights.of(daemon.pids["loop"]), daemon.cleared
                begun_s = time.monotonic()
                while time.monotonic() < begun_s + whole_s:
                    _fly(daemon, soak, Path(name) / f"session-{len(soak.at_h)}", record_s)
                    soak.at_h.append((time.monotonic() - begun_s) / 3600)
        except (DaemonError, LogError, RuntimeError) as error:
            soak.failed = str(error)


def _fly(daemon: Daemon, soak: Soak, out: Path, record_s: float) -> None:
    """Fly a session, hold its logs against what the loop wrote, and look at sizes."""
    flown = Flown(daemon.pids["supervisor"], daemon.rig_file)
    with Client(daemon.socket) as client:
        text = SESSION.format(record_s=record_s)
        result = client.excite(text, out, lambda *_: flown.look())
        flown.wait_until_written()
        status = client.request("status")
    soak.found += compare(flown.cycles, result.logs)
    for log in result.logs:
        log.unlink()
    for process in PROCESSES:
        with contextlib.suppress(FileNotFoundError):  # it is being started anew
            soak.sizes[process].append(Size.of(status["pids"][process]))
    soak.restarted = status["recorder_restarts"]
    soak.late = status["late"]


def figures(soak: Soak) -> list[Figure]:
    """Return what went wrong, and of each process how large it was and whether it grew."""
    none, wrong = Target(most=0), soak.found.wrong - soak.found.missing
    failed = f"sessions that failed {soak.failed}".strip()
    return [
        Figure("sessions", len(soak.at_h), "", "sessions flown"),
        Figure("failed", int(bool(soak.failed)), "", failed, target=none),
        Figure("missing_rows", soak.found.missing, "", "flown rows in no log", target=none),
        Figure("wrong_rows", wrong, "", "twice, strange, cut logs", target=none),
        Figure("late", soak.late, "", "late cycles"),
        Figure("restarted", soak.restarted, "", "recorders started anew", target=none),
        Figure("cleared", soak.cleared, "", "faults of its start that were cleared", target=none),
        Figure("loop_priority", soak.rights.priority, "", "the loop's priority, 0: none"),
        Figure("loop_locked_mb", soak.rights.locked_mb, "MB", "the loop's memory that is locked"),
        *(figure for name in PROCESSES for figure in _sizes(name, soak)),
    ]


def _sizes(process: str, soak: Soak) -> list[Figure]:
    """Return the figures of a process, none before it has settled."""
    sizes, at_h = soak.sizes[process][_SETTLED:], soak.at_h[_SETTLED:]
    if len(sizes) < 2 or len(sizes) != len(at_h):
        return []
    mb = [size.mb for size in sizes]
    found = trend(at_h, mb)
    long = at_h[-1] - at_h[0] >= _LEAST_H
    no_longer = Target(most=MOST_MB_H, met=None if long else Met.NOT_ASKED)
    short = Target(most=MOST_GROWN_MB, met=Met.NOT_ASKED if long else None)
    files = max(size.files for size in sizes) - sizes[0].files
    return [
        Figure(f"{process}_mb", mb[-1], "MB", f"{process}: memory of its own at the end"),
        Figure(
            f"{process}_grown_mb", max(mb) - mb[0], "MB", "more at most than after two sessions",
            None, short,
        ),
        Figure(f"{process}_mb_h", found and found.slope, "MB/h", "slope of the line through all"),
        Figure(f"{process}_mb_h_error", found and found.error, "MB/h", "its standard error"),
        Figure(
            f"{process}_mb_h_95", found and found.most, "MB/h", "its upper 95 % bound", None,
            no_longer,
        ),
        Figure(f"{process}_files", files, "", "more open files", target=Target(most=0)),
    ]  # fmt: skip


def _rig(folder: Path, service: Mapping[str, Any]) -> Path:
    """Write a rig at 1 kHz, whose limits leave a machine its stalls; return its file."""
    plain = yaml.safe_load(shipped("rigs/loopback.yaml").read_text())
    plain |= {
        "model": str(shipped("models/rig.yaml")),
        "sim": str(shipped("sims/nominal.yaml")),
        "socket": str(folder / "levid.sock"),
        "recording": {"faults": str(folder / "faults")},
        "service": dict(service),
    }
    plain["limits"] |= {"late_cycles": 1000, "late_in_window": 100_000, "stall_s": 5}
    (folder / "rig.yaml").write_text(yaml.safe_dump(plain))
    return folder / "rig.yaml"


if __name__ == "__main__":
    table.run("Soak", measure)
