"""Test that the control socket is restored after its removal, and never replaces another one."""

from __future__ import annotations

import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from levid.config.service import Service
from levid.daemon.api import unix_listener
from levid.daemon.api.control_server import Server, ServerError
from levid.daemon.api.unix_listener import UnixListener
from levid.daemon.client import Client
from levid.daemon.host.peer_credentials import Access

_GIVE_UP_S = 60.0


def until(condition: Callable[[], object]) -> None:
    give_up_s = time.monotonic() + _GIVE_UP_S
    while not condition():
        assert time.monotonic() < give_up_s
        time.sleep(0.005)


class Running:
    def __init__(self, folder: Path) -> None:
        self.path, self.said = folder / "run" / "levid.sock", list[str]()
        handlers = {"echo": lambda _, reply: reply.done(said=1)}
        self.server = Server(self.path, handlers, Access(Service()), self.said.append)
        self.server.start()

    def answers(self) -> bool:
        with Client(self.path) as client:
            return client.request("echo") == {"ok": True, "said": 1}


@pytest.fixture
def running(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    monkeypatch.setattr("levid.daemon.api.control_server._POLL_S", 0.02)
    made = Running(tmp_path)
    yield made
    if not made.server._ending:
        made.server.close()


@pytest.mark.parametrize("folder", [False, True])
def test_socket_whose_path_vanished_is_opened_anew(running: Running, folder: bool) -> None:
    with Client(running.path) as connected:
        if folder:  # as that of a user's session, when he logs out
            shutil.rmtree(running.path.parent)
        else:
            running.path.unlink()
        until(lambda: running.said)
        assert running.said == [f"the control socket was removed: {running.path} is open again"]
        assert running.answers()
        assert connected.request("echo")["said"] == 1  # who was there stays
    assert running.path.stat().st_mode & 0o777 == 0o660
    time.sleep(0.1)
    assert len(running.said) == 1


def test_socket_of_somebody_else_stays_in_its_place(running: Running) -> None:
    running.path.unlink()
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(running.path))
        other.listen()
        until(lambda: running.said)
        assert len(running.said) == 1
        assert "another daemon already uses this socket" in running.said[0]
        place = running.path.stat().st_ino
        time.sleep(0.1)
        assert len(running.said) == 1
        running.server.close()
        assert running.path.stat().st_ino == place
    made = Server(running.path, {}, Access(Service()))  # what it left behind is nobody's
    made.start()
    made.close()
    assert not running.path.exists()


def test_of_two_daemons_that_start_at_once_one_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, ends = tmp_path / "levid.sock", list[object]()
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(str(path))
    listens = unix_listener.listens

    def slowly(path: Path) -> bool:
        found = listens(path)
        time.sleep(0.1)  # the other one looks meanwhile
        return found

    def start() -> None:
        try:
            ends.append(UnixListener(path).open(0o600))
        except ServerError as error:
            ends.append(error)

    monkeypatch.setattr(unix_listener, "listens", slowly)
    threads = [threading.Thread(target=start) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (opened,) = (end for end in ends if isinstance(end, socket.socket))
    (error,) = (end for end in ends if isinstance(end, ServerError))
    assert "another daemon already uses this socket" in str(error)
    assert listens(path)
    opened.close()
