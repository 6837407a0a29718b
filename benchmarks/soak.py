"""A daemon that flies one session after the other for half an hour: does it leak, lose or tire?

Memory and open files of each process after the first session and after the last, rows that are
missing in any log, and recorders that had to be started anew. --quick takes a minute.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from pathlib import Path

import _table
import yaml
from _daemon import missing_rows, running
from _table import Figure

from levid.config.shipped import shipped
from levid.daemon.client import Client

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
_PROCESSES = ("supervisor", "loop", "recorder")


def measure(quick: bool) -> list[Figure]:
    whole_s, record_s = (60.0, 3.0) if quick else (1800.0, 50.0)
    missing = sessions = 0
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        path = Path(name) / "levid.sock"
        first_pids = stack.enter_context(running(_rig(Path(name)), path))
        ends_s = time.monotonic() + whole_s
        text = SESSION.format(record_s=record_s)
        before: dict[str, tuple[float, int]] = {}
        while time.monotonic() < ends_s:
            sessions += 1
            out = Path(name) / f"session-{sessions}"
            with Client(path) as client:
                result = client.excite(text, out, lambda *_: None)
                status = client.request("status")
            missing += result.lost + missing_rows(result.logs)
            for log in result.logs:
                log.unlink()
            if sessions == 2:  # the first one fills caches
                before = {n: _size(status["pids"][n]) for n in _PROCESSES}
        after = {n: _size(status["pids"][n]) for n in _PROCESSES}
    restarted = sum(status["pids"][n] != first_pids[n] for n in _PROCESSES)
    figures = [
        Figure("sessions", sessions, "", "sessions flown"),
        Figure("missing_rows", missing, "", "rows that are in no log"),
        Figure("late", status["late"], "", "late cycles"),
        Figure("restarted", restarted, "", "processes that are not the first ones"),
    ]
    for process in _PROCESSES:
        grown = after[process][0] - before[process][0]
        files = after[process][1] - before[process][1]
        figures += [
            Figure(f"{process}_mb", after[process][0], "MB", f"{process}: memory at the end"),
            Figure(f"{process}_grown_mb", grown, "MB", f"{process}: more than after two sessions"),
            Figure(f"{process}_files", files, "", f"{process}: more open files"),
        ]
    return figures


def _rig(folder: Path) -> Path:
    """Write a rig at 1 kHz; return its file."""
    plain = yaml.safe_load(shipped("rigs/loopback.yaml").read_text())
    plain |= {
        "sim": str(shipped("sims/nominal.yaml")),
        "socket": str(folder / "levid.sock"),
        "recording": {"faults": str(folder / "faults")},
    }
    plain["limits"] |= {"late_cycles": 1000, "late_in_window": 100_000, "stall_s": 5}
    (folder / "rig.yaml").write_text(yaml.safe_dump(plain))
    return folder / "rig.yaml"


def _size(pid: int) -> tuple[float, int]:
    """Return memory of its own in MB, and open files."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    private = sum(int(line.split()[1]) for line in text.splitlines() if line.startswith("Private_"))
    return private / 1024, len(list(Path(f"/proc/{pid}/fd").iterdir()))


if __name__ == "__main__":
    _table.run("Soak", measure)
