"""How punctual the machine was while a test ran: one that gave nobody its time proves nothing.

The witness is a process of its own, which whatever holds up the tests' process does not hold up; it
knows nothing but the standard library.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

PERIOD_S = 0.01
_LATE_S = 0.005
_MOST_LATE_SHARE = 0.05
_LONGEST_S = 0.1


@dataclass(frozen=True)
class Seen:
    """How often a process woke up, how often late, and how late at worst, s."""

    wakes: int = 0
    late: int = 0
    worst_s: float = 0.0

    def wake(self, late_s: float) -> Seen:
        """Return this and one more wake-up."""
        late = self.late + (late_s > _LATE_S)
        return Seen(self.wakes + 1, late, max(self.worst_s, late_s))

    def __add__(self, other: Seen) -> Seen:
        worst_s = max(self.worst_s, other.worst_s)
        return Seen(self.wakes + other.wakes, self.late + other.late, worst_s)

    @property
    def starved(self) -> str:
        """What was wrong with the machine, in words; nothing where it was punctual."""
        share = self.late / max(self.wakes, 1)
        if share <= _MOST_LATE_SHARE and self.worst_s <= _LONGEST_S:
            return ""
        return (
            f"the machine was too busy: {share:.0%} of wake-ups were {1e3 * _LATE_S:g} ms late or "
            f"more, one {1e3 * self.worst_s:.0f} ms"
        )


class Witness:
    """A process that only wakes up, a hundred times a second, and notes how late it was."""

    def __init__(self) -> None:
        # In a session of its own: an interrupt from the keyboard is the tests' business.
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", str(Path(__file__).resolve()), str(os.getpid())],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            start_new_session=True, text=True,
        )  # fmt: skip
        self.asked()  # it is there

    @property
    def pid(self) -> int:
        return self._process.pid

    def asked(self) -> Seen:
        """Return what it saw since it was asked last. Raises OSError: it is gone."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise BrokenPipeError("the witness of the machine's punctuality is gone")
        return Seen(**json.loads(answer))

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.communicate()


class Watch:
    """What the witness saw while one test ran, from here on."""

    def __init__(self, witness: Witness) -> None:
        self._witness = witness
        self._seen = Seen()
        witness.asked()

    @property
    def starved(self) -> str:
        """What was wrong with the machine so far; nothing where nobody can say."""
        try:
            self._seen += self._witness.asked()
        except OSError:
            return ""
        return self._seen.starved


def _testify(tests: int) -> None:
    """Wake up, and answer whoever asks, until the tests' process is gone or closes its end."""
    seen, due_s = Seen(), time.monotonic() + PERIOD_S
    # What it forked may hold the pipe's other end open still: its end alone would not tell.
    while os.getppid() == tests:
        asked = select.select([0], [], [], max(due_s - time.monotonic(), 0.0))[0]
        now_s = time.monotonic()
        if now_s >= due_s:
            seen = seen.wake(now_s - due_s)
            due_s = max(due_s + PERIOD_S, now_s)
        if asked:
            if not os.read(0, 1):
                return
            print(json.dumps(vars(seen)), flush=True)  # noqa: T201 - to the tests' process
            seen = Seen()


if __name__ == "__main__":
    _testify(int(sys.argv[1]))
