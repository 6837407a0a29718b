"""Results of the zoo: kept as lines of JSON, and what they come to."""

from __future__ import annotations

import gzip
import hashlib
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from _zoo_cases import ZooCase, wherever
from _zoo_fly import canonical, code_version
from _zoo_plan import Plant
from _zoo_score import Score, median, score_plant
from _zoo_sizes import Sizes
from _zoo_truth import compared
from rich import box
from rich.table import Table

_WITHIN = 0.05
_EXPLAINED = 1.15
_AS_INTENDED = 1.25
_NAN = math.nan


@dataclass(frozen=True)
class Result:
    """What came of a plant: _zoo_fly.Found as plain data, or why there is none.

    `entries` are the effects that were flown: smaller ones where the plant's own could not be.
    """

    plant: Plant
    found: dict[str, Any] | None
    failed: str = ""
    entries: tuple[dict[str, Any], ...] = ()


class Kept:
    """The results in a folder, by plant, sizes, seed and version of the code.

    With them, if given, those of a compressed file that others published.
    """

    def __init__(self, folder: Path, published: Path | None = None) -> None:
        self._file = folder / "results.jsonl"
        self._version = code_version()
        lines: list[str] = []
        if published is not None and published.exists():
            lines += gzip.decompress(published.read_bytes()).decode().splitlines()
        if self._file.exists():
            lines += self._file.read_text(encoding="utf-8").splitlines()
        rows = [row for row in map(_row, lines) if row is not None]
        # One that failed does not take the place of one that did not.
        rows.sort(key=lambda row: row["found"] is not None)
        self._rows = {row["key"]: row for row in rows}

    def has(self, plant: Plant, sizes: Mapping[str, Sizes]) -> bool:
        """Return whether there is a result; one that failed is none."""
        row = self._rows.get(self._key(plant, sizes))
        return row is not None and row["found"] is not None

    def add(self, result: Result, sizes: Mapping[str, Sizes]) -> None:
        """Keep a result, at once."""
        key = self._key(result.plant, sizes)
        row = {
            "key": key,
            "plant": result.plant.name,
            "code": self._version,
            "effects": list(result.entries),
            "failed": result.failed,
            "found": result.found,
        }
        self._rows[key] = row
        self._file.parent.mkdir(parents=True, exist_ok=True)
        with self._file.open("ab+") as file:
            if file.tell() and (file.seek(-1, os.SEEK_END), file.read(1))[1] != b"\n":
                file.write(b"\n")  # after a line that was cut off
            file.write(json.dumps(row).encode() + b"\n")

    def publish(self, file: Path) -> int:
        """Write the results of this code, and of no other, compressed; return how many.

        The same results make the same bytes, wherever the files of effects lie.
        """
        rows = [
            {**row, "effects": [wherever(entry) for entry in row["effects"]]}
            for row in self._rows.values()
            if row["code"] == self._version and row["found"]
        ]
        rows.sort(key=lambda row: (row["plant"], row["key"]))
        text = "".join(json.dumps(row) + "\n" for row in rows)
        file.write_bytes(gzip.compress(text.encode(), mtime=0))
        return len(rows)

    def of(self, plants: Sequence[Plant], sizes: Mapping[str, Sizes]) -> list[Result]:
        """Return the results of plants, in their order; those that there are none of fail."""
        results = []
        for plant in plants:
            row = self._rows.get(self._key(plant, sizes))
            results.append(
                Result(plant, None, "not flown")
                if row is None
                else Result(plant, row["found"], row["failed"], tuple(row["effects"]))
            )
        return results

    def _key(self, plant: Plant, sizes: Mapping[str, Sizes]) -> str:
        entries = [wherever(entry) for entry in plant.entries(sizes)]
        text = canonical([entries, plant.seed, self._version])
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def figures(results: Sequence[Result]) -> dict[str, float]:
    """Return every number by name, of all plants and of each group, as far as there are numbers."""
    out: dict[str, float] = {}
    groups = {"all": results, **_groups(results)}
    for name, some in groups.items():
        prefix = "" if name == "all" else name.replace(" ", "_").replace(".", "_") + "_"
        out |= {f"{prefix}{key}": value for key, value in _Total(some).figures().items()}
    return {key: value for key, value in out.items() if math.isfinite(value)}


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
        score = _score(result)
        error = _parameter_error(result)
        seconds = result.found["flight_s"] + result.found["trace_s"]
        grid.add_row(
            result.plant.name, _verdict(score), score.said or "nothing",
            _number(score.before_over_floor), _number(score.after_over_floor),
            "" if math.isnan(error) else f"{100 * error:.2g} %", f"{seconds:.0f}",
        )  # fmt: skip
    grid.caption = (
        "before, after: error of the model refitted, without and with what was found, over the "
        "noise floor; parameters: the worst of those that compare; s of one processor"
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
        "medians: of those that are right and visible, before of all; explained: after "
        f"{_EXPLAINED:g} floors or less; extra: effects named beyond those there; as intended: "
        f"before within a factor {_AS_INTENDED:g} of what was asked"
    )
    return grid


@dataclass(frozen=True)
class _Total:
    """Counts and medians of some results; a failed one is not right, and missed all."""

    results: Sequence[Result]

    def figures(self) -> dict[str, float]:
        scored = [(r, _score(r)) for r in self.results if r.found is not None]
        right = [(r, s) for r, s in scored if s.right]
        failed = [r for r in self.results if r.found is None]
        errors = [e for r, _ in right if not math.isnan(e := _parameter_error(r))]
        visible = [(r, s) for r, s in scored if r.plant.cases and not s.hidden]
        found = [s for _, s in visible if s.right]
        afters = [s.after_over_floor for s in found]
        sized = [
            (r, s) for r, s in scored if len(r.plant.cases) == 1 and _is_sized(r.plant.cases[0])
        ]
        out = {
            "plants": float(len(self.results)),
            "right": float(len(right)),
            "right_percent": 100.0 * len(right) / len(self.results) if self.results else _NAN,
            "not_visible": float(sum(s.hidden for _, s in scored)),
            "as_a_set": float(sum(s.in_a_set for _, s in right)),
            "family_right": float(sum(s.family for _, s in scored)),
            "missed": float(
                sum(s.missed for _, s in scored) + sum(len(r.plant.cases) for r in failed)
            ),
            "false_alarms": float(sum(s.false_alarms for _, s in scored)),
            "right_of_visible_percent": 100.0 * len(found) / len(visible) if visible else _NAN,
            "mechanism": float(sum(s.mechanism and not s.hidden for _, s in right)),
            "explained": float(sum(after <= _EXPLAINED for after in afters)),
            "extra": float(sum(s.extra for _, s in scored)),
            "as_large_as_intended": float(sum(_as_intended(r, s) for r, s in sized)),
            "sized": float(len(sized)),
            "parameter_error": median(errors),
            "compared": float(len(errors)),
            "ran_away": float(sum(not math.isfinite(s.after_over_floor) for _, s in scored)),
            "within": float(sum(e <= _WITHIN for e in errors)),
            "within_5_percent": sum(e <= _WITHIN for e in errors) / len(errors) if errors else _NAN,
            "after_over_floor": median(afters),
            "before_over_floor": median([s.before_over_floor for _, s in scored]),
            "failed": float(len(failed)),
            "seconds": float(
                sum(r.found["flight_s"] + r.found["trace_s"] for r, _ in scored if r.found)
            ),
        }
        unlisted = [s for r, s in scored if r.plant.kind == "unlisted"]
        if unlisted:
            for key in ("misnamed", "in_doubt", "described", "halved"):
                out[key] = float(sum(getattr(s, key) for s in unlisted))
        return out


def _groups(results: Sequence[Result]) -> dict[str, list[Result]]:
    in_order = sorted(results, key=lambda r: (r.plant.kind, r.plant.times))
    names = dict.fromkeys(r.plant.group for r in in_order)
    return {name: [r for r in results if r.plant.group == name] for name in names}


def _score(result: Result) -> Score:
    assert result.found is not None
    return score_plant(result.plant.cases, result.found["summary"], result.found["placed"])


def _is_sized(case: ZooCase) -> bool:
    return case.absorbed is None and case.sized


def _as_intended(result: Result, score: Score) -> bool:
    ratio = score.before_over_floor / result.plant.times
    return 1 / _AS_INTENDED <= ratio <= _AS_INTENDED


def _parameter_error(result: Result) -> float:
    """Return the largest relative error of the parameters that compare, nan without any."""
    if result.found is None:
        return _NAN
    numbers = compared(result.entries, result.found["placed"])
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


def _of(part: str, whole: str) -> Callable[[Mapping[str, float]], str]:
    return lambda f: f"{f[part]:.0f} of {f[whole]:.0f}" if f[whole] else ""


def _count(key: str) -> Callable[[Mapping[str, float]], str]:
    return lambda f: f"{f[key]:.0f}"


_SAID: tuple[tuple[str, Callable[[Mapping[str, float]], str]], ...] = (
    ("plants", _count("plants")),
    ("right", _count("right")),
    ("", lambda f: _percent(f["right_percent"])),
    ("  as a set", _count("as_a_set")),
    ("  not visible", _count("not_visible")),
    ("right of visible", lambda f: _percent(f["right_of_visible_percent"])),
    ("  its mechanism", _count("mechanism")),
    ("  explained", _count("explained")),
    ("  after / floor, median", lambda f: _number(f["after_over_floor"])),
    ("  parameters off by, median", lambda f: _percent(100 * f["parameter_error"])),
    ("  off by 5 % or less", lambda f: f"{f['within']:.0f} of {f['compared']:.0f}"),
    ("family right", _count("family_right")),
    ("missed", _count("missed")),
    ("false alarms", _count("false_alarms")),
    ("extra", _count("extra")),
    ("failed", _count("failed")),
    ("before / floor, median", lambda f: _number(f["before_over_floor"])),
    ("as large as intended", _of("as_large_as_intended", "sized")),
)


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.3g}"


def _row(line: str) -> dict[str, Any] | None:
    """Return a line's result; None for one that was cut off when the run was stopped."""
    try:
        row: dict[str, Any] = json.loads(line)
    except ValueError:
        return None
    return row
