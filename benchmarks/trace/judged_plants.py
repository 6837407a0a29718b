"""Trace drawn plants, judge what the trace says of each, and print the figures of all.

A plant is *right* if the names that are not in doubt are those of its effects, at their places; a
group is right if a member is.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_trace.force_trace_summary import force_summary
from levid.identification.trace.force_trace.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.candidate_effects import all_effects

Array = NDArray[np.float64]
Named = tuple[str, tuple[str, ...]]
"""Class and places of an effect."""

SEEDS, QUICK, RECORDS = 4, 1, 3


@dataclass(frozen=True)
class Result:
    """What the trace said of one plant.

    right: whether the names without doubt are those of the effects. false: whether one is not.
    inside: whether each interval has the truth, if all names are right. force: missing force.
    """

    kind: str
    seed: int
    right: bool
    false: bool
    doubted: bool
    inside: tuple[bool, ...]
    force: tuple[float, float]
    named: str

    def __str__(self) -> str:
        said = "FALSE" if self.false else "right" if self.right else "MISSED"
        doubt = ", in doubt" if self.doubted else ""
        missed = sum(not x for x in self.inside)
        return (
            f"{self.kind} {self.seed}: {said}{doubt}: {self.named}; {self.force[0]:.3g} to "
            f"{self.force[1]:.3g} %, {missed} of {len(self.inside)} intervals miss"
        )


def traced(
    config: ModelConfig,
    flown: Sequence[tuple[Array, Array]],
    Ts_s: float,
    set_points: Sequence[Array | None] = (),
    schedules: Sequence[Mapping[str, Array]] = (),
) -> ForceTrace:
    """Return the trace of records, each of inputs (rows, p) and readings (rows, n).

    set_points: of each record (rows, k), if a controller that is not known drives the inputs; None
    where they are not recorded. schedules: of each record the scheduling variables (rows,) by name,
    if these move.
    """
    experiments = [
        Experiment(f"r{n}", Ts_s, u, y, {}, frozenset(), False) for n, (u, y) in enumerate(flown)
    ]
    if schedules:
        moved = zip(experiments, schedules, strict=True)
        experiments = [replace(e, schedule=schedule, moving=True) for e, schedule in moved]
    if set_points:
        pairs = zip(experiments, set_points, strict=True)
        experiments = [replace(e, feedback=True, commanded=wanted) for e, wanted in pairs]
    records = [imported_trace_record(e, config) for e in experiments]
    with threadpool_limits(1):
        return trace_records(records, config, all_effects, lambda *_: None)


def result(
    kind: str,
    seed: int,
    trace: ForceTrace,
    effects: frozenset[Named],
    inside: Callable[[Sequence[Mapping[str, Any]]], Iterable[bool]],
    also: frozenset[Named] = frozenset(),
) -> Result:
    """Judge a trace of a plant with some effects; `also` may be named beside them.

    inside: whether each interval has the truth, from what the trace found. It is asked if all
    names are right, those in doubt included: the model has the plant's structure then.
    """
    summary = force_summary(trace)
    every = summary["effects"]
    sure = [e for e in every if not e["evidence"]["doubtful"]]
    right, false = _judged(sure, effects, also)
    structure, _ = _judged(every, effects, also)
    force = summary["validation"]["force_percent"]
    return Result(
        kind, seed, right, false, len(sure) < len(every),
        tuple(inside(every)) if structure else (), (force["before"], force["after"]),
        "; ".join(e["name"] for e in every) or "nothing",
    )  # fmt: skip


def _judged(
    said: Sequence[Mapping[str, Any]], effects: frozenset[Named], also: frozenset[Named]
) -> tuple[bool, bool]:
    """Return whether what is said is right, and whether a name is false."""
    found, false = set[Named](), False
    for e in said:
        names = {(a["class"], tuple(a["where"])) for a in (e["alternatives"] or [e])}
        found |= names & effects
        false |= not names & (effects | also) and e["class"] != "unknown"
    return found == effects and not false, false


def show_plants(
    what: str, kinds: Iterable[str], judged: Callable[[str, int], Result], first_seed: int
) -> None:
    """Judge plants of some kinds and seeds by the command's options, and print their figures."""
    options = parser(f"Trace {what}; --quick: one seed of each")
    options.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help="of each kind")
    options.add_argument("--first-seed", type=int, default=first_seed, metavar="N")
    options.add_argument("--kinds", nargs="+", default=(*kinds,), choices=(*kinds,), metavar="KIND")
    arguments = options.parse_args()
    count = QUICK if arguments.quick else arguments.seeds
    seeds = range(arguments.first_seed, arguments.first_seed + count)
    todo = [(kind, seed) for seed in seeds for kind in arguments.kinds]

    def measure() -> Iterator[Figure]:
        results = list[Result]()
        with ProcessPoolExecutor(len(os.sched_getaffinity(0)), get_context("spawn")) as pool:
            for result in pool.map(judged, *zip(*todo, strict=True)):
                results.append(result)
                print(f"{len(results)}/{len(todo)} {result}", file=sys.stderr, flush=True)
        yield from figures(results)

    show(what.capitalize(), arguments, measure)


def figures(results: list[Result]) -> Iterator[Figure]:
    """Yield the figures of all plants."""
    count, inside = len(results), [x for r in results for x in r.inside]
    yield Figure("right", 100 * sum(r.right for r in results) / count, "%",
                 f"right (of {count})", target=Target(least=95))  # fmt: skip
    yield Figure("false", sum(r.false for r in results), "",
                 "with a false name that is not in doubt", target=Target(most=0))  # fmt: skip
    yield Figure("doubted", sum(r.doubted for r in results), "", "with a name in doubt")
    if inside:
        yield Figure("inside", 100 * sum(inside) / len(inside), "%",
                     f"95 % intervals with the truth (of {len(inside)})",
                     target=Target(least=90, most=99))  # fmt: skip
    listed = [r.force[1] for r in results]
    yield Figure("after", float(np.median(listed)), "%", "missing force after, median")
    yield Figure("most", max(listed), "%", "missing force after, largest")
