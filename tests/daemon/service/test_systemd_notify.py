"""Test notifications to systemd over a datagram socket, and the reload after SIGHUP."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from daemon_process import GIVE_UP_S, calm, daemon
from waiting import wait_until

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.ipc.shared_status_words import Word
from levid.daemon.service.systemd_notify import Notify

RIG_FILE = shipped("rigs/loopback.yaml")


class Manager:
    """systemd's end of the conversation."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.setblocking(False)
        self.heard: list[str] = []

    def listen(self) -> list[str]:
        """Return what has come since the last time."""
        found = []
        with contextlib.suppress(BlockingIOError):
            while True:
                found.append(self._socket.recv(1000).decode())
        self.heard += found
        return found

    def until(self, text: str) -> None:
        """Listen until this has come, now or before."""
        wait_until(lambda: self.listen() is None or text in self.heard, GIVE_UP_S)

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Manager]:
    path = tmp_path / "notify"
    made = Manager(path)
    monkeypatch.setenv("NOTIFY_SOCKET", str(path))
    monkeypatch.setenv("WATCHDOG_USEC", "200000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    yield made
    made.close()


def test_watchdog_is_fed_only_while_the_loop_advances(manager: Manager, tmp_path: Path) -> None:
    with daemon(calm(load_rig(RIG_FILE), tmp_path), RIG_FILE, tmp_path) as running:
        manager.until("READY=1")
        manager.until("WATCHDOG=1")
        manager.until("STATUS=IDLE")
        os.kill(running.ask("status")["pids"]["loop"], signal.SIGKILL)
        running.until(lambda s: s["fault"] == "LOOP")
        manager.until("STATUS=LOOP")
        manager.listen()
        control_words = running.supervisor.control_words
        ticks = control_words[Word.BEAT]
        # 0.5 s of the supervisor, while the watchdog has to be fed every 0.2 s.
        wait_until(lambda: control_words[Word.BEAT] > ticks + 50, GIVE_UP_S)
        assert "WATCHDOG=1" not in manager.listen()
        manager.heard.clear()
        running.ask("clear")
        manager.until("WATCHDOG=1")
    manager.until("STOPPING=1")


def test_without_systemd_nothing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    silent = Notify()
    silent.ready()
    silent.alive()
    silent.stopping()


def test_watchdog_of_another_process_is_not_fed(manager: Manager, monkeypatch) -> None:
    monkeypatch.setenv("WATCHDOG_PID", "1")
    Notify().alive()
    assert manager.listen() == []


def test_reload_takes_over_what_it_can_and_says_what_it_cannot(tmp_path: Path) -> None:
    plain = calm(load_rig(RIG_FILE), tmp_path).model_dump(mode="json")
    plain["sim"] = str(shipped("sims/nominal.yaml"))
    file = tmp_path / "rig.yaml"
    file.write_text(yaml.safe_dump(plain))
    with daemon(load_rig(file), file, tmp_path) as running:
        plain["service"]["client_gone"] = "land"
        plain["limits"]["gap_m"] = 0.0007
        file.write_text(yaml.safe_dump(plain))
        running.supervisor.reload()
        until_said(running.said, "changes of limits need a restart")
        assert running.supervisor.rig.service.client_gone == "land"
        assert running.supervisor.rig.limits.gap_m != 0.0007
        file.write_text("levid: rig\nnonsense: 1\n")
        running.supervisor.reload()
        until_said(running.said, "is not reloaded")
        assert running.ask("status")["state"] == "IDLE"


def until_said(said: list[str], words: str) -> None:
    wait_until(lambda: any(words in line for line in said), GIVE_UP_S)
