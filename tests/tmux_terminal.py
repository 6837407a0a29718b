"""A real terminal for tests: a tmux server of its own with one window."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import pytest
from waiting import wait_until

WAIT_S = 60.0
_POLL_S = 0.02
_NUMBERS = count()


class Terminal:
    """One window of tmux, in which a command runs."""

    def __init__(self, socket: Path) -> None:
        self._socket = socket

    def tmux(self, *arguments: str) -> str:
        command = ["tmux", "-S", str(self._socket), "-f", "/dev/null", *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    @property
    def text(self) -> str:
        """What is on the screen."""
        return self.tmux("capture-pane", "-p")

    @property
    def escapes(self) -> str:
        """What is on the screen, with the escape sequences of colours."""
        return self.tmux("capture-pane", "-p", "-e")

    def press(self, key: str) -> None:
        self.tmux("send-keys", key)

    def resize(self, width: int, height: int) -> None:
        self.tmux("resize-window", "-x", str(width), "-y", str(height))

    def until(self, *texts: str) -> str:
        """Return the screen once it shows all texts."""
        give_up_s = time.monotonic() + WAIT_S
        while not all(text in (shown := self.text) for text in texts):
            assert time.monotonic() < give_up_s, f"{texts} not on the screen:\n{shown}"
            time.sleep(_POLL_S)
        return shown

    def until_gone(self, text: str) -> None:
        wait_until(lambda: text not in self.text, WAIT_S, f"{text} no longer on the screen")


@contextmanager
def terminal(
    folder: Path, command: Sequence[str], size: tuple[int, int], env: Mapping[str, str]
) -> Iterator[Terminal]:
    """Run a command in a terminal of this size; skip the test if there is no tmux.

    Names of `env` with an empty value are unset.
    When the command has ended, the screen shows "exit code N".
    """
    if shutil.which("tmux") is None:
        pytest.skip("tmux is not installed")
    unset = [f"--unset={name}" for name, value in env.items() if not value]
    words = ["env", *unset, *(f"{n}={value}" for n, value in env.items() if value), *command]
    shell = f"{shlex.join(words)}; echo exit code $?; exec sleep 600"
    # A server of its own: one that was killed in this folder before may still be ending.
    window = Terminal(folder / f"tmux-{next(_NUMBERS)}.sock")
    width, height = map(str, size)
    window.tmux("new-session", "-d", "-x", width, "-y", height, shell)
    try:
        yield window
    finally:
        window.tmux("kill-server")
