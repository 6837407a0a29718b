"""Test the control socket with clients that flood, stall, disconnect, or have no access."""

from __future__ import annotations

import contextlib
import errno
import grp
import json
import os
import pwd
import selectors
import socket
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from waiting import wait_until

from levid.config.base import ConfigError
from levid.config.daemon_settings import Service
from levid.daemon.api.control_server import LONGEST_LINE, LONGEST_SHORT, Reply, Server, ServerError
from levid.daemon.client import Client, DaemonError
from levid.daemon.host.peer_credentials import Access, Peer, Role, forbidden, peer_of
from levid.daemon.ipc.json_lines import Lines

_GIVE_UP_S = 60.0


class Bench:
    """A server that answers `echo` at once and `wait` when `answer_all` is called."""

    def __init__(self, folder: Path, access: Access | None = None) -> None:
        self.path = folder / "test.sock"
        self.waiting: list[Reply] = []
        self.stops: list[int] = []
        self.gone = threading.Event()
        handlers: dict[str, Any] = {
            "echo": lambda request, reply: reply.done(said=request.get("say")),
            "wait": self._wait,
            "stop": lambda _, reply: (self.stops.append(1), reply.done()),
            "flood": lambda _, reply: [reply.send({"line": "x" * 10_000}) for _ in range(1000)],
        }
        self.server = Server(self.path, handlers, access or Access(Service()))
        self.server.start()

    def _wait(self, _: object, reply: Reply) -> None:
        reply.on_hang_up = self.gone.set
        self.waiting.append(reply)

    def connect(self) -> socket.socket:
        connection = socket.socket(socket.AF_UNIX)
        connection.connect(str(self.path))  # waits where many others do
        connection.settimeout(_GIVE_UP_S)
        return connection

    def ask(self, connection: socket.socket, *lines: bytes) -> list[dict[str, Any]]:
        stream = connection.makefile("rwb")
        stream.write(b"\n".join([*lines, b""]))
        stream.flush()
        return [json.loads(stream.readline()) for _ in lines]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.server.close()
    assert not made.path.exists()


def works(bench: Bench) -> bool:
    with bench.connect() as connection:
        (answer,) = bench.ask(connection, b'{"op": "echo", "say": 1}')
        return answer == {"ok": True, "said": 1}


def test_long_line_is_passed_on_unparsed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What takes long to parse would keep the supervisor from its heartbeat."""
    parsed, handed = [], []
    loads = json.loads
    monkeypatch.setattr(
        "levid.daemon.api.control_server.json.loads",
        lambda line: (parsed.append(len(line)), loads(line))[1],
    )

    def long(line: bytes, reply: Reply) -> None:
        handed.append(len(line))
        reply.done(handed=len(line))

    handlers: dict[str, Any] = {"echo": lambda request, reply: reply.done(said=request["say"])}
    server = Server(tmp_path / "test.sock", handlers, Access(Service()), on_long=long)
    server.start()
    try:
        with Client(tmp_path / "test.sock") as client:
            for size in (10, LONGEST_SHORT, 4 * LONGEST_SHORT, LONGEST_LINE - 100):
                client.request("echo", say="x" * size)
    finally:
        server.close()
    assert len(handed) == 3
    assert min(handed) > LONGEST_SHORT >= max(n for n in parsed if n not in handed)


def test_requests_on_one_connection_are_answered_in_order(bench: Bench) -> None:
    with bench.connect() as connection:
        lines = [b'{"op": "echo", "say": %d}' % i for i in range(500)]
        assert [a["said"] for a in bench.ask(connection, *lines)] == list(range(500))


def test_request_waits_for_the_one_before(bench: Bench) -> None:
    with bench.connect() as connection:
        connection.sendall(b'{"op": "wait"}\n{"op": "echo", "say": 2}\n')
        assert works(bench)  # others do not wait
        while not bench.waiting:
            pass
        bench.waiting[0].done(said=1)
        stream = connection.makefile("rb")
        assert [json.loads(stream.readline())["said"] for _ in range(2)] == [1, 2]


def test_process_of_the_daemon_is_a_client_with_the_role_it_was_given(bench: Bench) -> None:
    ours, theirs = socket.socketpair()
    theirs.settimeout(_GIVE_UP_S)
    used_s = bench.server.adopt(ours, Role.STOP)
    before_s = used_s()
    assert before_s is not None
    assert bench.ask(theirs, b'{"op": "stop"}')[0]["ok"]
    assert bench.stops == [1]
    refused = bench.ask(theirs, b'{"op": "echo"}')[0]
    assert not refused["ok"]
    assert "may only stop and land" in refused["error"]
    assert (used_s() or 0.0) > before_s
    # However many clients connect, it stays.
    others = [bench.connect() for _ in range(80)]
    assert bench.ask(others[-1], b'{"op": "echo"}')[0]["ok"]
    assert bench.ask(theirs, b'{"op": "stop"}')[0]["ok"]
    theirs.close()
    wait_until(lambda: used_s() is None)


def test_idle_clients_make_room_and_waiting_clients_stay(bench: Bench) -> None:
    with bench.connect() as patient, contextlib.ExitStack() as stack:
        patient.sendall(b'{"op": "wait"}\n')
        while not bench.waiting:
            pass
        for _ in range(200):
            stack.enter_context(bench.connect()).sendall(b'{"op"')
        assert works(bench)
        bench.waiting[0].done(said="still here")
        assert json.loads(patient.makefile("rb").readline())["said"] == "still here"


def test_clients_of_a_lower_role_give_way_to_a_higher_one_and_never_the_other_way(
    bench: Bench,
) -> None:
    def connected(role: Role, pending: bool) -> socket.socket:
        bench.server.set_access(_Only(role))
        connection = bench.connect()
        if pending:
            connection.sendall(b'{"op": "wait"}\n')
        else:
            assert bench.ask(connection, b'{"op": "status"}')[0]["ok"] is False  # no such request
        return connection

    flying = [connected(Role.FLY, pending=False) for _ in range(40)]
    watching = [connected(Role.WATCH, pending=False) for _ in range(100)]
    with connected(Role.STOP, pending=False) as stopping:  # in a place of those who only watch
        assert bench.ask(stopping, b'{"op": "stop"}')[0]["ok"]
    for connection in flying:  # idle for longest, and connected still
        assert bench.ask(connection, b'{"op": "echo"}')[0]["ok"]
    flying += [connected(Role.FLY, pending=True) for _ in range(24)]
    wait_until(lambda: len(bench.waiting) == 24, _GIVE_UP_S)
    bench.server.set_access(_Only(Role.WATCH))
    with bench.connect() as refused, contextlib.suppress(ConnectionError):
        assert refused.recv(1) == b""
    for connection in (*flying, *watching):
        connection.close()


def test_client_that_reads_nothing_is_disconnected(bench: Bench) -> None:
    with bench.connect() as slow:
        slow.sendall(b'{"op": "flood"}\n')
        assert works(bench)
        with contextlib.suppress(ConnectionResetError):
            while slow.recv(1 << 20):
                pass


def hang_up(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):  # the server has closed it
        connection.shutdown(socket.SHUT_RDWR)


def test_flood_of_requests_does_not_keep_others_waiting(bench: Bench) -> None:
    def flood(connection: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection.sendall(b'{"op": "echo"}\n' * 1000)

    with contextlib.ExitStack() as stack:
        for _ in range(4):
            connection = stack.enter_context(bench.connect())
            thread = threading.Thread(target=flood, args=(connection,))
            thread.start()
            stack.callback(thread.join)
            # A thread that waits until its requests are read returns with an error.
            stack.callback(hang_up, connection)
        for _ in range(20):
            assert works(bench)


def test_error_of_one_connection_ends_no_other(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    with bench.connect() as patient, bench.connect() as odd:
        patient.sendall(b'{"op": "wait"}\n')
        odd.sendall(b'{"op": "wait"}\n')
        wait_until(lambda: len(bench.waiting) == 2, _GIVE_UP_S)
        bench.waiting[1].done(said={1, 2})  # JSON has no sets
        assert odd.recv(1) == b""
        monkeypatch.setattr("levid.daemon.api.control_server.peer_of", lambda _: 1 / 0)
        with bench.connect() as unknown, contextlib.suppress(ConnectionError):
            assert unknown.recv(1) == b""
        monkeypatch.undo()
        bench.waiting[0].done(said=1)
        assert json.loads(patient.makefile("rb").readline())["said"] == 1
    assert works(bench)


def test_server_reports_that_its_thread_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fails = threading.Event()

    class Failing(selectors.DefaultSelector):
        def select(self, _: float | None = None) -> Any:
            fails.wait(_GIVE_UP_S)
            raise OSError(errno.ENOMEM, "Cannot allocate memory")

    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    monkeypatch.setattr("levid.daemon.api.control_server.selectors.DefaultSelector", Failing)
    server = Server(tmp_path / "test.sock", {}, Access(Service()))
    assert not server.dead  # it has not been started
    server.start()
    assert not server.dead
    fails.set()
    wait_until(lambda: server.dead, _GIVE_UP_S)
    nobody: Any = None
    server.post(nobody, {}, final=True)  # other threads can still post
    server.close()


def test_line_without_an_end_is_refused(bench: Bench) -> None:
    with bench.connect() as connection:
        with contextlib.suppress(OSError):
            connection.sendall(b"x" * (LONGEST_LINE + 2))
        assert "at most" in json.loads(connection.makefile("rb").readline())["error"]
    assert works(bench)


@pytest.mark.parametrize("before", [b'{"op": "echo"}', b'{"op": "wait"}', b"nonsense"])
def test_stop_of_a_disconnected_client_is_executed(bench: Bench, before: bytes) -> None:
    for _ in range(20):
        with bench.connect() as connection:
            connection.sendall(before + b'\n{"op": "echo"}\n{"op": "stop"}\n')
    with bench.connect() as connection:
        connection.sendall(before + b'\n{"op": "stop"}\n')
        connection.shutdown(socket.SHUT_WR)
        connection.makefile("rb").read()
    wait_until(lambda: len(bench.stops) == 21, _GIVE_UP_S)


@pytest.mark.parametrize("line", [b"", b"stop", b'{"op": "echo"}'])
def test_flood_of_a_disconnected_client_delays_no_other(bench: Bench, line: bytes) -> None:
    """Parsing the lines would take seconds. The machine may stand still, but not every time."""
    flood = (line + b"\n") * (1_900_000 // (len(line) + 1))
    took_s = []
    for _ in range(5):
        bench.gone.clear()
        with bench.connect() as connection:
            connection.sendall(b'{"op": "wait"}\n' + flood)
        began_s = time.monotonic()
        assert bench.gone.wait(_GIVE_UP_S)
        assert works(bench)
        took_s.append(time.monotonic() - began_s)
    assert min(took_s) < 0.7


def test_remaining_lines_are_searched_for_words() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        lines = Lines(ours, 1000, 1000)
        theirs.sendall(b"one\n\nstop 1\nno\nland stop 2\n\nstop 3 has no end")
        lines.receive()
        assert lines.next_line() == b"one"
        assert list(lines.lines_with((b"stop", b"land"))) == [b"stop 1", b"land stop 2"]
        assert lines.next_line() is None


def test_client_that_is_being_disconnected_is_not_read(bench: Bench) -> None:
    """His answers fill his own buffers, and then he may say what he likes."""
    with bench.connect() as connection:
        connection.sendall(b'{"op": "echo", "say": "' + b"x" * 200_000 + b'"}\n')
        connection.setblocking(False)
        said, deadline_s = 0, time.monotonic() + 1.0
        while time.monotonic() < deadline_s:
            try:
                said += connection.send(b"y" * 100_000)
            except BlockingIOError:
                time.sleep(0.01)
            except OSError:
                break
        # Twice the longest line, and what the kernel keeps.
        assert said < 4 * LONGEST_LINE
    assert works(bench)


def test_disconnected_client_is_detected(bench: Bench) -> None:
    with bench.connect() as connection:
        connection.sendall(b'{"op": "wait"}\n')
    assert bench.gone.wait(_GIVE_UP_S)
    assert not bench.waiting[0].waiting
    bench.waiting[0].done()  # answered all the same, to nobody
    assert works(bench)


def test_closed_client_is_gone_though_its_stream_is_referenced(bench: Bench) -> None:
    with Client(bench.path) as daemon:
        stream = daemon._stream  # as the traceback of an interrupt does
        stream.write(b'{"op": "wait"}\n')
        stream.flush()
        wait_until(lambda: bench.waiting, _GIVE_UP_S)
    assert bench.gone.wait(_GIVE_UP_S)


def test_kernel_reports_the_peer() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX)
    with ours, theirs:
        peer = peer_of(ours)
    assert (peer.pid, peer.uid) == (os.getpid(), os.geteuid())
    assert peer.gids == {os.getegid(), *os.getgroups()}


def test_access() -> None:
    own = Access(Service())
    stranger = Peer(1, 54_321, frozenset({54_321}))
    assert own.mode == 0o660
    for peer in (
        Peer(1, 0, frozenset({54_321})),
        Peer(1, os.geteuid(), frozenset({54_321})),
        Peer(1, 54_321, frozenset({54_321, os.getegid()})),
    ):
        assert own.refuses(peer) == ""
    assert "user 54321 has no access" in own.refuses(stranger)
    user, group = pwd.getpwall()[-1], grp.getgrall()[-1]
    for more in (
        {"allow_users": (54_321,)},
        {"allow_groups": (54_321,)},
        {"allow_users": (user.pw_name, 54_321), "allow_groups": (group.gr_name,)},
    ):
        assert Access(Service(**more)).refuses(stranger) == ""
    with pytest.raises(ConfigError, match="allow_users: no such user 'nobody-at-all'"):
        Access(Service(allow_users=("nobody-at-all",)))


def test_roles_include_those_below_them() -> None:
    access = Access(
        Service(
            allow_groups=(54_001,),
            stop_users=(54_321,),
            watch_groups=(54_002,),
            watch_users=(54_321, 54_322),
        )
    )
    assert access.mode == 0o666
    for uid, gid, role in (
        (54_321, 1, Role.STOP),  # the highest of several
        (54_322, 1, Role.WATCH),
        (54_322, 54_001, Role.FLY),
        (54_323, 54_002, Role.WATCH),
        (54_323, 1, Role.NONE),
    ):
        assert access.role_of(Peer(1, uid, frozenset({gid}))) is role
    asked = ("status", "watch", "stop", "land", "levitate", "excite", "move", "clear", "new")
    allowed = {role: [op for op in asked if not forbidden(role, op)] for role in Role}
    assert allowed[Role.WATCH] == ["status", "watch"]
    assert allowed[Role.STOP] == ["status", "watch", "stop", "land"]
    assert allowed[Role.FLY] == list(asked)
    assert allowed[Role.NONE] == []
    assert "may only watch; see service.stop_users and stop_groups" in forbidden(Role.WATCH, "stop")


class Watchers(Access):
    """Let everybody watch, and nobody do more."""

    def role_of(self, _: Peer) -> Role:
        return Role.WATCH


def test_watcher_neither_stops_nor_flies(tmp_path: Path) -> None:
    asked: list[str] = []

    def handler(request: Mapping[str, Any], reply: Reply) -> None:
        asked.append(request["op"])
        reply.done()

    handlers = dict.fromkeys(("status", "stop", "excite"), handler)
    long: list[bytes] = []
    server = Server(
        tmp_path / "test.sock",
        handlers,
        Watchers(Service()),
        on_long=lambda line, reply: (long.append(line), reply.done()),  # type: ignore[arg-type, return-value]
    )
    server.start()
    try:
        with Client(tmp_path / "test.sock") as client:
            client.request("status")
            for op in ("stop", "excite"):
                with pytest.raises(DaemonError, match=f"{op}: this user may only watch"):
                    client.request(op)
            with pytest.raises(DaemonError, match="may only watch"):
                client.request("excite", session="x" * 2000)
        # Nor by hanging up before the answer.
        with socket.socket(socket.AF_UNIX) as hasty:
            hasty.connect(str(tmp_path / "test.sock"))
            hasty.sendall(b'{"op": "status"}\n' * 5 + b'{"op": "stop"}\n')
        with Client(tmp_path / "test.sock") as client:
            client.request("status")
    finally:
        server.close()
    assert set(asked) == {"status"}
    assert not long


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")
def test_other_user_is_refused_and_disconnected() -> None:
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        bench = Bench(Path(folder), Access(Service(allow_users=(54_322,))))
        readable, writable = os.pipe()
        try:
            child = os.fork()
            if child == 0:  # somebody else, with nothing of the test's but this pipe
                os.setgroups([])
                os.setgid(54_321)
                os.setuid(54_321)
                with bench.connect() as connection:
                    os.write(writable, connection.recv(1000))
                os._exit(0)
            os.waitpid(child, 0)
            assert b"user 54321 has no access" in os.read(readable, 1000)
            assert works(bench)
        finally:
            bench.server.close()


def test_socket_with_a_full_backlog_is_not_taken_over(tmp_path: Path) -> None:
    busy = socket.socket(socket.AF_UNIX)
    busy.bind(str(tmp_path / "test.sock"))
    busy.listen(1)
    waiting = []
    with contextlib.suppress(BlockingIOError):
        for _ in range(64):
            waiting.append(socket.socket(socket.AF_UNIX))
            waiting[-1].setblocking(False)
            waiting[-1].connect(str(tmp_path / "test.sock"))
    with pytest.raises(ServerError, match="another daemon"):
        Server(tmp_path / "test.sock", {}, Access(Service())).start()
    for end in [*waiting, busy]:
        end.close()


def test_allowed_users_can_reach_the_socket(bench: Bench) -> None:
    assert bench.path.stat().st_mode & 0o777 == 0o660
    bench.server.set_access(Access(Service(allow_users=["nobody"])))
    assert bench.path.stat().st_mode & 0o777 == 0o666


def test_refused_clients_take_no_connection(bench: Bench) -> None:
    mine = [bench.connect() for _ in range(64)]
    for connection in mine:
        bench.ask(connection, b'{"op": "echo"}')
    bench.server.set_access(_Nobody(Service()))
    with bench.connect() as stranger, contextlib.suppress(ConnectionError):
        assert stranger.recv(1) == b""
    assert [bench.ask(c, b'{"op": "echo"}')[0]["ok"] for c in mine] == [True] * 64
    for connection in mine:
        connection.close()


class _Only(Access):
    def __init__(self, role: Role) -> None:
        super().__init__(Service())
        self._role = role

    def role_of(self, peer: Peer) -> Role:
        return self._role


class _Nobody(Access):
    def refuses(self, peer: Peer) -> str:
        return "nobody may"
