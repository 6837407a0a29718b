"""levid against PySINDy and SysIdentPy: what each finds of an effect that is not in the model.

A plant is flown with an undeclared effect of 20 times the noise floor; the declared model is
refitted to the logs. From there `levid trace` continues by itself. The peers get the generalised
force that the model lacks, as far as it is above the noise, and a library of functions of pose,
velocity and beam through the same filter (sparse_regression.py). Their force law is put into the
model as an effect.

All are judged on a second flight, with other noise and excitation, which none of them used: by the
free-running error, and by the share of the missing force that is left. One flight each: a
difference of some percent means nothing. The peers have no refit of the model, no single coils and
sensors, and no memory. `pip install 'levid[discrepancy]'` installs them.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from levid.benchmarks.harness.benchmark_runner import Figure, Target, run
from levid.benchmarks.harness.inaccurate_model import off_by_a_tenth
from levid.benchmarks.trace.hidden_effect_cases import CASES, UNLISTED, Case
from levid.benchmarks.trace.hidden_effect_flight import fly
from levid.benchmarks.trace.hidden_effect_score import EXPLAINED
from levid.benchmarks.trace.sparse_regression import PEERS, ForceLaw, Library, Sample
from levid.identification.trace.linearised.linearisation_point import WorkingPoint
from levid.identification.trace.records.record_from_log import TraceRecord, split, trace_record
from levid.identification.trace.residual.force_residual import (
    denoised,
    density,
    missing,
    noise_density,
    standing_out,
)
from levid.identification.trace.residual.free_run_error import pooled, record_error
from levid.identification.trace.run_trace import trace
from levid.identification.trace.worker_pool import Alone
from levid.log.reader import read_log
from levid.model.effects.base import Effect, Placed, Quantity, Signals, Term
from levid.model.effects.candidate_effects import all_effects

Array = NDArray[np.float64]

QUICK = ("cubic-z",)
FULL = ("cubic-z", "coulomb-z", "bouc-wen-psi", "eddy-brake")
"""A product, friction without and with memory, and an effect that levid's table lacks."""
TIMES, SEED = 20.0, 77
VELOCITIES = (3, 4, 5)
"""Columns of the regressors (pose, velocity, x_b, v_b, a_b) that friction and drag depend on."""
_EDGE_S = 0.6
"""The filtered force fades at the ends of a record."""
_SAMPLE_HZ = 125.0
_BLOCK_S = 4.0


@dataclass(frozen=True)
class Row:
    """The result of one contender on a plant; nan where it failed or diverged, and `why`.

    error: free-running, over the floor. left: share of the missing force that is still missing.
    """

    who: str
    error: float = math.nan
    left: float = math.nan
    why: str = ""


def measure(quick: bool) -> Iterator[Figure]:
    by_name = {case.name: case for case in CASES + UNLISTED}
    for name in QUICK if quick else FULL:
        for row in compare(by_name[name]):
            print(f"{name}, {row.who}: {row.why or 'no term'}", file=sys.stderr)
            # Effects in levid's table are to be explained.
            asked = row.who == "levid" and by_name[name] in CASES
            target = Target(most=EXPLAINED) if asked else None
            error, left = (x if math.isfinite(x) else None for x in (row.error, 100 * row.left))
            of, label = f"{row.who.lower()}_{name.replace('-', '_')}", f"{name}: {row.who}"
            yield Figure(f"error_over_floor_{of}", error, "x floor", label, target=target)
            yield Figure(f"force_left_{of}", left, "%", f"{label}, of the missing force is left")


def compare(case: Case) -> list[Row]:
    """Return the result of each contender."""
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        effects, config = [case.effect(TIMES)], off_by_a_tenth(SEED)
        logs = fly(effects, SEED, Path(folder) / "first")
        found = trace(logs, config, all_effects, Alone(config), lambda *_: None)
        declared = found.declared
        train, _ = split([trace_record(read_log(path), config) for path in logs])
        held = fly(effects, SEED + 1, Path(folder) / "second")
        judge = Judge(declared, [trace_record(read_log(path), config) for path in held])
        names = ", ".join(p.effect.name for p in found.found.point.placed)
        rows = [judge.row("declared", declared), judge.row("levid", found.found.point, names)]
        sample = sample_of(declared, [along(declared, record) for record in train])
        return rows + [peer(who, fit, sample, judge) for who, fit in PEERS.items()]


@dataclass(frozen=True)
class Along:
    """A record's regressors (N, R), and the missing force (N', n) at `rows`, as far as it shows.

    gain (F, n) at freq_hz (F,): the filter of the force.
    """

    regressors: Array
    rows: slice
    force: Array
    gain: Array
    freq_hz: Array
    time_s: Array
    Ts_s: float

    def filtered(self, columns: Array, dof: int) -> Array:
        """Return columns (N, .) at `rows`, through the filter of a DOF's force."""
        through = (denoised(c, self.gain[:, dof], self.freq_hz, self.Ts_s) for c in columns.T)
        return np.column_stack([c[self.rows] for c in through])


def along(point: WorkingPoint, record: TraceRecord, like: Along | None = None) -> Along:
    """Return what a record's model lacks, through the filter of `like` if there is one."""
    left = missing(point, record)
    Ts_s = record.experiment.Ts_s
    if like is None:
        freq_hz, psd = density(left.force, Ts_s)
        gain = standing_out(psd, noise_density(point, left.here, freq_hz), freq_hz)
    else:
        freq_hz, gain = like.freq_hz, like.gain
    force = np.column_stack(
        [denoised(f, g, freq_hz, Ts_s) for f, g in zip(left.force.T, gain.T, strict=True)]
    )
    # The force is the mean over the period after a row.
    at = regressors(left.here.signals)
    at = 0.5 * (at + np.vstack([at[1:], at[-1:]]))
    edge, every = round(_EDGE_S / Ts_s), max(round(1 / (_SAMPLE_HZ * Ts_s)), 1)
    rows = slice(edge, -edge, every)
    return Along(at, rows, force[rows], gain, freq_hz, record.time_s[rows], Ts_s)


def regressors(s: Signals) -> Array:
    """Return pose, velocity, x_b, v_b and a_b (N, 9)."""
    return np.column_stack([s.q, s.qd, s.x_b_m, s.v_b_m_s, s.a_b_m_s2])


def sample_of(point: WorkingPoint, records: Sequence[Along]) -> Sample:
    """Return all rows: functions of regressors, and forces in units of noise.

    The largest force has size 1: a DOF that lacks nothing but noise then stays small.
    """
    force = np.vstack([r.force for r in records])
    block = np.concatenate([np.floor(r.time_s / _BLOCK_S).astype(np.int64) for r in records])
    scale = np.maximum(np.vstack([r.regressors for r in records]).std(axis=0), 1e-300)
    size = np.sqrt(point.disturbance.noise.force_psd)
    size = size * float(np.max(force.std(axis=0) / size))
    library = Library(scale, VELOCITIES)
    columns = [(r, library.at(r.regressors)) for r in records]
    functions = [
        np.vstack([r.filtered(given, dof) for r, given in columns]) for dof in range(len(size))
    ]
    return Sample(tuple(functions), force / size, library, size, block)


@dataclass(frozen=True)
class Judge:
    """The flight that no contender used: its records, and what the declared model lacks there."""

    declared: WorkingPoint
    held: Sequence[TraceRecord]

    def row(self, who: str, point: WorkingPoint, why: str = "") -> Row:
        """Return how well a model does on this flight."""
        error, floor = pooled([record_error(point, record) for record in self.held])
        # Each force law is removed from the records before one and the same filter.
        known = [along(self.declared, record) for record in self.held]
        rest = [
            along(point, record, like).force for record, like in zip(self.held, known, strict=True)
        ]
        unit = np.sqrt(self.declared.disturbance.noise.force_psd)
        whole = np.vstack([k.force for k in known]) / unit
        left = float(np.sqrt(np.sum((np.vstack(rest) / unit) ** 2) / np.sum(whole**2)))
        return Row(who, error / floor, left, why)


def peer(who: str, fit: Callable[[Sample], ForceLaw], sample: Sample, judge: Judge) -> Row:
    """Return how well a peer's force law does in the model; a peer that fails ends no run."""
    try:
        law = fit(sample)
    except Exception as error:  # noqa: BLE001 - any error of a peer is its result
        return Row(who, why=f"{type(error).__name__}: {error}")
    effect = Effect(
        who, who, "unknown", (), "force = f(q, q', x_b, v_b, a_b)", (Quantity("share", "1"),),
        partial(_term, law=law),
    )  # fmt: skip
    point = replace(judge.declared, placed=(Placed(effect, (), (1.0,)),))
    return judge.row(who, point, f"{law.terms} terms")


def _term(signals: Signals, _shape: Sequence[float], *, law: ForceLaw) -> list[Term]:
    return [Term(force=law.at(regressors(signals)))]


if __name__ == "__main__":
    run("levid against sparse regression", measure)
