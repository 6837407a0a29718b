"""Trace imported records of plants that are not the rig: names, intervals, missing force, time.

A drive, a geared motor, a pendulum, a stage, a levitating magnet and a helicopter, each without an
effect and with one of the effects of imported_plant_effects.py, of a size that leaves 3 to 30 % of
the force unexplained by a linear model. The declared models are linear; of every second seed the
input gain is wrong too.

A report is *right* if its class and place are those of an effect in the plant; *in a group* if only
an alternative of an ambiguous report is. A plant with two effects is right if both are named. A
*false name* is a known class of which no member is right; the trace may say that it is in doubt.
Free forms (class `unknown`) are counted apart. Effects that are not in the table are right if no
name is false. Intervals are counted only if the fitted model has the structure of the plant.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np
from rich.table import Table

from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.benchmarks.trace.imported_plant_cases import declared
from levid.benchmarks.trace.imported_plant_effects import CASES, LAWS, PAIRS, Case, Drawn, case
from levid.benchmarks.trace.support_calibration import Statement, figures, statements
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.subspace.response_uncertainty import SURE_95
from levid.identification.trace.force_trace.force_trace_summary import force_summary
from levid.identification.trace.force_trace.model_with_effects import model_with_effects
from levid.identification.trace.force_trace.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.candidate_effects import all_effects

SEEDS, QUICK = 4, 1
FIRST_SEED = 120_000
"""No plant of these seeds was used to develop the trace; plants of these kinds were."""


@dataclass(frozen=True)
class Score:
    """The judged trace of one plant.

    named: what was found, in words. doubtful: whether the trace says that a name is in doubt.
    sure_and_false: whether a false name is not. force: missing force before and after in per cent.
    inside: whether each interval has the truth, with its half width over the true number.
    """

    plant: str
    law: str
    seed: int
    size: float
    right: bool
    in_group: bool
    false_name: bool
    free_form: bool
    force: tuple[float, float]
    seconds: float
    inside: tuple[tuple[bool, float], ...]
    told: tuple[Statement, ...]
    named: str
    doubtful: bool
    sure_and_false: bool

    @property
    def good(self) -> bool:
        """Whether the name is right, alone or in a group, or none is false where none is right."""
        return not self.false_name and (not is_listed(self.law) or self.right or self.in_group)

    def __str__(self) -> str:
        kinds = {"right": self.right, "in a group": self.in_group, "FALSE": self.false_name}
        kinds |= {"surely": self.sure_and_false, "in doubt": self.doubtful}
        said = ", ".join(k for k, so in kinds.items() if so) or ("-" if self.good else "MISSED")
        before, after = self.force
        missed = sum(not ok for ok, _ in self.inside)
        return (
            f"{self.plant} {self.law} {self.seed} ({100 * self.size:.0f} %): {said}: {self.named}; "
            f"{before:.3g} to {after:.3g} %, {missed} of {len(self.inside)} intervals miss, "
            f"{self.seconds:.0f} s"
        )


def scored(
    plant: str, law: str, seed: int, options: SearchOptions | None = None, encoder_steps: int = 0
) -> Score:
    """Return the score of one plant.

    encoder_steps: number of steps over its motion that each output is rounded to, 0 for none.
    """
    drawn = case(plant, law, seed)
    rng = np.random.default_rng(seed)
    config, ratio = declared(drawn.plant, rng, bool(seed % 2))
    in_loop = bool(drawn.plant.kp.any() or drawn.plant.kd.any())
    motion, Ts_s = drawn.motion, drawn.plant.Ts_s
    y = motion.y
    if encoder_steps:
        step = np.ptp(y, axis=0) / encoder_steps
        y = np.round(y / step) * step
    record = Experiment(plant, Ts_s, motion.u, y, {}, frozenset(), False, feedback=in_loop)
    records, start = [imported_trace_record(record, config)], time.perf_counter()
    trace = trace_records(records, config, all_effects, lambda *_: None, options)
    seconds = time.perf_counter() - start
    summary = force_summary(trace)

    def is_one(effect: Drawn, one: Mapping[str, Any]) -> bool:
        return one["class"] in effect.law.right and tuple(one["where"]) == effect.where

    def right(one: Mapping[str, Any]) -> bool:
        return any(is_one(effect, one) for effect in drawn.effects)

    known = [e for e in summary["effects"] if e["class"] != "unknown"]
    alone = [right(e) for e in known]
    grouped = [any(map(right, e["alternatives"])) for e in known]
    false = [e for e, a, g in zip(known, alone, grouped, strict=True) if not (a or g)]
    there = drawn.listed or drawn.effects
    named = [any(is_one(effect, e) for e in known) for effect in there]
    among = [any(is_one(effect, a) for e in known for a in e["alternatives"]) for effect in there]
    either = [a or b for a, b in zip(named, among, strict=True)]
    doubted = [e["evidence"]["doubtful"] for e in known]
    force = summary["validation"]["force_percent"]
    return Score(
        plant, law, seed, max((e.size for e in drawn.effects), default=0.0),
        bool(there) and all(named), bool(there) and all(either) and not all(named), bool(false),
        len(known) < len(summary["effects"]), (force["before"], force["after"]), seconds,
        tuple(intervals(trace, drawn, ratio)), tuple(statements(summary, right)),
        "; ".join(f"{e['name']} {' '.join(e['where'])}" for e in summary["effects"]) or "nothing",
        any(doubted), any(not e["evidence"]["doubtful"] for e in false),
    )  # fmt: skip


def intervals(trace: ForceTrace, drawn: Case, ratio: float) -> Iterator[tuple[bool, float]]:
    """Yield for each number whether its interval has the truth, and the interval's half width over
    the true number; nothing if the model's effects are not those of the plant."""
    structure = sorted(
        f"{e.law.effect}@{'+'.join(e.where)}" if e.law.effect else "" for e in drawn.effects
    )
    if sorted(p.effect.identity for p in trace.found.point.placed) != structure:
        return
    model = model_with_effects(trace)
    told = {key: (p.value, p.se) for key, p in model.parameters.items()}
    truth = {name: ratio * value for name, (value, _) in drawn.plant.parameters.items()}
    for effect in model.effects:
        told |= {f"{effect.effect} {key}": (p.value, p.se) for key, p in effect.parameters.items()}
    for e in drawn.effects:
        own = e.law.truth(e.numbers, ratio)
        truth |= {f"{e.law.effect} {key}": value for key, value in own.items()}
    for key, value in truth.items():
        estimate, se = told[key]
        if se is not None:
            half = SURE_95 * se
            yield abs(estimate - value) <= half, half / abs(value)


def _row(scores: Sequence[Score]) -> list[str]:
    """Return a table's row of plants with one law."""
    inside = [one for s in scores for one in s.inside]
    shares = [[s.right, s.in_group, s.false_name, s.free_form] for s in scores]
    medians = np.median([[*s.force, s.seconds] for s in scores], axis=0)
    count = [str(sum(column)) for column in zip(*shares, strict=True)]
    covered = f"{sum(ok for ok, _ in inside)} of {len(inside)}" if inside else "-"
    return [str(len(scores)), *count, *[f"{x:.3g}" for x in medians], covered]


COLUMNS = (
    "law", "plants", "right", "in group", "false name", "free form", "force before %", "after %",
    "s", "intervals with the truth",
)  # fmt: skip


def figures_of(scores: Sequence[Score]) -> Iterator[Figure]:
    """Yield the figures of all plants."""
    listed = [s for s in scores if is_listed(s.law)]
    plain = [s for s in scores if s.law == "none"]
    unlisted = [s for s in scores if not is_listed(s.law) and s.law != "none"]

    def share(key: str, those: Sequence[bool], label: str, target: Target | None) -> Figure:
        percent = 100.0 * sum(those) / len(those) if those else None
        return Figure(key, percent, "%", f"{label} (of {len(those)})", target=target)

    least = Target(least=95.0)
    yield share(
        "right_percent", [s.right or s.in_group for s in listed], "named, or in a group", least
    )
    yield share("alone_percent", [s.right for s in listed], "of these alone", None)
    yield share(
        "good_percent", [s.good for s in scores], "plants without a false or missing name", None
    )
    yield Figure("false_names", sum(s.false_name for s in scores), "", "plants with a false name",
                 target=Target(most=0.0))  # fmt: skip
    yield share(
        "false_none_percent", [s.false_name for s in plain], "of plants without effects", None
    )
    yield share(
        "false_unlisted_percent", [s.false_name for s in unlisted], "of unlisted ones", None
    )
    yield Figure("sure_and_false", sum(s.sure_and_false for s in scores), "",
                 "of these not said to be in doubt", target=Target(most=0.0))  # fmt: skip
    doubtful = [s.doubtful for s in scores if (s.right or s.in_group) and is_listed(s.law)]
    yield share(
        "right_in_doubt_percent", doubtful, "right names that are said to be in doubt", None
    )
    inside = [one for s in scores for one in s.inside]
    yield share("coverage_percent", [ok for ok, _ in inside], "95 % intervals with the truth",
                Target(least=90.0, most=99.0))  # fmt: skip
    half = float(np.median([w for _, w in inside])) if inside else None
    yield Figure("interval", half, "", "their half width over the true number, median")
    yield Figure("longest_s", max((s.seconds for s in scores), default=None), "s", "longest trace")
    yield from figures([one for s in scores for one in s.told])


def is_listed(law: str) -> bool:
    """Return whether the table has what plants of a law, or of a pair, should be traced to."""
    return any(LAWS[name].right and LAWS[name].listed for name in law.split("+"))


def jobs(
    plants: Sequence[str], laws: Sequence[str], first: int, seeds: int
) -> list[tuple[str, str, int]]:
    """Return plant, law and seed of each trace."""
    every = {p: (*CASES[p], *PAIRS[p]) for p in plants}
    chosen = [(p, law) for p, some in every.items() for law in some if law in laws]
    return [(p, law, first + i) for i in range(seeds) for p, law in chosen]


def main() -> None:
    options = parser("Trace plants that are not the rig; --quick: one seed of each")
    options.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help="of each case")
    options.add_argument("--first-seed", type=int, default=FIRST_SEED, metavar="N")
    options.add_argument("--plants", nargs="+", default=(*CASES,), choices=CASES, metavar="PLANT")
    pairs = dict.fromkeys(pair for some in PAIRS.values() for pair in some)
    laws = (*LAWS, *pairs)
    options.add_argument("--laws", nargs="+", default=laws, choices=laws, metavar="LAW")
    options.add_argument("--encoder-steps", type=int, default=0, metavar="N",
                         help="round outputs to N steps over the motion")  # fmt: skip
    arguments = options.parse_args()
    seeds = QUICK if arguments.quick else arguments.seeds
    todo = jobs(arguments.plants, arguments.laws, arguments.first_seed, seeds)
    table = Table(*COLUMNS)

    def measure() -> Iterator[Figure]:
        scores = list[Score]()
        with ProcessPoolExecutor(len(os.sched_getaffinity(0)), get_context("spawn")) as pool:
            trace_one = partial(scored, encoder_steps=arguments.encoder_steps)
            for score in pool.map(trace_one, *zip(*todo, strict=True)):
                scores.append(score)
                print(f"{len(scores)}/{len(todo)} {score}", file=sys.stderr, flush=True)
        for law in laws:
            if some := [s for s in scores if s.law == law]:
                table.add_row(law, *_row(some))
        yield from figures_of(scores)

    show("Imported plants", arguments, measure, lambda: [table])


if __name__ == "__main__":
    main()
