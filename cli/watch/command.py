"""`levid watch`: choose between the full screen and lines."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from ..rig_socket import rig_option, socket_finder
from ..status_text import fault_lines, watch_line

_SCREEN_S, _LINES_S = 0.2, 0.5
_NO_SCREEN = ("dumb", "unknown", "")


@click.command("watch")
@rig_option
@click.option("--lines", is_flag=True, help="Print lines instead of the full screen.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object a line.")
@click.option(
    "--every-s",
    metavar="S",
    type=click.FloatRange(0.05, 3600),
    help=f"Seconds between two updates. Default: {_SCREEN_S} on the full screen, {_LINES_S} in "
    "lines.",
)
def watch(rig_path: Path | None, lines: bool, as_json: bool, every_s: float | None) -> int:
    """Show live what the daemon does, on the full screen of a terminal.

    Keys: s stops at once, l lands, c clears a fault, ? explains the screen, q quits. Landing and
    clearing ask for confirmation. If the daemon ends, the screen says so and reconnects.

    Without a terminal, and with --lines, one line of at most 80 characters is printed for each
    update: cycle, late cycles, height z, beam position and activity.

    \b
    Examples:
      levid watch
      levid watch --lines
      levid watch --every-s 5 --json >> flights.jsonl
    """
    find_socket = socket_finder(rig_path)
    if lines or as_json or not _has_screen():
        _print_lines(find_socket(), as_json, every_s or _LINES_S)
        return 0
    from .screen import WatchApp

    if not _has_colours():
        os.environ["NO_COLOR"] = "1"
    for name in ("COLUMNS", "LINES"):  # if a shell exports them, the terminal's size seems fixed
        os.environ.pop(name, None)
    WatchApp(find_socket, every_s or _SCREEN_S, not _has_unicode()).run()
    return 0


class _ReaderGone(Exception):  # noqa: N818 - the end of a pipe is no error
    """Report that nothing reads what this command prints."""


def _print_lines(socket: Path, as_json: bool, every_s: float) -> None:
    from ...daemon.client import Client

    fault = "NONE"

    def show(status: Mapping[str, Any]) -> None:
        nonlocal fault
        try:
            if as_json:
                click.echo(json.dumps(status))
                return
            click.echo(watch_line(status))
            if status["fault"] != fault:
                fault = status["fault"]
                for line in fault_lines(status):
                    click.echo(line)
        except BrokenPipeError:
            raise _ReaderGone from None  # the client would take it for its own connection

    try:
        with Client(socket) as client:
            client.request("watch", show, every_s=every_s)
    except _ReaderGone:
        raise BrokenPipeError from None


def _has_screen() -> bool:
    """Return whether this process has a terminal that can be painted."""
    streams = (sys.stdin, sys.stdout, sys.__stderr__)
    on_terminal = all(stream is not None and stream.isatty() for stream in streams)
    return on_terminal and os.environ.get("TERM", "") not in _NO_SCREEN


def _has_colours() -> bool:
    """Return whether the terminal has colours, as its terminfo entry says."""
    import curses

    try:
        curses.setupterm()
        return curses.tigetnum("colors") > 0
    except curses.error:
        return True


def _has_unicode() -> bool:
    """Return whether the terminal shows UTF-8, as the locale says; without a locale it does."""
    # LC_CTYPE says nothing: Python sets it to UTF-8 if the locale is C (PEP 538).
    locale = os.environ.get("LC_ALL") or os.environ.get("LANG") or "UTF-8"
    return "utf" in locale.lower()
