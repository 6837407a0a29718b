"""What the results of the zoo come to: figures, their targets, and two tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from rich import box
from rich.table import Table

from levid.benchmarks.harness.table import Figure, Met, Target
from levid.benchmarks.trace.zoo_cases import ZooCase
from levid.benchmarks.trace.zoo_results import Result
from levid.benchmarks.trace.zoo_score import Score, median, named, score_plant
from levid.benchmarks.trace.zoo_truth import compared

CORES = 2
"""What the time is told for."""
_WITHIN = 0.05
_EXPLAINED = 1.15
_AS_INTENDED = 1.25
_LARGE = 5.0
_LARGE_ALONE = "alone 5x and 20x"
_UNLISTED = "unlisted"
_NAN = math.nan


def figures(results: Sequence[Result]) -> dict[str, float]:
    """Return every number by name, of all plants and of each group, as far as there are numbers."""
    out: dict[str, float] = {}
    groups = {"all": results, **_groups(results)}
    large = [r for r in results if r.plant.kind == "alone" and r.plant.times >= _LARGE]
    unlisted = [r for r in results if r.plant.kind == "unlisted"]
    groups |= {name: some for name, some in ((_LARGE_ALONE, large), (_UNLISTED, unlisted)) if some}
    for name, some in groups.items():
        prefix = "" if name == "all" else name.replace(" ", "_").replace(".", "_") + "_"
        out |= {f"{prefix}{key}": value for key, value in _Total(some).figures().items()}
    return {key: value for key, value in out.items() if math.isfinite(value)}


def told(results: Sequence[Result], due: int | None) -> list[Figure]:
    """Return all figures, those that have a target or stand beside one with a label.

    `due` is how many plants the default plan has, which is to take no more than so long; None of
    any other. Where there are no results of a group its figures are None.
    """
    numbers = figures(results)
    asked = [
        Figure(key, numbers.pop(key, None), unit, label, target=target)
        for key, unit, label, target in _ASKED
    ]
    hours = numbers.pop("hours", None)
    limit = None if due is None else Target(most=_MOST_HOURS)
    there = sum(result.found is not None for result in results)
    if due is not None and there < due and (hours is None or hours <= _MOST_HOURS):
        limit = Target(most=_MOST_HOURS, met=Met.UNDECIDED)  # the rest takes time too
    took = Figure("hours", hours, "h", f"processor time on {CORES} cores", target=limit)
    return [*asked, took, *(Figure(key, value, "", "") for key, value in numbers.items())]


_RIGHT = Target(least=95.0)
_MOST_HOURS = 2.5
_ASKED: tuple[tuple[str, str, str, Target | None], ...] = (
    ("alone_5x_and_20x_right_percent", "%", "right, alone, 5 and 20 times the floor", _RIGHT),
    ("pair_5x_right_percent", "%", "right, pairs", _RIGHT),
    ("alone_1_5x_right_percent", "%", "right, alone, 1.5 times the floor", Target(least=70.0)),
    ("nothing_false_alarms", "", "false alarms where nothing is", Target(most=0.0)),
    ("false_alarms", "", "false alarms, of all", Target(most=0.0)),
    ("after_over_floor", "x floor", "error after, median where right", Target(most=1.15)),
    ("alone_20x_parameter_error", "", "parameters off by, 20 times, median", None),
    ("alone_20x_within_5_percent", "%", "off by 5 % or less, 20 times", Target(least=100.0)),
    ("unlisted_misnamed", "", "unlisted effects that got a name", Target(most=0.0)),
    ("unlisted_right_percent", "%", "unlisted, described and halved", Target(least=100.0)),
)
"""Key, unit, label and target of what is asked of the zoo."""


def verdicts_table(results: Sequence[Result]) -> Table:
    """Return a line for every plant: how large, what was said of it, how well it is explained."""
    grid = Table(title="Plants", title_justify="left", box=box.SIMPLE)
    grid.add_column("plant")
    grid.add_column("verdict")
    grid.add_column("said")
    for column in ("before", "after", "parameters", "s"):
        grid.add_column(column, justify="right")
    for result in sorted(results, key=lambda r: (r.plant.kind, r.plant.times, r.plant.name)):
        if result.found is None:
            grid.add_row(result.plant.name, "failed", result.failed, "", "", "", "")
            continue
        score = score_of(result)
        error = _parameter_error(result)
        grid.add_row(
            result.plant.name, _verdict(score), score.said or "nothing",
            _number(score.before_over_floor), _number(score.after_over_floor),
            "" if math.isnan(error) else f"{100 * error:.2g} %", f"{result.seconds:.0f}",
        )  # fmt: skip
    grid.caption = (
        "before, after: error of the model refitted, without and with what was found, over the "
        "noise floor of a plant that holds nothing, or its own where that is not known; "
        "parameters: the worst of those that compare; s of one processor"
    )
    return grid


def summary_table(results: Sequence[Result]) -> Table:
    """Return what it comes to: a column a group, and all."""
    grid = Table(title="The zoo", title_justify="left", box=box.SIMPLE)
    groups = [*_groups(results).items(), ("all", results)]
    totals = [_Total(some).figures() for _, some in groups]
    grid.add_column("")
    for name, _ in groups:
        grid.add_column(name, justify="right")
    for name, said in _SAID:
        grid.add_row(name, *(said(f) for f in totals))
    grid.caption = (
        "medians: of those that are right and visible, before of all; its mechanism, explained: of "
        f"the same; explained: after {_EXPLAINED:g} floors or less; not compared: right and "
        "visible, but no number of it is known in the form that was named; extra: effects named "
        "beyond those there; own floor: what a trace takes for the floor over that of a plant that "
        f"holds nothing; as intended: before within a factor {_AS_INTENDED:g} of what was asked"
    )
    return grid


@dataclass(frozen=True)
class _Total:
    """Counts and medians of some results; a failed one is not right, and missed all."""

    results: Sequence[Result]

    def figures(self) -> dict[str, float]:
        scored = [(r, score_of(r)) for r in self.results if r.found is not None]
        right = [(r, s) for r, s in scored if s.right]
        failed = [r for r in self.results if r.found is None]
        visible = [(r, s) for r, s in scored if r.plant.cases and not s.hidden]
        found = [s for _, s in visible if s.right]
        numbers = [
            _parameter_error(r) for r, s in visible if s.right and r.plant.kind != "unlisted"
        ]
        errors = [e for e in numbers if not math.isnan(e)]
        afters = [s.after_over_floor for s in found]
        mechanism = sum(s.mechanism for s in found)
        within = sum(e <= _WITHIN for e in errors)
        sized = [
            (r, s) for r, s in scored if len(r.plant.cases) == 1 and _is_sized(r.plant.cases[0])
        ]
        seconds = float(sum(r.seconds for r in self.results))
        out = {
            "plants": float(len(self.results)),
            "right": float(len(right)),
            "right_percent": _percentage(len(right), len(self.results)),
            "right_not_as_a_set": float(sum(not s.in_a_set for _, s in right)),
            "not_visible": float(sum(s.hidden for _, s in scored)),
            "as_a_set": float(sum(s.in_a_set for _, s in right)),
            "family_right": float(sum(s.family for _, s in scored)),
            "missed": float(
                sum(s.missed for _, s in scored) + sum(len(r.plant.cases) for r in failed)
            ),
            "false_alarms": float(sum(s.false_alarms for _, s in scored)) if scored else _NAN,
            "right_of_visible_percent": _percentage(len(found), len(visible)),
            "mechanism": float(mechanism),
            "mechanism_percent": _percentage(mechanism, len(numbers)),
            "explained": float(sum(after <= _EXPLAINED for after in afters)),
            "extra": float(sum(s.extra for _, s in scored)),
            "as_large_as_intended": float(sum(_as_intended(r, s) for r, s in sized)),
            "sized": float(len(sized)),
            "parameter_error": median(errors),
            "compared": float(len(errors)),
            "not_compared": float(len(numbers) - len(errors)),
            "flown_with_less": float(sum(r.less for r in self.results)),
            "ran_away": float(sum(not math.isfinite(s.after_over_floor) for _, s in scored)),
            "within": float(within),
            "within_5_percent": _percentage(within, len(errors)),
            "after_over_floor": median(afters),
            "before_over_floor": median([s.before_over_floor for _, s in scored]),
            "own_floor": median([s.own_floor for r, s in scored if r.floor is not None]),
            "failed": float(len(failed)),
            "seconds": seconds,
            "hours": seconds / 3600.0 / CORES,
            "wall_s": float(sum(r.wall_s or 0.0 for r in self.results)),
        }
        unlisted = [s for r, s in scored if r.plant.kind == "unlisted"]
        if unlisted:
            out["unlisted"] = float(len(unlisted))
            for key in ("misnamed", "in_doubt", "described", "halved"):
                out[key] = float(sum(getattr(s, key) for s in unlisted))
        return out


def _groups(results: Sequence[Result]) -> dict[str, list[Result]]:
    in_order = sorted(results, key=lambda r: (r.plant.kind, r.plant.times))
    names = dict.fromkeys(r.plant.group for r in in_order)
    return {name: [r for r in results if r.plant.group == name] for name in names}


def score_of(result: Result) -> Score:
    """Return the score of a result; there has to be one."""
    assert result.found is not None
    found = result.found
    return score_plant(result.plant.cases, found["summary"], found["placed"], result.floor)


def _is_sized(case: ZooCase) -> bool:
    return case.absorbed is None and case.sized


def _as_intended(result: Result, score: Score) -> bool:
    ratio = score.before_over_floor / result.plant.times
    return 1 / _AS_INTENDED <= ratio <= _AS_INTENDED


def _parameter_error(result: Result) -> float:
    """Return the largest relative error of the parameters that compare, nan without any."""
    if result.found is None:
        return _NAN
    numbers = compared(result.entries, named(result.found["summary"], result.found["placed"]))
    return max((number.error for number in numbers), default=_NAN)


def _verdict(score: Score) -> str:
    if score.right:
        return "right, not visible" if score.hidden else f"right{', as a set' * score.in_a_set}"
    words = ["family right"] if score.family else ["wrong"]
    words += [f"{score.missed} missed"] if score.missed else []
    words += [f"{score.false_alarms} false"] if score.false_alarms else []
    return ", ".join(words)


def _percent(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.2g} %" if value < 10 else f"{value:.0f} %"


def _percentage(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else _NAN


def _of(part: str, whole: str) -> Callable[[Mapping[str, float]], str]:
    return lambda f: f"{f[part]:.0f} of {f[whole]:.0f}" if f.get(whole) else ""


def _count(key: str) -> Callable[[Mapping[str, float]], str]:
    return lambda f: "" if math.isnan(f[key]) else f"{f[key]:.0f}"


_SAID: tuple[tuple[str, Callable[[Mapping[str, float]], str]], ...] = (
    ("plants", _count("plants")),
    ("right", _count("right")),
    ("", lambda f: _percent(f["right_percent"])),
    ("  not as a set", _count("right_not_as_a_set")),
    ("  not visible", _count("not_visible")),
    ("right of visible", lambda f: _percent(f["right_of_visible_percent"])),
    ("  its mechanism", lambda f: _percent(f["mechanism_percent"])),
    ("  explained", _count("explained")),
    ("  after / floor, median", lambda f: _number(f["after_over_floor"])),
    ("  parameters off by, median", lambda f: _percent(100 * f["parameter_error"])),
    ("  off by 5 % or less", _of("within", "compared")),
    ("  not compared", _count("not_compared")),
    ("family right", _count("family_right")),
    ("missed", _count("missed")),
    ("false alarms", _count("false_alarms")),
    ("extra", _count("extra")),
    ("failed", _count("failed")),
    ("unlisted: misnamed", _of("misnamed", "unlisted")),
    ("  in doubt", _of("in_doubt", "unlisted")),
    ("  described", _of("described", "unlisted")),
    ("  halved", _of("halved", "unlisted")),
    ("before / floor, median", lambda f: _number(f["before_over_floor"])),
    ("own floor / floor, median", lambda f: _number(f["own_floor"])),
    ("as large as intended", _of("as_large_as_intended", "sized")),
    ("flown with less", _count("flown_with_less")),
)


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.3g}"
