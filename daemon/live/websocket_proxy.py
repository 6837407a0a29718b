"""Pass connections to the Foxglove server that only this process knows the address of.

foxglove-sdk accepts each web page as a client. It therefore listens at a random address among the
16 million of the loopback network, and clients come through this proxy, which checks what their
browser says of them. A local program may find that address, but it may read the stream anyway.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable, Collection
from typing import cast

from .client_places import ClientPlaces, Place, Rank, listen
from .request_head import END, HEAD_BYTES, TIMEOUT_S, BadRequestError, parse_head, require_local

ADDRESS = "127.0.0.1"
MOST_CLIENTS = 32
_UNSENT_BYTES = 1 << 18
"""Bytes for a client that does not read, behind which the server discards its oldest messages."""


def hidden_address() -> str:
    """Return a random address of the loopback network."""
    first, second, third = (secrets.randbelow(254) + 1 for _ in range(3))
    return f"127.{first}.{second}.{third}"


class WebSocketProxy:
    """Serve `port` on 127.0.0.1 and pass clients on to (address, port) `target`.

    `refused` is called with the reason of each refusal.
    """

    def __init__(
        self,
        port: int,
        target: tuple[str, int],
        origins: Collection[str],
        refused: Callable[[str], None],
    ) -> None:
        self._port, self._target, self._origins, self._refused = port, target, origins, refused
        self.places = ClientPlaces(MOST_CLIENTS)

    async def start(self) -> asyncio.Server:
        """Listen; raises OSError."""
        return await listen(lambda: _Client(self), ADDRESS, self._port)

    def check(self, head: bytes) -> None:
        """Raise BadRequestError if a client with this head may not read the stream."""
        require_local(parse_head(head), self._origins)

    def refuse(self, client: asyncio.Transport, error: BadRequestError) -> None:
        """Answer a client that is refused, and disconnect it."""
        self._refused(f"refused a client of the live stream: {error}")
        answer = f"HTTP/1.1 {error.status} Refused\r\nConnection: close\r\n\r\n{error}\n"
        client.write(answer.encode())
        client.close()

    @property
    def target(self) -> tuple[str, int]:
        """Address and port of the server."""
        return self._target


class _Side(asyncio.Protocol):
    """One side of a connection; it reads no faster than the other side writes."""

    def __init__(self) -> None:
        self.transport: asyncio.Transport | None = None
        self.other: _Side | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        self.transport.set_write_buffer_limits(_UNSENT_BYTES)

    def data_received(self, data: bytes) -> None:
        if self.other is not None and self.other.transport is not None:
            self.other.transport.write(data)

    def connection_lost(self, error: Exception | None) -> None:  # noqa: ARG002
        self.transport, other, self.other = None, self.other, None
        if other is not None and other.transport is not None:
            other.transport.close()

    def pause_writing(self) -> None:
        if self.other is not None and self.other.transport is not None:
            self.other.transport.pause_reading()

    def resume_writing(self) -> None:
        if self.other is not None and self.other.transport is not None:
            self.other.transport.resume_reading()


class _Client(_Side):
    """A client: its head is checked before the server gets its first byte."""

    def __init__(self, proxy: WebSocketProxy) -> None:
        super().__init__()
        self._proxy, self._head, self._checked = proxy, b"", False
        self._place: Place | None = None
        self._deadline: asyncio.TimerHandle | None = None
        self._connecting: asyncio.Task[None] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        assert self.transport is not None
        self._place = self._proxy.places.enter(self.transport.abort)
        loop = asyncio.get_running_loop()
        self._deadline = loop.call_later(TIMEOUT_S, transport.close)

    def data_received(self, data: bytes) -> None:
        if self._checked:
            super().data_received(data)
            return
        self._head += data
        end = self._head.find(END)
        assert self.transport is not None
        try:
            if max(end, len(self._head) if end < 0 else 0) > HEAD_BYTES:
                raise BadRequestError(431, f"expected headers of at most {HEAD_BYTES} bytes")
            if end < 0:
                return
            self._proxy.check(self._head[: end + len(END)])
        except BadRequestError as error:
            self._proxy.refuse(self.transport, error)
            return
        self._checked = True
        if self._place is not None:
            self._place.set_rank(Rank.READS)
        self.transport.pause_reading()
        self._connecting = asyncio.get_running_loop().create_task(self._connect(self.transport))

    def connection_lost(self, error: Exception | None) -> None:
        super().connection_lost(error)
        if self._place is not None:
            self._place.leave()
        self._stop_deadline()

    async def _connect(self, transport: asyncio.Transport) -> None:
        self._stop_deadline()
        try:
            server, side = await asyncio.get_running_loop().create_connection(
                _Side, *self._proxy.target
            )
        except OSError:
            transport.close()
            return
        if self.transport is None:  # it disconnected meanwhile
            server.close()
            return
        self.other, side.other = side, self
        server.write(self._head)
        transport.resume_reading()

    def _stop_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
