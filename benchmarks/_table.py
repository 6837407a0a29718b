"""Frame of a benchmark: `--quick` and `--json`, contenders in turn, and a table of figures."""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table


@dataclass(frozen=True)
class Figure:
    """One measured number: `key` names it in the JSON, `label` in the table.

    `versus` is the key of the figure to compare with; the table then shows how many times it this
    one is.
    """

    key: str
    value: float
    unit: str
    label: str
    versus: str | None = None


def run(title: str, measure: Callable[[bool], Sequence[Figure]]) -> None:
    """Command line of a benchmark: call `measure(quick)` and print its figures."""
    parser = argparse.ArgumentParser(description=title)
    parser.add_argument("--quick", action="store_true", help="fewer repeats, smaller data")
    parser.add_argument("--json", action="store_true", help='print {"figures": {NAME: number}}')
    arguments = parser.parse_args()
    figures = measure(arguments.quick)
    if arguments.json:
        json.dump({"figures": {figure.key: figure.value for figure in figures}}, sys.stdout)
        sys.stdout.write("\n")
    else:
        Console().print(_table(title, figures))


def median_times(contenders: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Return the median time in s that each contender takes.

    They take turns, so that a change of the machine's speed meets all of them alike.
    """
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(repeats):
        for name, contender in contenders.items():
            start = time.perf_counter()
            contender()
            times[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in times.items()}


def _table(title: str, figures: Sequence[Figure]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("what")
    table.add_column("figure", justify="right")
    table.add_column("unit")
    table.add_column("ratio")
    by_key = {figure.key: figure for figure in figures}
    for figure in figures:
        ratio = ""
        if figure.versus is not None:
            other = by_key[figure.versus]
            ratio = f"{figure.value / other.value:.3g} x {other.label}"
        table.add_row(figure.label, _number(figure.value), figure.unit, ratio)
    return table


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
