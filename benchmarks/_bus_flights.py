"""Does a session flown over a bus in real time give the P that loopback gives?

The declared model is fitted to each, delay and all; what is compared, within the confidence of
both, are all other parameters together, for the delay is the backend's own and told apart.
Electronics run in a process of their own.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import _real_time
import numpy as np
from _daemon import running
from _table import Figure
from scipy.stats import chi2

from levid.config.base import parse_text
from levid.config.model import load_model
from levid.config.rig import load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.daemon.client import Client, DaemonError
from levid.daemon.virtual import fly_virtually
from levid.identification.greybox.experiment import experiment_from_log
from levid.identification.greybox.fit import Fit, fit_model
from levid.log.reader import Log, read_log

SESSION = """
levid: session
name: agreement
excitations:
  psi: {input: psi, rms_n_m: 0.1}
  theta: {input: theta, rms_n_m: 0.1}
  z: {input: z, rms_n: 1.3}
steps:
  - levitate: {}
  - move: {beam_m: 0.05}
  - record: {name: psi, duration_s: SECONDS, excite: [psi]}
  - record: {name: theta, duration_s: SECONDS, excite: [theta]}
  - record: {name: z, duration_s: SECONDS, excite: [z]}
  - land: {}
"""
PATIENT = """
  late_cycles: 10000
  late_in_window: 100000
  stall_s: 1
"""
"""A machine under load may stall as it likes: what is asked is what its logs are worth."""
SERVICE = """
service: {loop_s: 10, supervisor_s: 10}
"""
DELAY = "delay"
"""The parameter of models/rig.yaml that holds a backend's own delay."""
_ATTEMPTS = 3
"""Coils that hold their force through a stall, excitation in it, may push the platform too far."""

Start = Callable[[Path], "subprocess.Popen[bytes]"]


def flight_figures(rigs: dict[str, str], start: Start, seconds: float) -> list[Figure]:
    """Return the figures of the rigs (name to text of RIG.yaml), all but loopback in real time."""
    model = load_model(shipped("models/rig.yaml"))
    figures: list[Figure] = []
    with tempfile.TemporaryDirectory() as text:
        fits: dict[str, Fit] = {}
        for name, rig in rigs.items():
            file = Path(text) / f"{name}.yaml"
            file.write_text(rig.replace("limits:\n", f"limits:{PATIENT}", 1))
            real = start if name != "loopback" else None
            logs, attempts = _flown(file, Path(text) / name, real, seconds)
            if name != "loopback":
                what = "until one ended well" if logs else "of which none ended well"
                label = f"{name}: flights {what}"
                figures.append(Figure(f"{name}_attempts", attempts, "", label))
            if not logs:
                continue
            experiments = [experiment_from_log(log, model) for log in logs]
            fits[name] = fit_model(model, experiments)
            if name == "loopback":
                continue
            rows = [len(e.y) for e in experiments]
            stale = sum(int(np.count_nonzero(log.rows["stale"])) for log in logs)
            skipped = sum(int(log.rows["skipped"].sum()) for log in logs)
            cycles = sum(len(log.rows) for log in logs)
            square, of, worst = _distance(fits["loopback"], fits[name])
            figures += [
                Figure(f"{name}_flown_stale", stale / cycles, "", f"{name}, flown: stale rows"),
                Figure(f"{name}_flown_skipped", skipped / cycles, "", f"{name}: periods skipped"),
                Figure(f"{name}_flown_used", sum(rows) / cycles, "", f"{name}: of the rows, used"),
                Figure(
                    f"{name}_chi2_share",
                    square / float(chi2.ppf(0.99, of)),
                    "",
                    f"{name}: P against loopback's, chi2 over its 99 % quantile ({of} parameters)",
                ),
                Figure(f"{name}_worst_se", worst, "SE", f"{name}: the parameter furthest off"),
                Figure(
                    f"{name}_delay_us",
                    1e6 * (fits[name].values[DELAY] - fits["loopback"].values[DELAY]),
                    "us",
                    f"{name}: its own delay",
                ),
                Figure(
                    f"{name}_m_p_se",
                    _off(fits["loopback"], fits[name], "m_p"),
                    "SE",
                    f"{name}: m_p off loopback's",
                ),
            ]
    return figures


def _flown(file: Path, out: Path, start: Start | None, seconds: float) -> tuple[Sequence[Log], int]:
    """Fly with a daemon against the electronics that `start` starts; without, in virtual time.

    Return the logs, none where no flight ended well, and how many it took: others end in a fault.
    """
    text = SESSION.replace("SECONDS", f"{seconds:g}")
    out.mkdir()
    if start is None:
        session = parse_text(text, SessionConfig, "agreement")
        flown = fly_virtually(load_rig(file), file, session, text.encode(), out)
        return [read_log(path) for path in flown.records], 1
    socket, folder = file.with_suffix(".sock"), str(file.parent / "faults")
    with file.open("a") as rig:
        rig.write(f"{SERVICE}socket: {socket}\nrecording: {{faults: {folder}}}\n")
    for attempt in range(_ATTEMPTS):
        process = start(file)
        try:
            with running(file, socket), Client(socket) as client:
                _real_time.hurry(_real_time.ELECTRONICS, process.pid)
                flown = client.excite(text, out / f"{attempt}", lambda *_: None)
                return [read_log(path) for path in flown.records], attempt + 1
        except DaemonError as error:
            print(f"{file.stem}, flight {attempt + 1} of {_ATTEMPTS}: {error}", file=sys.stderr)
        finally:
            process.terminate()
            process.wait()
    return [], _ATTEMPTS


def _distance(one: Fit, other: Fit) -> tuple[float, int, float]:
    """Return chi2 of the difference, of how many parameters, and the largest in its own SE."""
    names = [name for name in one.free if name in other.free and name != DELAY]
    off = np.array([other.values[name] - one.values[name] for name in names])
    covariance = sum(
        fit.covariance[np.ix_(at, at)]
        for fit in (one, other)
        for at in [[fit.free.index(name) for name in names]]
    )
    worst = float(np.max(np.abs(off) / np.sqrt(np.diag(covariance))))
    return float(off @ np.linalg.solve(covariance, off)), len(names), worst


def _off(one: Fit, other: Fit, name: str) -> float:
    spread = np.hypot(one.standard_errors[name], other.standard_errors[name])
    return float(abs(other.values[name] - one.values[name]) / spread)
