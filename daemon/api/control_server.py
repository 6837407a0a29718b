"""The control socket: one JSON object a line, answered by one thread that no client can hold up."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from ..host.access_control import Access, peer_of
from ..ipc.json_lines import Closed, Lines, TooLong
from .unix_listener import WAITING_CLIENTS, Door, ServerError

__all__ = ["Handler", "Reply", "Server", "ServerError"]

LONGEST_LINE = 1 << 20
LONGEST_SHORT = 1024
"""Bytes of a request that is parsed here; a longer one is handed on as it is."""
_MOST_CLIENTS = 64
_MOST_UNREAD = 1 << 18
_BACK_OFF_S = 0.05
_LOOK_S = 1.0
"""How often it is looked whether clients still find the socket."""
_HEARD_OUT = frozenset(("stop", "land"))
"""What is done for clients too that are gone before they had an answer to what they asked first."""
_MOST_HEARD_OUT = 300
"""Lines of such a client that are looked into: whoever flooded the socket holds nobody up."""


class Reply:
    """The answer to one request, given at once or later, from any thread; never blocks.

    `gone` is called once, in the server's thread, if the client hangs up before its answer.
    """

    def __init__(self, server: Server, connection: _Connection) -> None:
        self._server, self._connection = server, connection
        self.gone: Callable[[], None] = lambda: None

    def send(self, message: Mapping[str, Any]) -> None:
        """Send a line before the answer."""
        self._server.post(self._connection, message, False)

    def done(self, **answer: Any) -> None:
        """Answer the request."""
        self._server.post(self._connection, {"ok": True, **answer}, True)

    def refuse(self, error: str) -> None:
        """Answer that it cannot be done, and why."""
        self._server.post(self._connection, refusal(error), True)

    @property
    def waiting(self) -> bool:
        """Whether somebody still waits for the answer."""
        return not self._connection.closed


Handler = Callable[[Mapping[str, Any], Reply], None]


class _Connection:
    def __init__(self, lines: Lines) -> None:
        self.lines = lines
        self.reply: Reply | None = None  # a request that is not answered yet
        self.used_s = time.monotonic()
        self.closed = False
        self.last_words = False  # hang up once all is sent


class Server:
    """Answers `{"op": NAME, ...}` with `{"ok": true, ...}` or `{"ok": false, "error": ...}`.

    A line of more than LONGEST_SHORT bytes is handed to `long` unread, and refused without one.
    Handlers run in the server's thread and must return at once: what takes time is answered later
    through the Reply. A client that sends nonsense or nothing, that takes no answer, or vanishes,
    costs its own connection only, and so does whatever goes wrong with one; where too many hold
    one, the one that was silent longest makes room.
    """

    def __init__(
        self,
        path: Path,
        handlers: Mapping[str, Handler],
        access: Access,
        say: Callable[[str], None] = lambda _: None,
        long: Callable[[bytes, Reply], None] | None = None,
    ) -> None:
        self._path, self._handlers, self.access, self._say = path, dict(handlers), access, say
        self._long = long
        self._door = Door(path)
        self._socket: socket.socket | None = None
        self._look_s, self._missed = 0.0, False
        self._selector = selectors.DefaultSelector()
        self._connections: list[_Connection] = []
        self._ready: deque[_Connection] = deque()  # may have a request to take up
        self._posted: deque[tuple[_Connection, Mapping[str, Any], bool]] = deque()
        self._woken, self._wake = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._ending = False
        self.asked = 0
        """Requests and connections since the start."""
        self._thread = threading.Thread(target=self._run, name="levid-server", daemon=True)

    @property
    def dead(self) -> bool:
        """Whether it has begun to answer, and does so no more."""
        return self._thread.ident is not None and not self._thread.is_alive()

    def start(self) -> None:
        """Open the socket and answer from now on; raises ServerError."""
        self._socket = self._door.open(self.access.mode)
        self._selector.register(self._socket, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._thread.start()

    def admit(self, access: Access) -> None:
        """Answer whom `access` lets in from now on."""
        self.access = access
        if self._door.in_place:
            with contextlib.suppress(OSError):
                self._path.chmod(access.mode)

    def close(self) -> None:
        """Send what is to be sent, as far as clients take it; stop answering, remove the socket."""
        self._ending = True
        self._wake_up()
        self._thread.join()
        # Not in the thread: one that died leaves them to those who still post.
        if self._socket is not None:
            self._socket.close()
        self._selector.close()
        (woken, self._woken), (wake, self._wake) = (self._woken, -1), (self._wake, -1)
        os.close(woken)
        os.close(wake)
        self._door.close()

    def post(self, connection: _Connection, message: Mapping[str, Any], final: bool) -> None:
        """Have a message sent; `final` is a request's answer. From any thread."""
        self._posted.append((connection, message, final))
        if threading.current_thread() is not self._thread:
            self._wake_up()

    def _wake_up(self) -> None:
        with contextlib.suppress(OSError):  # it is awake; or closed, and nobody is told any more
            os.write(self._wake, b"x")

    def _run(self) -> None:
        while not self._ending:
            for key, events in self._selector.select(0.0 if self._ready else _LOOK_S):
                if key.fileobj is self._socket:
                    self._accept_all()
                elif key.fileobj == self._woken:
                    with contextlib.suppress(BlockingIOError):
                        os.read(self._woken, 4096)
                else:
                    with self._at_its_cost(key.data):
                        self._serve(key.data, events)
            for _ in range(len(self._ready)):
                connection = self._ready.popleft()
                with self._at_its_cost(connection):
                    self._take_up(connection)
            self._deliver()
            self._look_at_door()
        for connection in list(self._connections):
            self._hang_up(connection)

    @contextlib.contextmanager
    def _at_its_cost(self, connection: _Connection) -> Iterator[None]:
        """Whatever goes wrong in here ends this connection, and no other."""
        try:
            yield
        except Exception:  # noqa: BLE001 - nobody else may stop a flight any more if this thread ends
            self._hang_up(connection)

    def _look_at_door(self) -> None:
        """Open the socket anew where its path has vanished, under a daemon that flies perhaps."""
        now_s = time.monotonic()
        if now_s - self._look_s < _LOOK_S:
            return
        self._look_s = now_s
        if self._door.in_place:
            self._missed = False
            return
        try:
            opened = self._door.open(self.access.mode)
        except ServerError as error:
            if not self._missed:
                self._missed = True
                self._say(f"clients find the control socket no more: {error}")
            return
        self._accept_all()  # who came to the old one
        if self._socket is not None:
            self._selector.unregister(self._socket)
            self._socket.close()
        self._socket = opened
        self._selector.register(opened, selectors.EVENT_READ)
        self._say(f"the control socket was gone: {self._path} is opened anew")

    def _accept_all(self) -> None:
        assert self._socket is not None
        for _ in range(WAITING_CLIENTS):
            try:
                accepted, _ = self._socket.accept()
            except OSError as error:
                if error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOMEM):
                    time.sleep(_BACK_OFF_S)  # it passes
                return
            with contextlib.suppress(Exception):  # it is closed as it is forgotten
                self._accept(accepted)

    def _accept(self, accepted: socket.socket) -> None:
        self.asked += 1
        try:
            refused = self.access.refuses(peer_of(accepted))
        except OSError as error:
            refused = f"cannot tell who asks: {error}"
        if len(self._connections) >= _MOST_CLIENTS:
            if refused:  # takes nobody's place
                accepted.close()
                return
            self._make_room()
        connection = _Connection(Lines(accepted, LONGEST_LINE, _MOST_UNREAD))
        self._selector.register(accepted, selectors.EVENT_READ, connection)
        self._connections.append(connection)
        if refused:
            connection.last_words = True
            with self._at_its_cost(connection):
                self._put(connection, refusal(refused))

    def _make_room(self) -> None:
        """Hang up on whoever was silent longest: rather one that waits for no answer."""
        silent = [c for c in self._connections if c.reply is None] or self._connections
        self._hang_up(min(silent, key=lambda c: c.used_s))

    def _serve(self, connection: _Connection, events: int) -> None:
        if connection.closed:
            return
        try:
            if events & selectors.EVENT_WRITE:
                connection.lines.flush()
                self._watch(connection)
            if events & selectors.EVENT_READ:
                connection.lines.receive()
                connection.used_s = time.monotonic()
                self._ready.append(connection)
        except TooLong:
            self._too_long(connection)
        except Closed:
            self._hang_up(connection)

    def _take_up(self, connection: _Connection) -> None:
        """Take up one request: those behind it wait for its answer, and for the others' turns."""
        if connection.reply is not None or connection.last_words or connection.closed:
            return
        try:
            line = connection.lines.next_line()
        except TooLong:
            self._too_long(connection)
            return
        if line is not None:
            self.asked += 1
            connection.reply = Reply(self, connection)
            self._handle(line, connection.reply)

    def _too_long(self, connection: _Connection) -> None:
        connection.last_words = True
        connection.lines.forget()
        self._put(connection, refusal(f"expected at most {LONGEST_LINE} bytes a request"))

    def _handle(self, line: bytes, reply: Reply, among: frozenset[str] | None = None) -> None:
        if len(line) > LONGEST_SHORT:
            if among is None:
                self._hand_on(line, reply)
            return
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            if among is None:
                reply.refuse("expected one JSON object a line")
            return
        op = request.get("op") if isinstance(request, dict) else None
        if among is not None and op not in among:
            return
        handler = self._handlers.get(op) if isinstance(op, str) else None
        if handler is None:
            reply.refuse(f"op: expected one of {', '.join(sorted(self._handlers))}, found {op!r}")
            return
        try:
            handler(request, reply)
        except Exception as error:  # noqa: BLE001 - whatever a request does, the daemon flies on
            reply.refuse(str(error) or type(error).__name__)

    def _hand_on(self, line: bytes, reply: Reply) -> None:
        if self._long is None:
            reply.refuse(f"expected at most {LONGEST_SHORT} bytes a request")
            return
        try:
            self._long(line, reply)
        except Exception as error:  # noqa: BLE001 - as with one that is read here
            reply.refuse(str(error) or type(error).__name__)

    def _deliver(self) -> None:
        """Send what was posted; a connection whose request is answered may take up the next."""
        while self._posted:
            connection, message, final = self._posted.popleft()
            if connection.closed:
                continue
            if final:
                connection.reply = None
                self._ready.append(connection)
            with self._at_its_cost(connection):
                self._put(connection, message)

    def _put(self, connection: _Connection, message: Mapping[str, Any]) -> None:
        try:
            connection.lines.put(message)
        except Closed:
            self._hang_up(connection)
        else:
            self._watch(connection)

    def _watch(self, connection: _Connection) -> None:
        """Wait for what this connection needs next."""
        lines = connection.lines
        if connection.last_words and not lines.wants_to_send:
            self._hang_up(connection)
            return
        # Whoever is about to be hung up on is not read any more, however much he says.
        events = 0 if connection.last_words else selectors.EVENT_READ
        if lines.wants_to_send:
            events |= selectors.EVENT_WRITE
        self._selector.modify(lines.socket, events, connection)

    def _hang_up(self, connection: _Connection) -> None:
        if connection.closed:
            return
        connection.closed = True
        if not connection.last_words:
            with contextlib.suppress(Exception):
                self._hear_out(connection)
        self._connections.remove(connection)
        with contextlib.suppress(KeyError, ValueError, OSError):
            self._selector.unregister(connection.lines.socket)
        with contextlib.suppress(OSError):
            connection.lines.close()
        if connection.reply is not None:
            with contextlib.suppress(Exception):
                connection.reply.gone()

    def _hear_out(self, connection: _Connection) -> None:
        """Take up what is to end a flight, from whoever said it and went."""
        lines = connection.lines
        with contextlib.suppress(Closed, TooLong):
            while lines.receive():
                pass
        for line in islice(lines.rest(tuple(map(str.encode, _HEARD_OUT))), _MOST_HEARD_OUT):
            self._handle(line, Reply(self, connection), _HEARD_OUT)


def refusal(error: str) -> dict[str, Any]:
    """Return the answer to a request that cannot be carried out."""
    return {"ok": False, "error": error}
