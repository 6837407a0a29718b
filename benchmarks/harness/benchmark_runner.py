"""Run a benchmark: its options, contenders in turn, and a table of figures and targets.

A long benchmark yields its figures one by one: those measured before an error, an interrupt or a
SIGTERM are printed as incomplete.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import sys
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import inf

from rich.console import Console
from rich.table import Table

_WIDE = 160
"""Columns of a table in a file."""


class Met(StrEnum):
    """Whether a figure is what it should be."""

    YES = "met"
    NO = "missed"
    UNDECIDED = "undecided"
    NOT_ASKED = "not asked"  # the figure to compare with was not measured


@dataclass(frozen=True)
class Target:
    """Bounds of a figure; `met` is given if more than the figure's value decides it."""

    most: float = inf
    least: float = -inf
    met: Met | None = None

    def __str__(self) -> str:
        if -inf < self.least and self.most < inf:
            return f"{self.least:g} .. {self.most:g}"
        return f"<= {self.most:g}" if self.most < inf else f">= {self.least:g}"


@dataclass(frozen=True)
class Figure:
    """One measured number: `key` names it in the JSON, `label` in the table.

    `value` is None if it could not be measured. `versus` is the key of a figure to compare with:
    the table shows the ratio. A figure without a label is in the JSON only.
    """

    key: str
    value: float | None
    unit: str
    label: str
    versus: str | None = None
    target: Target | None = None

    @property
    def met(self) -> Met | None:
        """Whether the target is met, None without one."""
        target = self.target
        if target is None or target.met is not None:
            return target and target.met
        if self.value is None:
            return Met.NOT_ASKED
        return Met.YES if target.least <= self.value <= target.most else Met.NO


def run(title: str, measure: Callable[[bool], Iterable[Figure]]) -> None:
    """Parse the command line, call `measure(quick)` and print its figures."""
    arguments = parser(title).parse_args()
    show(title, arguments, lambda: measure(arguments.quick))


def parser(description: str) -> argparse.ArgumentParser:
    """Return a parser with the options of every benchmark."""
    found = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument("--quick", action="store_true", help="fewer repeats, smaller data")
    found.add_argument(
        "--json",
        action="store_true",
        help='print {"figures": {NAME: number}, "met": {NAME: 1, 0, "undecided" or null}}',
    )
    found.add_argument("--check", action="store_true", help="exit with 1 if a target is missed")
    return found


def show(
    title: str,
    arguments: argparse.Namespace,
    measure: Callable[[], Iterable[Figure]],
    tables: Callable[[], Iterable[Table]] = tuple,
) -> None:
    """Print the figures of `measure`, and on an error those before it.

    Without --json, the other tables that `tables` returns are printed first.
    """
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup ignores SIGHUP
            signal.signal(number, _end)
    figures: list[Figure] = []
    found = measure()
    try:
        for figure in found:
            figures.append(figure)
    except BaseException as error:
        if isinstance(found, Generator):  # end its processes now
            found.close()
        if figures:
            _print(title, figures, arguments.json, tables, f"{type(error).__name__}: {error}")
        raise
    _print(title, figures, arguments.json, tables)
    not_shown = [f"{f.key} is {f.met}" for f in figures if f.met in (Met.NO, Met.UNDECIDED)]
    if arguments.check and not_shown:
        sys.exit(f"{title}: {', '.join(not_shown)}")


def median_times(contenders: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Return the median time in s of each contender.

    They take turns, so that a change of the machine's speed affects all of them.
    """
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(repeats):
        for name, contender in contenders.items():
            start = time.perf_counter()
            contender()
            times[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in times.items()}


def _end(number: int, _: object) -> None:
    """Exit through every `finally`, which ends daemons, electronics and mounts."""
    for once in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(once, signal.SIG_IGN)
    raise SystemExit(128 + number)


def _print(
    title: str,
    figures: Sequence[Figure],
    as_json: bool,
    tables: Callable[[], Iterable[Table]],
    problem: str = "",
) -> None:
    if as_json:
        said: dict[str, object] = {"figures": {figure.key: figure.value for figure in figures}}
        said["met"] = {figure.key: _IN_JSON[figure.met] for figure in figures if figure.met}
        if problem:
            said["incomplete"] = problem
        json.dump(said, sys.stdout)
        sys.stdout.write("\n")
        sys.stdout.flush()
    else:
        console = Console(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else _WIDE)
        for table in tables():
            console.print(table)
        labelled = [figure for figure in figures if figure.label]
        console.print(_table(f"{title} (incomplete: {problem})" if problem else title, labelled))


_IN_JSON: dict[Met | None, object] = {
    Met.YES: 1,
    Met.NO: 0,
    Met.UNDECIDED: "undecided",
    Met.NOT_ASKED: None,
}


def _table(title: str, figures: Sequence[Figure]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("what")
    table.add_column("figure", justify="right")
    table.add_column("unit")
    table.add_column("ratio")
    asked = any(figure.target is not None for figure in figures)
    if asked:
        table.add_column("target")
    by_key = {figure.key: figure for figure in figures}
    for figure in figures:
        other = by_key.get(figure.versus or "")
        ratio = ""
        if other is not None and figure.value is not None and other.value:
            ratio = f"{figure.value / other.value:.3g} x {other.label}"
        row = [figure.label, _number(figure.value), figure.unit, ratio]
        if asked:
            row.append("" if figure.target is None else f"{figure.target}: {figure.met}")
        table.add_row(*row)
    return table


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
