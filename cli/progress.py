"""Print messages and a progress bar on stderr; the bar is hidden if stderr is not a terminal."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

import click

from ..config.escaping import one_line, raw_output

_SHOWN_CYCLES = 2_000_000
"""Cycles that are checked in about half a second: shorter work needs no bar."""


class Report(Protocol):
    """Callback that reports progress."""

    def __call__(self, what: str, share: float) -> None:
        """Report the current activity and the completed fraction, 0 to 1."""


def say(text: str) -> None:
    """Print a message to stderr; stdout carries results only."""
    click.echo(text, err=True)


@contextmanager
def progress(title: str) -> Iterator[Report]:
    """Show a progress bar while the `with` body runs; yield the callback that updates it.

    If stderr is not a terminal, or one that cannot move its cursor, nothing is written. With
    NO_COLOR the bar has no colours.
    """
    if not sys.stderr.isatty() or os.environ.get("TERM") in ("dumb", "unknown"):
        yield lambda _, __: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    # rich leaves out colours itself with NO_COLOR, but not bold.
    plain = bool(os.environ.get("NO_COLOR"))
    columns = (
        TextColumn("{task.description}", style="none" if plain else "bold", markup=False),
        BarColumn(bar_width=30),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[what]}", markup=False),
    )
    # The bar moves the cursor: its own texts are escaped, not what it writes.
    terminal = Console(file=raw_output(sys.stderr))
    with Progress(*columns, console=terminal, transient=True) as bar:
        task = bar.add_task(one_line(title), total=1.0, what="")

        def report(what: str, share: float) -> None:
            bar.update(task, completed=share, what=one_line(what))

        yield report


@contextmanager
def counted_progress(title: str, cycles: int) -> Iterator[Callable[[str, int], None]]:
    """Show a progress bar for work on about `cycles` cycles; none if it takes less than a second.

    Yield a callback that gets what is done, and the number of cycles done since its last call.
    """
    if cycles < _SHOWN_CYCLES:
        yield lambda _, __: None
        return
    done = 0
    with progress(title) as report:

        def count(what: str, more: int) -> None:
            nonlocal done
            done += more
            report(what, min(done / cycles, 1.0))

        yield count
