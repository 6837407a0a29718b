"""The full screen of `levid watch` in the terminal: keys, confirmations, and repainting."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

from rich.segment import Segment
from rich.style import Style
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.geometry import Region
from textual.message import Message
from textual.strip import Strip
from textual.widget import Widget

from ...config.escaping import one_line
from ..entry import STOPPED
from .daemon_connection import DaemonConnection
from .dashboard import draw
from .styled_lines import STYLES, Line
from .view import View, in_flight

_CLOCK_S, _MESSAGE_S = 1.0, 10.0
_STYLES = {name: Style.parse(text) for name, text in STYLES.items()}
_ASCII = str.maketrans("█▏▎▍▌▋▊▉▕│─·…±", "#|||####||-..~") | {
    0x2800 + dots: ":" if dots else " " for dots in range(256)
}


class Arrived(Message):
    """Carry something from a thread of the connection to the screen: a function that applies it."""

    def __init__(self, apply: Callable[[], None]) -> None:
        self.apply = apply
        super().__init__()


class Dashboard(Widget):
    """Paint the lines of a view; only lines that changed are sent to the terminal."""

    def __init__(self, view: View, ascii_only: bool) -> None:
        super().__init__()
        self._view, self._ascii_only = view, ascii_only
        self._lines: list[Line] = []
        self._strips: list[Strip] = []

    def redraw(self) -> None:
        """Draw the view at the present size and repaint what changed."""
        width, height = self.size
        if not width or not height:
            return
        lines = draw(self._view, width, height)
        if len(lines) != len(self._lines):
            self._lines, self._strips = [[]] * len(lines), [Strip([])] * len(lines)
        changed = [row for row, line in enumerate(lines) if line != self._lines[row]]
        for row in changed:
            self._strips[row] = self._strip(lines[row], width)
        self._lines = lines
        if changed:
            self.refresh(*(Region(0, row, width, 1) for row in changed))

    def render_line(self, y: int) -> Strip:
        """Return a line for the terminal."""
        return self._strips[y] if y < len(self._strips) else Strip.blank(self.size.width)

    def on_resize(self) -> None:
        """Draw anew at another size."""
        self._lines = []
        self.redraw()

    def _strip(self, line: Line, width: int) -> Strip:
        segments = [
            Segment(text.translate(_ASCII) if self._ascii_only else text, _STYLES[style])
            for text, style in line
            if text
        ]
        return Strip(segments, width)


class WatchApp(App[None]):
    """Show what the daemon does; s stops at once, l and c ask first."""

    TITLE = "levid watch"
    ENABLE_COMMAND_PALETTE = False
    CSS = "Screen { background: ansi_default; } Dashboard { width: 100%; height: 100%; }"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("s,S", "stop", "stop", priority=True),
        Binding("l", "ask('land')", "land"),
        Binding("c", "ask('clear')", "clear"),
        Binding("y", "answer(True)", "yes"),
        Binding("n,escape", "answer(False)", "no"),
        Binding("question_mark", "help", "help"),
        Binding("q,ctrl+c", "quit", "quit", priority=True),
    ]

    def __init__(
        self, find_socket: Callable[[], Path], every_s: float, ascii_only: bool = False
    ) -> None:
        # The terminal's own 16 colours: they suit its background, and NO_COLOR removes them all.
        super().__init__(ansi_color=True)
        self.view = View()
        self._dashboard = Dashboard(self.view, ascii_only)
        self._connection = DaemonConnection(
            find_socket,
            every_s,
            lambda status: self._soon(lambda: self.view.receive(status, time.monotonic())),
            lambda reason: self._soon(lambda: self.view.lose(reason)),
            self._take_free_bytes,
        )

    def compose(self) -> ComposeResult:
        """Fill the screen with the dashboard."""
        yield self._dashboard

    def on_mount(self) -> None:
        """Connect; redraw once a second also without a status, for the clock and the silence."""
        self._connection.start()
        self.set_interval(_CLOCK_S, self._dashboard.redraw)

    def on_unmount(self) -> None:
        """Disconnect."""
        self._connection.close()

    def on_arrived(self, arrived: Arrived) -> None:
        """Apply what a thread of the connection sent."""
        arrived.apply()
        self._dashboard.redraw()

    def action_stop(self) -> None:
        """Command zero force at once."""
        self.view.asking = ""
        self._send("stop")

    def action_ask(self, op: str) -> None:
        """Ask whether to land or to clear, if there is something to land or to clear."""
        status = self.view.status
        if status is None or self.view.problem:
            self._say("not connected to the daemon", "bad")
            return
        flying = in_flight(status) or status["session"]
        if op == "land" and not flying:
            self._say("no flight to land", "warning")
        elif op == "clear" and status["fault"] == "NONE":
            self._say("no fault to clear", "warning")
        else:
            self.view.asking = op
            self._dashboard.redraw()

    def action_answer(self, yes: bool) -> None:
        """Answer the question on the screen."""
        op, self.view.asking = self.view.asking, ""
        if op and yes:
            self._send(op)
        elif op:
            self._say(f"did not {op}", "")

    def action_help(self) -> None:
        """Show or leave the help page."""
        self.view.help = not self.view.help
        self._dashboard.redraw()

    def _send(self, op: str) -> None:
        self._say(f"{op} ...", "warning")

        def on_answer(answer: Mapping[str, Any] | str) -> None:
            self._soon(lambda: self._say(*_outcome(op, answer)))

        self._connection.send(op, on_answer)

    def _say(self, text: str, style: str) -> None:
        self.view.message = message = (one_line(text), style)
        self._dashboard.redraw()
        if style != "alarm":
            self.set_timer(_MESSAGE_S, lambda: self._forget(message))

    def _forget(self, message: tuple[str, str]) -> None:
        if self.view.message is message:
            self.view.message = ("", "")
            self._dashboard.redraw()

    def _take_free_bytes(self, free: int | None) -> None:
        self._soon(lambda: setattr(self.view, "free_bytes", free))

    def _soon(self, apply: Callable[[], None]) -> None:
        """Apply a change in the thread of the screen; call from any thread."""
        with contextlib.suppress(RuntimeError):  # the screen is being closed
            self.post_message(Arrived(apply))


def _outcome(op: str, answer: Mapping[str, Any] | str) -> tuple[str, str]:
    """Return what the screen says after a request, and its style."""
    if isinstance(answer, str):
        failed = "NOT STOPPED: use the emergency stop; " if op == "stop" else f"{op} failed: "
        return f"{failed}{answer}", "alarm"
    if op == "stop":
        return STOPPED.replace("run 'levid clear'", "press c"), "warning"
    if op == "land":
        return ("landing" if answer["landing"] else "no flight to land"), ""
    cleared = answer["cleared"]
    return ("no fault to clear" if cleared == "NONE" else f"cleared {cleared}"), "good"
