"""Does a session flown over a bus in real time give the P that loopback gives?

The declared model is fitted to each; all its parameters together are compared, within the
confidence of both. Electronics run in a process of their own.
"""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import _real_time
import numpy as np
from _table import Figure
from scipy.stats import chi2

from levid.config.base import parse_text
from levid.config.model import load_model
from levid.config.rig import RigConfig, load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.daemon.clock import Clock, RealClock, VirtualClock
from levid.daemon.flight import Flight, attachments
from levid.daemon.plan import plan_session
from levid.drivers.base import DriverError
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
  stall_s: 1
"""
"""A machine under load may stall as it likes: what is asked is what its logs are worth."""
_GIVE_UP_S = 30.0

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
            logs = _flown(file, Path(text) / name, start if name != "loopback" else None, seconds)
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
                    f"{name}_m_p_se",
                    _off(fits["loopback"], fits[name], "m_p"),
                    "SE",
                    f"{name}: m_p off loopback's",
                ),
            ]
    return figures


def _flown(file: Path, out: Path, start: Start | None, seconds: float) -> Sequence[Log]:
    rig = load_rig(file)
    out.mkdir()
    if start is None:
        return _fly(rig, file, out, VirtualClock(), seconds)
    process = start(file)
    try:
        return _fly(rig, file, out, RealClock(1.0 / rig.rate_hz), seconds, process.pid)
    finally:
        _real_time.relax()
        process.terminate()
        process.wait()


def _fly(
    rig: RigConfig, file: Path, out: Path, clock: Clock, seconds: float, pid: int | None = None
) -> Sequence[Log]:
    text = SESSION.replace("SECONDS", f"{seconds:g}")
    session = parse_text(text, SessionConfig, "agreement")
    give_up_s = time.monotonic() + _GIVE_UP_S
    while True:
        try:
            flight = Flight(rig, file.parent, rig.rate_hz, clock)
            break
        except DriverError:  # the electronics are just being started
            if time.monotonic() > give_up_s:
                raise
            time.sleep(0.2)
    if pid is not None:
        _real_time.hurry(_real_time.ELECTRONICS, pid)
    with flight:
        if pid is not None:
            _real_time.hurry(_real_time.LOOP)
        for _ in range(5):  # amplifiers are enabled while zero force is asked for
            flight.idle(60)
        plan = plan_session(session, rig, flight.beam_m, flight.rotor_rad)
        result = flight.fly(plan, out, attachments(file.read_bytes(), text.encode()))
    return [read_log(path) for path in result.records]


def _distance(one: Fit, other: Fit) -> tuple[float, int, float]:
    """Return chi2 of the difference, of how many parameters, and the largest in its own SE."""
    names = [name for name in one.free if name in other.free]
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
