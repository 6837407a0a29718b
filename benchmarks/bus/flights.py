"""The paper's session flown over each bus in real time: punctuality, rows, and the P it gives.

The whole daemon flies, control and recording included, electronics in a process of their own. P is
compared with what the same session gives on loopback in virtual time, with other noise and other
excitation (_bus_agreement). Loopback itself is flown against that as well: what no bus has a part
in. --quick flies one beam position for a short time, which shows that it can be done and no more.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from levid.benchmarks.bus.bus_rigs import LABELS, TIMED, electronics_on, rig_text
from levid.benchmarks.bus.plant_agreement import Plants, agreement_figures, difference
from levid.benchmarks.harness import real_time
from levid.benchmarks.harness.kept_results import Parts
from levid.benchmarks.harness.running_daemon import running
from levid.benchmarks.harness.table import Figure, Target
from levid.benchmarks.harness.virtual_flight import fly_session
from levid.config.base import read_mapping
from levid.config.shipped import shipped
from levid.daemon.client import Client, DaemonError
from levid.identification.records.record import IdentificationError
from levid.log.errors import LogError
from levid.log.reader import Log, read_log

SESSION = shipped("sessions/white-noise-1khz.yaml")
SEED = 1000
"""Of the reference's noise and excitation: far from the session's own and the simulator's."""
PATIENT = """
  late_cycles: 10000
  late_in_window: 100000
  stall_s: 1
"""
"""A machine under load may stall as it likes: what is asked is what its logs are worth."""
SERVICE = """
service: {loop_s: 10, supervisor_s: 10}
"""
_ONE = Target(least=1)
_ATTEMPTS = 3
"""Coils that hold their force through a stall, excitation in it, may push the platform too far."""
_QUICK_S = 10.0


def flight_figures(quick: bool, kept: Parts) -> list[Figure]:
    """Return the figures of loopback and of each bus, a flight kept as soon as it is done."""
    text, segment_s = (_short(), 2.0) if quick else (SESSION.read_text(), 10.0)
    with tempfile.TemporaryDirectory() as folder:
        logs = fly_session({**yaml.safe_load(text), "seed": SEED}, Path(folder) / "reference")
        reference = Plants.of(logs, segment_s)
    found: list[Figure] = []
    for name in ("loopback", *TIMED):
        plain = kept.part(
            f"flight {name}",
            lambda name=name: [f.plain for f in _of_one(name, text, reference, segment_s)],
        )
        found += map(Figure.of, plain)
    return found


def _of_one(name: str, text: str, reference: Plants, segment_s: float) -> list[Figure]:
    who = f"{LABELS[name]}, flown"
    with tempfile.TemporaryDirectory() as folder:
        if name == "loopback":
            logs, ended_by = fly_session(yaml.safe_load(text), Path(folder) / "out"), []
        else:
            logs, ended_by = flown(name, Path(folder), text)
        what = "until one ended well" if logs else "of which none ended well"
        figures = [
            Figure(f"{name}_attempts", len(ended_by) + bool(logs), "", f"{who}: flights {what}"),
            *(
                Figure(f"{name}_ended_by_{fault}", count, "", f"{who}: ended by {fault}")
                for fault, count in sorted(Counter(ended_by).items())
            ),
        ]
        found = f"{name}_identified"
        if not logs:
            return [*figures, Figure(found, 0, "", f"{who}: no flight", target=_ONE)]
        read = [read_log(path) for path in logs]
        if name != "loopback":  # in virtual time nothing is late
            figures += punctuality_figures(name, who, read)
        try:
            plants = Plants.of(logs, segment_s)
        except IdentificationError as error:
            return [*figures, Figure(found, 0, "", f"{who}: {error}", target=_ONE)]
        rows = sum(len(log.rows) for log in read)
        return [
            *figures,
            Figure(found, 1, "", f"{who}: P was identified", target=_ONE),
            Figure(f"{name}_flown_used", plants.rows / rows, "", f"{who}: of the rows, used"),
            *agreement_figures(name, who, difference(plants, reference)),
        ]


def punctuality_figures(name: str, who: str, logs: Sequence[Log]) -> list[Figure]:
    """Return how many cycles of the records were late, by both definitions, skipped or stale."""
    rows = np.concatenate([log.rows for log in logs])
    period_s = 1.0 / logs[0].rate_hz
    ended = rows["lateness_s"] + rows["execution_s"] >= period_s
    shares = {
        "begun_late": (rows["skipped"] > 0, "begins a period late or more"),
        "ended_late": (ended, "has not ended a period after its time"),
        "stale": (rows["stale"] > 0, "with a stale reading"),
    }
    return [
        Figure(f"{name}_flown_cycles", len(rows), "", f"{who}: cycles in {len(logs)} records"),
        *(
            Figure(f"{name}_flown_{key}_share", float(np.mean(which)), "", f"{who}: {what}")
            for key, (which, what) in shares.items()
        ),
        Figure(f"{name}_flown_skipped", int(rows["skipped"].sum()), "", f"{who}: periods skipped"),
    ]


def flown(name: str, folder: Path, text: str) -> tuple[tuple[Path, ...], list[str]]:
    """Fly with a daemon, electronics apart; return the records' logs and what ended others.

    No logs where no flight of _ATTEMPTS ended well.
    """
    file, socket = folder / "rig.yaml", folder / "levid.sock"
    rig = rig_text(name, folder).replace("limits:\n", f"limits:{PATIENT}", 1)
    faults = f"recording: {{faults: {folder / 'faults'}}}\n"
    file.write_text(f"{rig}{SERVICE}socket: {socket}\n{faults}")
    ended_by: list[str] = []
    for attempt in range(_ATTEMPTS):
        try:
            with (
                electronics_on(file) as electronics,
                running(file, socket),
                Client(socket) as client,
            ):
                real_time.hurry(real_time.ELECTRONICS, electronics.pid)
                done = client.excite(text, folder / f"{attempt}", lambda *_: None)
            for path in done.records:
                _require_whole(path)
        except (DaemonError, LogError, OSError, subprocess.SubprocessError) as error:
            ended_by.append(_name_of(str(error)))
            why = str(error)
        except SystemExit as error:
            if not isinstance(error.code, str):  # somebody ends this benchmark
                raise
            ended_by.append("NOT_IDLE")
            why = error.code
        else:
            return done.records, ended_by
        print(f"{name}, flight {attempt + 1} of {_ATTEMPTS}: {why}", file=sys.stderr)
    return (), ended_by


def _require_whole(path: Path) -> None:
    log = read_log(path)
    if not log.complete:
        raise LogError(f"{path.name}: {log.problem}")


def _name_of(words: str) -> str:
    """Return the fault that an error of the daemon names, else its words as a key."""
    found = re.search(r"fault (\w+)", words)
    return found[1] if found else re.sub(r"\W+", "_", words)[:40]


def _short() -> str:
    """Return the session with the middle position alone, and short records."""
    plain: dict[str, Any] = dict(read_mapping(SESSION))
    steps = []
    for step in plain["steps"]:
        record = step.get("record")
        if record is not None and record["name"].startswith("middle-"):
            steps.append({"record": {**record, "duration_s": _QUICK_S}})
    plain["steps"] = [{"levitate": {}}, *steps, {"land": {}}]
    return yaml.safe_dump(plain, sort_keys=False)
