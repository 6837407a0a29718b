"""Reduce a session's logs to the data of figures and tables, one log at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...config.base import ConfigError, parse_text
from ...config.rig import RigConfig
from ...daemon.control.faults import FAULTS, Fault
from ...daemon.control.states import State
from ...log.log_facts import versions
from ...log.reader import Log, read_log
from ..plotting.min_max_bins import MOST_BINS
from ..plotting.min_max_envelope import Envelope, envelope, over_time
from .event_windows import event_windows
from .pose_during_beam_moves import BeamRecord, joined

Array = NDArray[np.float64]

_FINE_BINS = 1024
_EVENT_ROWS = 6_000
"""Rows of all logs around events that charts show sample by sample."""
_COILS = "coil_excitation_n"
_BEAM_STILL_M = 1e-3
"""Range below which the beam counts as still if something else moves."""
_LATENESS_EDGES_S = np.concatenate([[0.0], np.geomspace(1e-7, 1.0, 71)])


@dataclass(frozen=True)
class Span:
    """A time span in one state of the loop; state is None if the log has no states."""

    state: State | None
    start_s: float
    end_s: float


@dataclass(frozen=True)
class StepFlown:
    """One log: its step of the session and a summary of the flight in it.

    Levels, peak and beam are those of the working states (exciting, moving), or of the whole log
    without these: peak_gap_m is the largest height at any sensor, beam_m the beam's position at
    begin and end and its extremes. saturated counts cycles with a coil at a limit, skipped the
    skipped periods.
    """

    path: Path
    kind: str
    name: str
    start_s: float
    end_s: float
    rows: int
    excited: tuple[str, ...]
    excitation_rms: tuple[float, ...]
    beam_m: tuple[float, float, float, float] | None
    peak_gap_m: float | None
    saturated: int
    skipped: int
    faults: tuple[Fault, ...]
    problem: str | None

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks on the log: truncated, skipped periods, saturation, ..."""
        words = []
        if self.saturated:
            words.append(f"a coil at its limit in {self.saturated} cycles")
        if self.skipped:
            words.append(f"{self.skipped} periods skipped")
        words += [f"fault {f.name}: {FAULTS[f].cause}" for f in self.faults]
        if self.problem:
            words.append(f"incomplete: {self.problem}")
        return tuple(words)


@dataclass(frozen=True)
class CycleTimes:
    """Histograms of lateness and execution time over bins `edges_s` (B + 1,): counts (B,)."""

    edges_s: Array
    lateness: NDArray[np.int64]
    execution: NDArray[np.int64]
    period_s: float


@dataclass(frozen=True)
class Session:
    """A flown session: steps, signals over the plant's continuous time, states.

    gap_limit_m is the rig's limit of sensor readings in flight, None without a rig in the logs.
    signals are envelopes by the log's field name ('coil_n': over all coils). beam_records are the
    records in which only the beam moved, by name. timing is None in virtual time, where lateness
    and execution time are logged as 0.
    """

    name: str
    rate_hz: float
    versions: dict[str, str]
    steps: tuple[StepFlown, ...]
    spans: tuple[Span, ...]
    signals: dict[str, Envelope]
    beam_records: dict[str, BeamRecord]
    timing: CycleTimes | None
    gap_limit_m: float | None = None

    @property
    def duration_s(self) -> float:
        """Time from the first to the last row."""
        return self.steps[-1].end_s - self.steps[0].start_s


DRAWN = (
    *("psi_rad", "theta_rad", "z_m", "beam_m", "beam_ref_m", "coil_n"),
    *("v_psi_n_m", "v_theta_n_m", "v_z_n", "coil_excitation_n"),
)
"""Fields of the log that the time plots show."""


def read_session(paths: Sequence[Path], bins: int = 700) -> Session:
    """Read the logs of one session in order of time; reduce each before reading the next.

    Raises:
        LogError: a log cannot be read.
        ValueError: no log was given.
    """
    if not paths:
        raise ValueError("expected at least one log of the session, found none")
    sizes = [path.stat().st_size if path.exists() else 0 for path in paths]
    share = [max(int(MOST_BINS * size / max(sum(sizes), 1)), _FINE_BINS) for size in sizes]
    events = _EVENT_ROWS // len(paths)
    parts = [_reduced(read_log(p), most, events) for p, most in zip(paths, share, strict=True)]
    return _assembled(parts, bins)


@dataclass(frozen=True)
class _Part:
    """One log, reduced."""

    session: str
    rate_hz: float
    versions: dict[str, str]
    step: StepFlown
    spans: list[Span]
    signals: dict[str, Envelope]
    beam: BeamRecord | None
    gap_limit_m: float | None
    lateness: NDArray[np.int64] = field(repr=False)
    execution: NDArray[np.int64] = field(repr=False)
    timed: bool


def _assembled(parts: list[_Part], bins: int) -> Session:
    parts = sorted(parts, key=lambda part: part.step.start_s)
    first = parts[0]
    names = [name for name in DRAWN if any(name in part.signals for part in parts)]
    signals = {
        name: over_time([p.signals[name] for p in parts if name in p.signals], bins)
        for name in names
    }
    timing = None
    if any(part.timed for part in parts):
        timing = CycleTimes(
            _LATENESS_EDGES_S,
            np.sum([p.lateness for p in parts], axis=0),
            np.sum([p.execution for p in parts], axis=0),
            1.0 / first.rate_hz,
        )
    return Session(
        first.session,
        first.rate_hz,
        first.versions,
        tuple(part.step for part in parts),
        tuple(_merged([span for part in parts for span in part.spans])),
        signals,
        _beam_records(parts),
        timing,
        first.gap_limit_m,
    )


def _beam_records(parts: Sequence[_Part]) -> dict[str, BeamRecord]:
    """Return the records with a moving beam by name; parts of a rotated log are joined."""
    found: dict[str, list[BeamRecord]] = {}
    for part in parts:
        if part.beam is not None:
            found.setdefault(part.step.name, []).append(part.beam)
    return {name: joined(records) for name, records in found.items()}


def _gap_limit(log: Log) -> float | None:
    text = log.attachments.get("rig.yaml")
    if text is None:
        return None
    try:
        return parse_text(text, RigConfig, "rig.yaml").limits.gap_m
    except ConfigError:  # the identification reports it
        return None


def _reduced(log: Log, most_bins: int, event_rows: int) -> _Part:
    """Reduce a log; charts get its signals in at most `most_bins` bins, and rows around events."""
    names = log.rows.dtype.names or ()
    t = np.asarray(log.rows["time_s"], float) if "time_s" in names else _counted(log)
    keep = event_windows(log.rows, log.rate_hz, event_rows)
    signals = {
        name: envelope(t, log.rows[name], _FINE_BINS, most=most_bins, keep=keep)
        for name in DRAWN
        if name in names
    }
    step = _step(log, t)
    lateness, execution = (_column(log, n) for n in ("lateness_s", "execution_s"))
    return _Part(
        session=log.metadata.get("session", log.path.stem),
        rate_hz=log.rate_hz,
        versions=versions(log.attachments),
        step=step,
        spans=_spans(log, t),
        signals=signals,
        beam=_beam_record(log, t, step),
        gap_limit_m=_gap_limit(log),
        lateness=np.histogram(lateness, _LATENESS_EDGES_S)[0],
        execution=np.histogram(execution, _LATENESS_EDGES_S)[0],
        timed=bool(np.any(lateness) or np.any(execution)),
    )


def _step(log: Log, t: Array) -> StepFlown:
    names = log.rows.dtype.names or ()
    working = np.isin(_column(log, "state"), [State.EXCITING, State.MOVING])
    if not working.any():
        working[:] = True
    inputs = [n for n in names if n.startswith("v_")]
    levels = {n: _rms(log.rows[n][working]) for n in inputs}
    if _COILS in names:
        coils = np.asarray(log.rows[_COILS], float)[working]
        levels |= {f"coil:{c}": _rms(column) for c, column in enumerate(np.atleast_2d(coils.T))}
    excited = tuple(n for n, level in levels.items() if level > 0)
    beam, peak = None, None
    if "beam_m" in names:
        x = _finite(log.rows["beam_m"][working])
        if x.size:
            beam = (float(x[0]), float(x[-1]), float(np.min(x)), float(np.max(x)))
    if "gap_m" in names:
        gaps = _finite(log.rows["gap_m"][working])
        peak = float(np.max(np.abs(gaps))) if gaps.size else None
    return StepFlown(
        path=log.path,
        kind=log.metadata.get("kind", "record"),
        name=log.metadata.get("name", log.path.stem),
        start_s=float(t[0]),
        end_s=float(t[-1]),
        rows=len(t),
        excited=excited,
        excitation_rms=tuple(levels[n] for n in excited),
        beam_m=beam,
        peak_gap_m=peak,
        saturated=int(np.count_nonzero(_column(log, "saturated"))),
        skipped=int(_column(log, "skipped").sum(dtype=np.int64)),
        faults=tuple(Fault(code) for code in np.unique(_column(log, "fault")) if code in _FAULTS),
        problem=log.problem,
    )


def _beam_record(log: Log, t: Array, step: StepFlown) -> BeamRecord | None:
    moving = _column(log, "state") == State.MOVING
    needed = {"beam_m", "theta_rad", "z_m"}
    if step.kind != "record" or step.excited or not needed <= set(log.rows.dtype.names or ()):
        return None
    # A turning rotor is also a motion, but does not show the beam's weight.
    if not moving.any() or np.ptp(_finite(_column(log, "beam_m")[moving])) < _BEAM_STILL_M:
        return None
    beam, theta, z, reference = (
        np.asarray(_column(log, n)[moving], float)
        for n in ("beam_m", "theta_rad", "z_m", "beam_ref_m")
    )
    return BeamRecord(t[moving], beam, theta, z, reference if np.any(reference) else None)


def _rms(x: NDArray[np.floating]) -> float:
    known = _finite(x)
    return float(np.sqrt(np.mean(np.square(known)))) if known.size else 0.0


def _finite(x: NDArray[np.floating]) -> Array:
    return np.asarray(x[np.isfinite(x)], float)


def _spans(log: Log, t: Array) -> list[Span]:
    if "state" not in (log.rows.dtype.names or ()):
        return [Span(None, float(t[0]), float(t[-1]))]
    state = log.rows["state"]
    starts = np.concatenate([[0], np.flatnonzero(np.diff(state)) + 1])
    ends = np.append(starts[1:], len(t) - 1)
    known = {int(s) for s in State}
    return [
        Span(State(int(state[a])) if int(state[a]) in known else None, float(t[a]), float(t[b]))
        for a, b in zip(starts, ends, strict=True)
    ]


def _merged(spans: list[Span]) -> list[Span]:
    out: list[Span] = []
    for span in spans:
        if out and out[-1].state == span.state:
            out[-1] = Span(span.state, out[-1].start_s, span.end_s)
        else:
            out.append(span)
    return out


def _column(log: Log, name: str) -> NDArray[Any]:
    """Return a field, or zeros if the log does not have it."""
    if name in (log.rows.dtype.names or ()):
        return np.asarray(log.rows[name])
    return np.zeros(len(log.rows))


def _counted(log: Log) -> Array:
    return np.arange(len(log.rows)) / log.rate_hz


_FAULTS = {int(fault) for fault in Fault if fault != Fault.NONE}
