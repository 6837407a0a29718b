"""Test `levid watch` in a real terminal, with a real daemon that flies the simulated rig."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_process import Daemon, calm, daemon
from pictures import terminal_picture
from tmux_terminal import WAIT_S, terminal
from waiting import wait_until

from levid.cli.status_text import WIDTH
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.control.faults import FAULTS, Fault

RIG_FILE = shipped("rigs/loopback.yaml")
WATCH = [sys.executable, "-m", "levid.cli.main", "watch"]
COLOURS = re.compile(r"\x1b\[(\d+;)*(3[0-8]|4[0-8]|9[0-7]|10[0-7])[;m]")
QUICK = {"unload_s": 0.2, "ramp_s": 0.4, "settle_s": 0, "check_coils": False}
LAND = {"ramp_s": 0.4, "release_s": 0.2}


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    folder = tmp_path_factory.mktemp("daemon")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("RUNTIME_DIRECTORY", raising=False)
        patch.setenv("XDG_RUNTIME_DIR", str(folder))  # folder of the default socket
        with daemon(calm(load_rig(RIG_FILE), folder), RIG_FILE, folder) as running:
            yield running


@pytest.fixture
def flying(running: Daemon) -> Daemon:
    running.ask("land")
    running.until(lambda status: status["state"] in ("IDLE", "FAULT"))
    running.ask("clear")
    running.until(lambda status: status["state"] == "IDLE")
    levitate(running)
    return running


def levitate(running: Daemon) -> None:
    running.ask("levitate", levitate=QUICK, land=LAND)


def shows(text: str, status: dict[str, Any]) -> bool:
    """Return whether height and coil forces on the screen are those of a status."""
    (z_um,) = re.findall(r"^z +(-?[\d.]+) um", text, re.M)
    forces = [float(force) for force in re.findall(r"^ \d +(-?[\d.]+) .*rms", text, re.M)]
    expected = pytest.approx(status["coils"]["value"], abs=0.06)
    return forces == expected and abs(float(z_um) - 1e6 * status["z_m"]) < 1.0


def environment(running: Daemon, **more: str) -> dict[str, str]:
    unset = dict.fromkeys(("LC_ALL", "LC_CTYPE", "NO_COLOR"), "")
    return {**unset, "XDG_RUNTIME_DIR": str(running.socket.parent), "LANG": "C.UTF-8", **more}


def test_the_screen_shows_the_status_and_its_keys_land_stop_and_clear(
    flying: Daemon, tmp_path: Path
) -> None:
    with terminal(tmp_path, WATCH, (80, 24), environment(flying)) as screen:
        screen.until("LEVITATING", "in flight", "coils in N", "gap in um")
        # The platform settles: then the newest cycles of two looks agree to within their noise.
        wait_until(lambda: shows(screen.text, flying.ask("status")), WAIT_S, "z and coils alike")
        text, status = screen.text, flying.ask("status")
        assert f"±{1e6 * status['gaps']['limit']:g}" in text
        assert len(text.splitlines()[-1].strip()) > 0
        terminal_picture(screen, "watch-80x24", 80)
        screen.press("l")
        screen.until("Land now?")
        assert flying.ask("status")["state"] == "LEVITATING"
        screen.press("n")
        screen.until("did not land")
        assert flying.ask("status")["state"] == "LEVITATING"
        screen.press("l")
        screen.until("Land now?")
        screen.press("y")
        flying.until(lambda status: status["state"] == "IDLE")
        screen.until(" IDLE ", "(was LANDING)")

        levitate(flying)
        screen.until(" LEVITATING ")
        screen.press("s")  # and nothing else
        flying.until(lambda status: status["fault"] == "STOPPED")
        text = " ".join(screen.until("FAULT STOPPED", "press c").split())
        assert FAULTS[Fault.STOPPED].cause in text
        assert FAULTS[Fault.STOPPED].check in text

        screen.resize(160, 50)
        text = screen.until("um, last")
        assert sum(0x2800 < ord(character) <= 0x28FF for character in text) > 10  # a chart
        terminal_picture(screen, "watch-160x50", 160)
        screen.resize(60, 20)
        screen.until("largest gap")
        screen.press("c")
        screen.until("Clear the fault?")
        screen.press("y")
        flying.until(lambda status: status["state"] == "IDLE")
        screen.until("cleared STOPPED")
        screen.press("q")
        screen.until("exit code 0")


def test_a_terminal_without_colours_or_unicode_gets_neither(flying: Daemon, tmp_path: Path) -> None:
    plain = environment(flying, NO_COLOR="1")
    with terminal(tmp_path, WATCH, (80, 24), plain) as screen:
        screen.until("LEVITATING", "gap in um")
        assert not COLOURS.search(screen.escapes)
        screen.press("s")
        screen.until("FAULT STOPPED")
    old = environment(flying, TERM="vt100", LANG="C")
    with terminal(tmp_path, WATCH, (80, 24), old) as screen:
        text = screen.until("FAULT STOPPED", "timing us")
        assert text.isascii()
        assert not COLOURS.search(screen.escapes)


def test_lines_fit_80_columns_and_explain_a_fault_once(flying: Daemon) -> None:
    piped = subprocess.Popen(
        [*WATCH, "--every-s", "0.1"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert piped.stdout is not None
    first = [piped.stdout.readline() for _ in range(2)]
    assert all("late  z " in line and line.endswith("levitating\n") for line in first)
    flying.ask("stop")
    give_up_s = time.monotonic() + 60.0
    lines = first
    while sum("fault STOPPED" in line for line in lines) < 3:
        assert time.monotonic() < give_up_s
        lines.append(piped.stdout.readline())
    assert max(map(len, lines)) <= WIDTH + 1
    assert [line.split(":")[0].strip() for line in lines if ":" in line] == [
        "cause", "check", "then", "coils",
    ]  # fmt: skip
    piped.stdout.close()  # as `| head` does
    assert piped.stderr is not None
    threading.Timer(60.0, piped.kill).start()
    assert piped.stderr.read() == ""
    assert piped.wait() == 1
