"""levid against PySINDy and SysIdentPy: what each makes of what a declared model lacks.

A plant is flown with an effect that nobody declared, 20 times the noise floor; the declared model
is refitted to the logs. From there levid goes its way (levid trace), while the others get the
generalised force that the model lacks along the records that levid fits to, freed of noise as far
as it stands out of it, and a library of functions at the same times and through the same filter:
the products up to the third power of pose, velocity and the beam's position, velocity and
acceleration, and for each velocity of the pose |v| v and a smooth sign(v). PySINDy makes a sparse
sum of them (sequentially thresholded least squares, the threshold of least error on a fifth of the
data), SysIdentPy takes them one by one by error reduction ratio (FROLS, as many as BIC allows).
Their force is put into the model as an effect. Everyone is judged on another flight of the plant,
with other noise and another excitation, that nobody has seen: by the free-running error, and by how
much of the missing force is left. Each plant is one flight and one to judge by: a lead of some
percent is none.

The others are not to blame for what they are not asked for here: they have no refit of the model
beside, no single coils and sensors, and no memory, since the law that is put into the model is one
of the present row. `pip install pysindy sysidentpy` brings them.
"""

from __future__ import annotations

import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.table import Table
from threadpoolctl import threadpool_limits

from levid.benchmarks.harness.declared_model import off_by_a_tenth
from levid.benchmarks.harness.table import Figure, Target, parser, show
from levid.benchmarks.trace.discrepancy_peers import PEERS, ForceLaw, Library, Sample, load
from levid.benchmarks.trace.zoo_cases import CASES, UNLISTED, ZooCase
from levid.benchmarks.trace.zoo_fly import fly
from levid.benchmarks.trace.zoo_sizes import Sizes, sizes_of
from levid.identification.trace.linearised.working_point import WorkingPoint
from levid.identification.trace.records.trace_record import TraceRecord, split, trace_record
from levid.identification.trace.residual.error_metric import pooled, record_error
from levid.identification.trace.residual.force_residual import (
    Missing,
    denoised,
    density,
    missing,
    noise_density,
    standing_out,
)
from levid.identification.trace.study import Trace, trace
from levid.identification.trace.worker_pool import Alone
from levid.log.reader import read_log
from levid.model.effects.base import Effect, Placed, Quantity, Signals, Term
from levid.model.effects.table import all_effects

Array = NDArray[np.float64]

QUICK = ("cubic-z",)
FULL = ("cubic-z", "coulomb-z", "bouc-wen-psi", "eddy-brake")
"""What products describe, friction without and with memory, and an effect that levid has not."""
LISTED = frozenset(case.name for case in CASES)
EXPLAINED = Target(most=1.15)
"""Error over the floor of a model that explains the records."""
TIMES = 20.0
SEED = 77
REGRESSORS = ("psi", "theta", "z", "psi'", "theta'", "z'", "x_b", "v_b", "a_b")
VELOCITIES = (3, 4, 5)
"""Those of the pose, which friction and drag are laws of."""
_EDGE_S = 0.6
"""The missing force fades at the ends of a record."""
_SAMPLE_HZ = 125.0
_BLOCK_S = 4.0


@dataclass(frozen=True)
class Row:
    """What one contender makes of a plant.

    error, floor: free-running, in noise deviations; `left`: share of the missing force that is
    still missing; `seconds` of processor time from the refitted declared model on. What a peer is
    given, levid has prepared for all of them in `prepared` seconds before that. `failed`: there is
    nothing of it, and `what` says why.
    """

    case: str
    who: str
    error: float
    floor: float
    left: float
    seconds: float
    what: str
    failed: bool = False
    prepared: float = math.nan

    @property
    def diverged(self) -> bool:
        """Whether the model ran away on records that nobody fitted."""
        return not self.failed and not math.isfinite(self.error)


def main() -> None:
    arguments = parser("levid against PySINDy and SysIdentPy; --quick: one plant").parse_args()
    rows: list[Row] = []

    def measure() -> Iterator[Figure]:
        by_name = {case.name: case for case in CASES + UNLISTED}
        cases = [by_name[name] for name in (QUICK if arguments.quick else FULL)]
        sizes = sizes_of(cases, 2, lambda text: print(text, file=sys.stderr))
        for case in cases:
            found = compare(case, sizes[case.name])
            rows.extend(found)
            yield from told(found)

    show("levid against the best of the others", arguments, measure, lambda: [table(rows)])


def compare(case: ZooCase, sizes: Sizes) -> list[Row]:
    """Return what levid and the others make of a plant with this effect."""
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        effects = [case.effect(sizes.scale(TIMES))]
        seen, unseen = Path(folder) / "seen", Path(folder) / "unseen"
        for there in (seen, unseen):
            there.mkdir()
        logs, _ = fly(effects, SEED, seen)
        config = off_by_a_tenth(SEED)
        watch = _Watch()
        found = trace(logs, config, all_effects, Alone(config), watch)
        assert math.isfinite(watch.refitted), "trace did not say when it began to screen"
        seconds = time.process_time() - watch.refitted
        declared, better = found.declared, found.found.point
        train, _ = split([trace_record(read_log(path), config) for path in logs])
        held = [trace_record(read_log(path), config) for path in fly(effects, SEED + 1, unseen)[0]]
        known = [_along(declared, record) for record in held]
        left = _left(declared, better, held, known)
        rows = [
            Row(case.name, "declared", *_error_of(declared, held), 1.0, math.nan, ""),
            Row(case.name, "levid", *_error_of(better, held), left, seconds, _names(found)),
        ]
        begin = time.process_time()
        sample = _sample(declared, [_along(declared, record) for record in train])
        prepared = time.process_time() - begin
        for who, fit in PEERS.items():
            row = _judged(case.name, who, fit, sample, declared, held, known)
            rows.append(replace(row, prepared=prepared))
        return rows


def told(rows: Sequence[Row]) -> list[Figure]:
    """Return all figures of a plant; those that levid is judged by have a label.

    What it knows it is to explain. Where no other has come to an end there is none to compare with.
    """
    numbers, case = figures(rows), rows[0].case
    key = case.replace("-", "_")
    ours = next((row.error for row in rows if row.who == "levid"), math.nan)
    others = [row.error for row in rows if row.who in PEERS and math.isfinite(row.error)]
    ratio = ours / min(others) if others and math.isfinite(ours) else None
    over = f"error_over_floor_levid_{key}"
    target = EXPLAINED if case in LISTED else None
    return [
        Figure(over, numbers.pop(over, None), "x floor", f"{case}: error of levid", target=target),
        Figure(f"levid_over_best_{key}", ratio, "x", f"{case}: levid over the least of the others"),
        *(Figure(name, value, "", "") for name, value in numbers.items()),
    ]


def figures(rows: Sequence[Row]) -> dict[str, float]:
    """Return every number by contender and plant; of one that failed only failed_KEY = 1.

    diverged_KEY = 1 says of a model that it ran away; its error, no number, is left out.
    """
    out: dict[str, float] = {}
    for row in rows:
        key = f"{row.who}_{row.case}".lower().replace("-", "_")
        out[f"failed_{key}"] = float(row.failed)
        if row.failed:
            continue
        out |= {
            f"diverged_{key}": float(row.diverged),
            f"error_{key}": row.error,
            f"error_over_floor_{key}": row.error / row.floor,
            f"force_left_{key}": row.left,
            f"time_{key}_s": row.seconds,
            f"prepared_{key}_s": row.prepared,
        }
    return {key: value for key, value in out.items() if math.isfinite(value)}


def table(rows: Sequence[Row]) -> Table:
    """Return a line for every plant and contender."""
    grid = Table(title="What the declared model lacks", title_justify="left", box=box.SIMPLE)
    for column in ("plant", "who"):
        grid.add_column(column, no_wrap=True)
    for column in ("error", "/ floor", "force left", "s", "prepared, s"):
        grid.add_column(column, justify="right", no_wrap=True)
    grid.add_column("what")
    for row in rows:
        grid.add_row(
            row.case, row.who, _error(row, 1.0), _error(row, row.floor),
            "" if math.isnan(row.left) else f"{100 * row.left:.3g} %",
            "" if math.isnan(row.seconds) else f"{row.seconds:.1f}",
            "" if math.isnan(row.prepared) else f"{row.prepared:.1f}", row.what,
        )  # fmt: skip
    grid.caption = (
        "error: free-running, on a flight that nobody saw, in standard deviations of the sensor "
        "noise; force left: of the missing force there, rms; s: of one processor, from the "
        "refitted model on; prepared: by levid, once for all others, before their own time"
    )
    return grid


class _Watch:
    """Progress that notes when the declared model was refitted."""

    def __init__(self) -> None:
        self.refitted = math.nan

    def __call__(self, what: str, share: float) -> None:  # noqa: ARG002
        if what.startswith("screening") and math.isnan(self.refitted):
            self.refitted = time.process_time()


@dataclass(frozen=True)
class _Along:
    """A record's regressors (N, R), and the force (N', n) missing at `rows`, as far as it is seen.

    gain (F, n) at freq_hz (F,): the filter that let it through.
    """

    regressors: Array
    rows: slice
    force: Array
    gain: Array
    freq_hz: Array
    time_s: Array
    Ts_s: float

    def filtered(self, columns: Array, dof: int) -> Array:
        """Return columns (N, .) at `rows`, as the force on a DOF is let through."""
        through = (denoised(c, self.gain[:, dof], self.freq_hz, self.Ts_s) for c in columns.T)
        return np.column_stack([c[self.rows] for c in through])


def _along(point: WorkingPoint, record: TraceRecord, like: _Along | None = None) -> _Along:
    """Return what is missing of a record, through the filter of `like` if there is one."""
    left: Missing = missing(point, record)
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
    at = _regressors(left.here.signals)
    at = 0.5 * (at + np.vstack([at[1:], at[-1:]]))
    edge, every = round(_EDGE_S / Ts_s), max(round(1 / (_SAMPLE_HZ * Ts_s)), 1)
    rows = slice(edge, -edge, every)
    return _Along(at, rows, force[rows], gain, freq_hz, record.time_s[rows], Ts_s)


def _regressors(s: Signals) -> Array:
    """Return the columns of REGRESSORS (N, 9)."""
    return np.column_stack([s.q, s.qd, s.x_b_m, s.v_b_m_s, s.a_b_m_s2])


def _sample(point: WorkingPoint, records: Sequence[_Along]) -> Sample:
    """Return all rows: functions of regressors, forces in units of noise, the largest of one.

    A DOF in which nothing but noise is missing then stays small.
    """
    force = np.vstack([r.force for r in records])
    block = np.concatenate([np.floor(r.time_s / _BLOCK_S).astype(np.int64) for r in records])
    scale = np.maximum(np.vstack([r.regressors for r in records]).std(axis=0), 1e-300)
    size = np.sqrt(point.disturbance.noise.force_psd)
    size = size * float(np.max(force.std(axis=0) / size))
    library = Library(scale, VELOCITIES)
    filtered: list[list[Array]] = [[] for _ in size]
    for r in records:
        columns = library.at(r.regressors)
        for dof, some in enumerate(filtered):
            some.append(r.filtered(columns, dof))
    return Sample(tuple(map(np.vstack, filtered)), force / size, library, size, block)


def _judged(
    case: str,
    who: str,
    fit: Callable[[Sample], ForceLaw],
    sample: Sample,
    declared: WorkingPoint,
    held: Sequence[TraceRecord],
    known: Sequence[_Along],
) -> Row:
    """Return how well a contender's force does, put into the model."""
    try:
        load(who)  # before the clock starts
        begin = time.process_time()
        force = fit(sample)
    except Exception as error:  # noqa: BLE001 - what one fails at is its row, and the others go on
        nothing, absent = (math.nan,) * 4, isinstance(error, ModuleNotFoundError)
        why = f"{error.name} is not installed" if absent else f"{type(error).__name__}: {error}"
        return Row(case, who, *nothing, why, failed=True)
    seconds = time.process_time() - begin
    point = replace(declared, placed=(_placed(who, force),))
    errors = [record_error(point, record) for record in held]
    error, floor = pooled(errors)
    left = _left(declared, point, held, known)
    unsettled = sum(not e.settled for e in errors)
    what = f"{force.terms} terms" + (f", {unsettled} records do not settle" if unsettled else "")
    return Row(case, who, error, floor, left, seconds, what)


def _error_of(point: WorkingPoint, records: Sequence[TraceRecord]) -> tuple[float, float]:
    return pooled([record_error(point, record) for record in records])


def _placed(who: str, force: ForceLaw) -> Placed:
    places: tuple[str, ...] = ()
    effect = Effect(
        who, who, "unknown", places, "force = f(q, q', x_b, v_b, a_b)", (Quantity("share", "1"),),
        partial(_term, force=force),
    )  # fmt: skip
    return Placed(effect, (), (1.0,))


def _term(signals: Signals, _shape: Sequence[float], *, force: ForceLaw) -> list[Term]:
    return [Term(force=force.at(_regressors(signals)))]


def _left(
    declared: WorkingPoint,
    point: WorkingPoint,
    held: Sequence[TraceRecord],
    known: Sequence[_Along],
) -> float:
    """Return the rms of what `point` still lacks over what `declared` does, in units of its noise.

    Whoever's force it is, it is taken out of the records before the filter that `known` passed.
    """
    rest = [_along(point, record, like).force for record, like in zip(held, known, strict=True)]
    unit = np.sqrt(declared.disturbance.noise.force_psd)
    whole = np.vstack([k.force for k in known]) / unit
    return float(np.sqrt(np.sum((np.vstack(rest) / unit) ** 2) / np.sum(whole**2)))


def _names(found: Trace) -> str:
    return ", ".join(p.effect.name for p in found.found.point.placed) or "nothing"


def _error(row: Row, unit: float) -> str:
    return "" if row.failed else "diverges" if row.diverged else f"{row.error / unit:.3g}"


if __name__ == "__main__":
    main()
