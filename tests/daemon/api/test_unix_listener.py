"""Test that the control socket is restored after its removal, and never replaces another one."""

from __future__ import annotations

import shutil
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from waiting import wait_until

from levid.config.daemon_settings import Service
from levid.daemon.api import unix_listener
from levid.daemon.api.control_server import Server, ServerError
from levid.daemon.api.unix_listener import UnixListener
from levid.daemon.client import Client
from levid.daemon.host.peer_credentials import Access

_GIVE_UP_S = 60.0


class Running:
    def __init__(self, folder: Path) -> None:
        self.path, self.said = folder / "run" / "levid.sock", list[str]()
        handlers = {"echo": lambda _, reply: reply.done(said=1)}
        self.server = Server(self.path, handlers, Access(Service()), self.said.append, poll_s=0.02)
        self.server.start()
        self._closed = False

    def answers(self) -> bool:
        with Client(self.path) as client:
            return client.request("echo") == {"ok": True, "said": 1}

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self.server.close()


@pytest.fixture
def checks(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """The results of the server's checks of its path."""
    checks, in_place = [], UnixListener.in_place.fget

    def noted(listener: UnixListener) -> bool:
        checks.append(in_place(listener))
        return checks[-1]

    monkeypatch.setattr(UnixListener, "in_place", property(noted))
    return checks


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    made = Running(tmp_path)
    yield made
    made.close()


def log_once(running: Running, checks: list[bool]) -> None:
    """Check that five more checks of the path add no line to the log."""
    so_far = len(checks)
    wait_until(lambda: len(checks) > so_far + 5, _GIVE_UP_S)
    assert len(running.said) == 1


@pytest.mark.parametrize("folder", [False, True])
def test_socket_whose_path_vanished_is_opened_again(
    checks: list[bool], running: Running, folder: bool
) -> None:
    with Client(running.path) as connected:
        if folder:  # as that of a user's session, when he logs out
            # At once: a folder that is half removed may have a new socket already.
            shutil.rmtree(running.path.parent.rename(running.path.parent.with_name("gone")))
        else:
            running.path.unlink()
        wait_until(lambda: running.said, _GIVE_UP_S)
        assert running.said == [f"the control socket was removed: {running.path} is open again"]
        assert running.answers()
        assert connected.request("echo")["said"] == 1  # who was there stays
    assert running.path.stat().st_mode & 0o777 == 0o660
    log_once(running, checks)


def test_socket_of_another_program_stays(checks: list[bool], running: Running) -> None:
    running.path.unlink()
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(running.path))
        other.listen()
        wait_until(lambda: running.said, _GIVE_UP_S)
        assert len(running.said) == 1
        assert "another daemon already uses this socket" in running.said[0]
        place = running.path.stat().st_ino
        log_once(running, checks)
        running.close()
        assert running.path.stat().st_ino == place
    made = Server(running.path, {}, Access(Service()))  # what it left behind is nobody's
    made.start()
    made.close()
    assert not running.path.exists()


def test_one_of_two_daemons_started_at_once_is_refused(
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


def test_folder_that_is_removed_while_the_socket_opens_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, removed = tmp_path / "run" / "levid.sock", list[bool]()
    checked = unix_listener.require_own_folder

    def removing(of: Path) -> None:
        checked(of)
        if not removed:
            removed.append(True)
            shutil.rmtree(of.parent)

    monkeypatch.setattr(unix_listener, "require_own_folder", removing)
    listener = UnixListener(path)
    with listener.open(0o660):
        assert listener.in_place
        assert removed
    listener.close()
