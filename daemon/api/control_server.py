"""Serve the control socket: JSON lines, answered by one thread that no client can block."""

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

from ..host.peer_credentials import Access, Role, forbidden, peer_of
from ..host.rate_limited_log import RateLimitedLog
from ..ipc.json_lines import Closed, Lines, TooLong
from .unix_listener import WAITING_CLIENTS, ServerError, UnixListener

__all__ = ["Handler", "Reply", "Server", "ServerError"]

LONGEST_LINE = 1 << 20
LONGEST_SHORT = 1024
"""Longest request in bytes that is parsed here; longer requests are passed to `on_long`."""
_MAX_CLIENTS = 64
_MAX_UNREAD = 1 << 18
_BACK_OFF_S = 0.05
"""Interval of checking that the socket path still exists."""
_EXECUTED_AFTER_HANG_UP = frozenset(("stop", "land"))
"""Operations that are executed even if the client disconnected before they were reached."""
_MAX_LINES_AFTER_HANG_UP = 300
"""Lines of a disconnected client that are searched for them: limits the effect of a flood."""


class Reply:
    """Answer one request, now or later, from any thread; never blocks.

    `on_hang_up` is called once, in the server thread, if the client disconnects before the answer.
    """

    def __init__(self, server: Server, connection: _Connection) -> None:
        self._server, self._connection = server, connection
        self.on_hang_up: Callable[[], None] = lambda: None

    def send(self, message: Mapping[str, Any]) -> None:
        """Send a progress line before the answer."""
        self._server.post(self._connection, message, False)

    def done(self, **answer: Any) -> None:
        """Answer that the request succeeded."""
        self._server.post(self._connection, {"ok": True, **answer}, True)

    def refuse(self, error: str) -> None:
        """Answer that the request is refused, with the reason."""
        self._server.post(self._connection, refusal(error), True)

    @property
    def role(self) -> Role:
        """What the client may do."""
        return self._connection.role

    @property
    def waiting(self) -> bool:
        """Whether the client is still connected."""
        return not self._connection.closed


Handler = Callable[[Mapping[str, Any], Reply], None]


class _Connection:
    def __init__(self, lines: Lines, role: Role, ours: bool = False) -> None:
        self.lines, self.role = lines, role
        self.ours = ours  # of a process of this daemon: never closed to make room
        self.reply: Reply | None = None  # of the request in progress
        self.used_s = time.monotonic()
        self.closed = False
        self.close_after_send = False


class Server:
    """Answer `{"op": NAME, ...}` with `{"ok": true, ...}` or `{"ok": false, "error": ...}`.

    A line longer than LONGEST_SHORT bytes is passed to `on_long` unparsed, or refused if that is
    None. Handlers run in the server thread and must return at once; they answer slow requests later
    through the Reply. An invalid request, a client that does not read, or any error closes that
    connection only. With too many connections, one gives way to a new client: of the lowest role,
    without a pending request if possible, idle longest; never one of a higher role than the new
    client. A removed socket is restored within `poll_s`.
    """

    def __init__(
        self,
        path: Path,
        handlers: Mapping[str, Handler],
        access: Access,
        log: Callable[[str], None] = lambda _: None,
        on_long: Callable[[bytes, Reply], None] | None = None,
        poll_s: float = 1.0,
    ) -> None:
        self._path, self._handlers, self.access = path, dict(handlers), access
        self._rarely = RateLimitedLog(log)
        self._on_long, self._poll_s = on_long, poll_s
        self._listener = UnixListener(path)
        self._socket: socket.socket | None = None
        self._polled_s, self._reported_missing = 0.0, False
        self._selector = selectors.DefaultSelector()
        self._connections: list[_Connection] = []
        self._ready: deque[_Connection] = deque()  # may have a request to handle
        self._adopted: deque[_Connection] = deque()
        self._posted: deque[tuple[_Connection, Mapping[str, Any], bool]] = deque()
        self._wake_read, self._wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._ending = False
        self.requests = 0
        """Requests and connections since the start."""
        self._thread = threading.Thread(target=self._run, name="levid-server", daemon=True)

    @property
    def dead(self) -> bool:
        """Whether the server thread was started and has ended."""
        return self._thread.ident is not None and not self._thread.is_alive()

    def start(self) -> None:
        """Open the socket and start the server thread; raises ServerError."""
        self._socket = self._listener.open(self.access.mode)
        self._selector.register(self._socket, selectors.EVENT_READ)
        self._selector.register(self._wake_read, selectors.EVENT_READ)
        self._thread.start()

    def set_access(self, access: Access) -> None:
        """Apply `access` to new connections."""
        self.access = access
        self._listener.set_mode(access.mode)

    def adopt(self, end: socket.socket, role: Role) -> Callable[[], float | None]:
        """Serve a connected socket as a client with this role; call from any thread.

        Returns a function that gives the monotonic time of its last request, in s, or None once it
        is disconnected.
        """
        connection = _Connection(Lines(end, LONGEST_LINE, _MAX_UNREAD), role, ours=True)
        self._adopted.append(connection)
        self._wake_up()
        return lambda: None if connection.closed else connection.used_s

    def close(self) -> None:
        """Send pending messages as far as clients read them, stop the thread, remove the socket."""
        self._ending = True
        self._wake_up()
        self._thread.join()
        # Not in the thread: if it died, other threads still post through these.
        if self._socket is not None:
            self._socket.close()
        self._selector.close()
        wake_read, wake_write = self._wake_read, self._wake_write
        self._wake_read = self._wake_write = -1
        os.close(wake_read)
        os.close(wake_write)
        self._listener.close()

    def post(self, connection: _Connection, message: Mapping[str, Any], final: bool) -> None:
        """Queue a message for sending, from any thread; `final` marks the answer to a request."""
        self._posted.append((connection, message, final))
        if threading.current_thread() is not self._thread:
            self._wake_up()

    def _wake_up(self) -> None:
        with contextlib.suppress(OSError):  # awake already, or closed
            os.write(self._wake_write, b"x")

    def _run(self) -> None:
        while not self._ending:
            for key, events in self._selector.select(0.0 if self._ready else self._poll_s):
                if key.fileobj is self._socket:
                    self._accept_all()
                elif key.fileobj == self._wake_read:
                    with contextlib.suppress(BlockingIOError):
                        os.read(self._wake_read, 4096)
                else:
                    with self._hang_up_on_error(key.data):
                        self._serve(key.data, events)
            for _ in range(len(self._ready)):
                connection = self._ready.popleft()
                with self._hang_up_on_error(connection):
                    self._handle_next(connection)
            self._send_posted()
            while self._adopted:
                connection = self._adopted.popleft()
                self._selector.register(connection.lines.socket, selectors.EVENT_READ, connection)
                self._connections.append(connection)
            self._restore_socket()
        for connection in list(self._connections):
            self._hang_up(connection)

    @contextlib.contextmanager
    def _hang_up_on_error(self, connection: _Connection) -> Iterator[None]:
        """Close this connection, and no other, on any error in the block."""
        try:
            yield
        except Exception:  # noqa: BLE001 - without this thread no client can stop a flight
            self._hang_up(connection)

    def _restore_socket(self) -> None:
        """Open the socket again if its path was removed, possibly in flight."""
        now_s = time.monotonic()
        if now_s - self._polled_s < self._poll_s:
            return
        self._polled_s = now_s
        self._rarely.flush(now_s)
        if self._listener.in_place:
            self._reported_missing = False
            return
        try:
            opened = self._listener.open(self.access.mode)
        except ServerError as error:
            if not self._reported_missing:
                self._reported_missing = True
                self._rarely.line(
                    "lost", now_s, f"the control socket was removed and cannot be restored: {error}"
                )
            return
        self._accept_all()  # clients that connected to the old socket
        if self._socket is not None:
            self._selector.unregister(self._socket)
            self._socket.close()
        self._socket = opened
        self._selector.register(opened, selectors.EVENT_READ)
        self._rarely.line(
            "removed", now_s, f"the control socket was removed: {self._path} is open again"
        )

    def _accept_all(self) -> None:
        assert self._socket is not None
        for _ in range(WAITING_CLIENTS):
            try:
                accepted, _ = self._socket.accept()
            except OSError as error:
                if error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOMEM):
                    time.sleep(_BACK_OFF_S)  # descriptors or memory may become free
                return
            with contextlib.suppress(Exception):  # the socket is closed when it is released
                self._accept(accepted)

    def _accept(self, accepted: socket.socket) -> None:
        self.requests += 1
        role = Role.NONE
        try:
            peer = peer_of(accepted)
            role, refused = self.access.role_of(peer), self.access.refuses(peer)
        except OSError as error:
            refused = f"cannot determine the user of this connection: {error}"
        full = len(self._connections) >= _MAX_CLIENTS
        if full and (refused or not self._make_room(role)):  # it must not displace another client
            accepted.close()
            return
        connection = _Connection(Lines(accepted, LONGEST_LINE, _MAX_UNREAD), role)
        self._selector.register(accepted, selectors.EVENT_READ, connection)
        self._connections.append(connection)
        if refused:
            connection.close_after_send = True
            with self._hang_up_on_error(connection):
                self._put(connection, refusal(refused))

    def _make_room(self, role: Role) -> bool:
        """Close the connection that gives way to a new client; return whether there is one."""
        clients = [c for c in self._connections if not c.ours and c.role <= role]
        if not clients:
            return False
        self._hang_up(min(clients, key=lambda c: (c.role, c.reply is not None, c.used_s)))
        return True

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

    def _handle_next(self, connection: _Connection) -> None:
        """Handle one request of a connection; its next one waits for the answer."""
        if connection.reply is not None or connection.close_after_send or connection.closed:
            return
        try:
            line = connection.lines.next_line()
        except TooLong:
            self._too_long(connection)
            return
        if line is not None:
            self.requests += 1
            connection.reply = Reply(self, connection)
            self._handle(line, connection.reply)

    def _too_long(self, connection: _Connection) -> None:
        connection.close_after_send = True
        connection.lines.discard()
        self._put(connection, refusal(f"expected a request of at most {LONGEST_LINE} bytes"))

    def _handle(self, line: bytes, reply: Reply, only: frozenset[str] | None = None) -> None:
        if len(line) > LONGEST_SHORT:
            if only is None:
                self._handle_long(line, reply)
            return
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            if only is None:
                reply.refuse("expected one line with a JSON object that has 'op'")
            return
        op = request.get("op") if isinstance(request, dict) else None
        if only is not None and op not in only:
            return
        handler = self._handlers.get(op) if isinstance(op, str) else None
        if handler is None:
            reply.refuse(f"op: expected one of {', '.join(sorted(self._handlers))}, found {op!r}")
            return
        if refused := forbidden(reply.role, str(op)):
            reply.refuse(refused)
            return
        try:
            handler(request, reply)
        except Exception as error:  # noqa: BLE001 - no request may end the daemon
            reply.refuse(str(error) or type(error).__name__)

    def _handle_long(self, line: bytes, reply: Reply) -> None:
        if self._on_long is None:
            reply.refuse(f"expected a request of at most {LONGEST_SHORT} bytes")
            return
        if refused := forbidden(reply.role, "excite, levitate and move"):
            reply.refuse(refused)
            return
        try:
            self._on_long(line, reply)
        except Exception as error:  # noqa: BLE001 - no request may end the daemon
            reply.refuse(str(error) or type(error).__name__)

    def _send_posted(self) -> None:
        """Send posted messages; after a final one, the connection's next request may follow."""
        while self._posted:
            connection, message, final = self._posted.popleft()
            if connection.closed:
                continue
            if final:
                connection.reply = None
                self._ready.append(connection)
            with self._hang_up_on_error(connection):
                self._put(connection, message)

    def _put(self, connection: _Connection, message: Mapping[str, Any]) -> None:
        try:
            connection.lines.put(message)
        except Closed:
            self._hang_up(connection)
        else:
            self._watch(connection)

    def _watch(self, connection: _Connection) -> None:
        """Select the events that this connection waits for."""
        lines = connection.lines
        if connection.close_after_send and not lines.wants_to_send:
            self._hang_up(connection)
            return
        # A connection that is about to be closed is no longer read.
        events = 0 if connection.close_after_send else selectors.EVENT_READ
        if lines.wants_to_send:
            events |= selectors.EVENT_WRITE
        self._selector.modify(lines.socket, events, connection)

    def _hang_up(self, connection: _Connection) -> None:
        if connection.closed:
            return
        connection.closed = True
        if not connection.close_after_send:
            with contextlib.suppress(Exception):
                self._execute_pending_stops(connection)
        self._connections.remove(connection)
        with contextlib.suppress(KeyError, ValueError, OSError):
            self._selector.unregister(connection.lines.socket)
        with contextlib.suppress(OSError):
            connection.lines.close()
        if connection.reply is not None:
            with contextlib.suppress(Exception):
                connection.reply.on_hang_up()

    def _execute_pending_stops(self, connection: _Connection) -> None:
        """Execute requests to stop or land that a disconnected client sent before."""
        lines = connection.lines
        with contextlib.suppress(Closed, TooLong):
            while lines.receive():
                pass
        names = tuple(map(str.encode, _EXECUTED_AFTER_HANG_UP))
        for line in islice(lines.lines_with(names), _MAX_LINES_AFTER_HANG_UP):
            self._handle(line, Reply(self, connection), _EXECUTED_AFTER_HANG_UP)


def refusal(error: str) -> dict[str, Any]:
    """Return the answer that refuses a request."""
    return {"ok": False, "error": error}
