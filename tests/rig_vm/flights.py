"""Flies the session, then lets an amplifier trip in a second one, clears, and flies once more."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from levid.daemon.client import Client, DaemonError

session, out, faults, socket = (Path(argument) for argument in sys.argv[1:])
TEXT = session.read_text()
LONG = TEXT.replace("duration_s: 4", "duration_s: 60")


def fly(text: str, name: str, when_flying: str = "") -> None:
    told = False

    def news(step: str, share: float) -> None:
        nonlocal told
        if when_flying and step == "tilt" and not told:
            told = True
            say(when_flying)

    with Client(socket) as client:
        client.excite(text, out / name, news)


def say(line: str) -> None:
    with faults.open("w") as pipe:
        pipe.write(f"{line}\n")


def wait_for_daemon() -> None:
    """Return once it answers: its socket is there a moment before it listens."""
    give_up_s = time.monotonic() + 60.0
    while True:
        try:
            with Client(socket) as client:
                client.request("status")
                return
        except DaemonError:
            if time.monotonic() > give_up_s:
                raise
            time.sleep(0.2)


wait_for_daemon()
fly(TEXT, "first")
ended = ""
try:
    fly(LONG, "tripped", "trip 3")
except DaemonError as error:
    ended = str(error)
assert "fault AMPLIFIER" in ended, ended or "a session flown to its end"
assert "coil 3" in ended, ended
say("clear")
with Client(socket) as client:
    give_up_s = time.monotonic() + 120.0
    while True:  # the line takes its time, and so may devices
        try:
            cleared = client.request("clear")["cleared"]
            break
        except DaemonError:
            if time.monotonic() > give_up_s:
                raise
    assert cleared == "AMPLIFIER", cleared
fly(TEXT, "again")
