"""Print messages and a progress bar on stderr; the bar is hidden if stderr is not a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import click


class Report(Protocol):
    """Callback that reports progress."""

    def __call__(self, what: str, share: float) -> None:
        """Report the current activity and the completed fraction, 0 to 1."""


def say(text: str) -> None:
    """Print a message to stderr; stdout carries results only."""
    click.echo(text, err=True)


@contextmanager
def progress(title: str) -> Iterator[Report]:
    """Show a progress bar while the `with` body runs; yield the callback that updates it."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    columns = (
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=30),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[what]}"),
    )
    with Progress(
        *columns, console=console, transient=True, disable=not sys.stderr.isatty()
    ) as bar:
        task = bar.add_task(title, total=1.0, what="")

        def report(what: str, share: float) -> None:
            bar.update(task, completed=share, what=what)

        yield report
