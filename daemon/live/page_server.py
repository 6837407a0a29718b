"""Serve the rig page: one HTML file, its data as server-sent events, and requests as POST.

A stop always has a place: connections that send no request, then those that read longest, give way.

A request that changes something needs the page's own token, which pages of other sites cannot read
(CSRF), and an `Origin` of this server. All but a stop also need the token of the user, which stands
in a file that only this user can read.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import secrets
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import Any

from .client_places import ClientPlaces, Place, Rank, listen
from .control_link import RefusedByDaemonError
from .request_head import HEAD_BYTES, BadRequestError, Head, read_head, require_local
from .websocket_proxy import ADDRESS

Request = Callable[[Mapping[str, Any]], Awaitable[Mapping[str, Any]]]
"""Executes a request with the values of its JSON body; returns the daemon's answer."""

MOST_CLIENTS = 32
_BODY_BYTES = 1024
_BODY_S = 5.0
_UNSENT_BYTES = 1 << 18
"""Unsent bytes at which a page that does not read is disconnected: half a minute of events."""
_STOP = "stop"
_REASONS = {200: "OK", 400: "Bad Request", 403: "Forbidden", 404: "Not Found", 409: "Conflict"}
_SAFE = (
    "X-Content-Type-Options: nosniff",
    "Referrer-Policy: no-referrer",
    "Cross-Origin-Resource-Policy: same-origin",
    "Cross-Origin-Opener-Policy: same-origin",
    "Cache-Control: no-store",
)


class PageServer:
    """Serve `html` on a port of 127.0.0.1, and its requests by name.

    Args:
        port: the port.
        html: the page; `{{nonce}}` is replaced, which lets its script and style run.
        requests: requests by name; `stop` needs no user token.
        token: the user's token; without it only `stop` is served.
        greeting: returns the events with which a new page begins.
        refused: called with the reason of each request that is refused.
    """

    def __init__(
        self,
        port: int,
        html: str,
        requests: Mapping[str, Request],
        token: str,
        greeting: Callable[[], Iterable[bytes]],
        refused: Callable[[str], None],
    ) -> None:
        self._port, self._html, self._requests, self._token = port, html, requests, token
        self._greeting, self._refused = greeting, refused
        self.page_token = secrets.token_urlsafe(32)
        """Token of all pages; they read it from the event `rig`."""
        self._places = ClientPlaces(MOST_CLIENTS)
        self._watching: set[asyncio.StreamWriter] = set()

    async def start(self) -> asyncio.Server:
        """Listen; raises OSError."""

        def protocol() -> asyncio.StreamReaderProtocol:
            reader = asyncio.StreamReader(limit=HEAD_BYTES)
            return asyncio.StreamReaderProtocol(reader, self._serve)

        return await listen(protocol, ADDRESS, self._port)

    @property
    def watched(self) -> bool:
        """Whether a page is open."""
        return bool(self._watching)

    def send(self, event: bytes) -> None:
        """Send an event to all pages; disconnect those that do not read."""
        for writer in tuple(self._watching):
            if writer.transport.get_write_buffer_size() > _UNSENT_BYTES:
                writer.transport.abort()
            elif not writer.is_closing():
                writer.write(event)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        place = self._places.enter(writer.transport.abort)
        try:
            if place is None:
                raise BadRequestError(503, f"{MOST_CLIENTS} requests are executed, the limit")
            head = await read_head(reader)
            if head is not None:
                require_local(head)
                await self._answer(head, reader, writer, place)
        except BadRequestError as error:
            self._refused(f"refused a request of a page: {error}")
            with contextlib.suppress(OSError):
                await _reply_json(writer, error.status, {"error": str(error)})
        except (OSError, asyncio.IncompleteReadError):
            pass  # it disconnected
        finally:
            if place is not None:
                place.leave()
            writer.close()

    async def _answer(
        self, head: Head, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, place: Place
    ) -> None:
        path = head.path.partition("?")[0]
        if head.method == "GET" and path == "/":
            await self._show(writer)
        elif head.method == "GET" and path == "/events":
            place.set_rank(Rank.READS)
            await self._stream(reader, writer)
        elif head.method == "POST" and path.removeprefix("/") in self._requests:
            values = await self._permitted(path.removeprefix("/"), head, reader)
            place.set_rank(Rank.ASKS)
            await _reply_json(writer, *await self._execute(path.removeprefix("/"), values))
        else:
            raise BadRequestError(404, f"{head.method[:8]} {path[:40]}: no such page or request")

    async def _show(self, writer: asyncio.StreamWriter) -> None:
        nonce = secrets.token_urlsafe(16)
        policy = (
            f"Content-Security-Policy: default-src 'none'; script-src 'nonce-{nonce}'; "
            f"style-src 'nonce-{nonce}'; connect-src 'self'; img-src data:; base-uri 'none'; "
            "form-action 'none'; frame-ancestors 'none'"
        )
        html = self._html.replace("{{nonce}}", nonce)
        await _reply(writer, 200, "text/html; charset=utf-8", html.encode(), policy)

    async def _stream(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = ("HTTP/1.1 200 OK", "Content-Type: text/event-stream", *_SAFE, "Connection: close")
        writer.write("\r\n".join((*head, "", "")).encode())
        for event in self._greeting():
            writer.write(event)
        self._watching.add(writer)
        try:
            while await reader.read(HEAD_BYTES):  # a page sends nothing: wait for its end
                pass
        finally:
            self._watching.discard(writer)

    async def _permitted(
        self, name: str, head: Head, reader: asyncio.StreamReader
    ) -> Mapping[str, Any]:
        """Return the body of a request that its sender may ask for; raises BadRequestError."""
        if "origin" not in head.headers:
            raise BadRequestError(403, f"{name}: expected the header Origin of this page")
        if not _same(head.headers.get("x-levid-page", ""), self.page_token):
            raise BadRequestError(403, f"{name}: reload this page: the live view was restarted")
        given = head.headers.get("x-levid-token", "")
        if name != _STOP and not (self._token and _same(given, self._token)):
            raise BadRequestError(
                403, f"{name}: expected the token from the file that `levid run` names"
            )
        length = head.headers.get("content-length", "0")
        if not length.isdecimal() or int(length) > _BODY_BYTES:
            raise BadRequestError(400, f"{name}: expected a body of at most {_BODY_BYTES} bytes")
        try:
            async with asyncio.timeout(_BODY_S):
                body = await reader.readexactly(int(length))
            values = json.loads(body or b"{}")
        except (TimeoutError, ValueError, RecursionError):
            raise BadRequestError(400, f"{name}: expected a body of JSON") from None
        if not isinstance(values, dict):
            raise BadRequestError(400, f"{name}: expected a JSON object")
        return values

    async def _execute(self, name: str, values: Mapping[str, Any]) -> tuple[int, Mapping[str, Any]]:
        try:
            return 200, await self._requests[name](values)
        except RefusedByDaemonError as error:
            return 409, {"error": str(error)}


def event_bytes(name: str, data: Any) -> bytes:
    """Return a server-sent event with JSON data."""
    return f"event: {name}\ndata: {json.dumps(data, separators=(',', ':'))}\n\n".encode()


def _same(given: str, expected: str) -> bool:
    return hmac.compare_digest(given.encode(), expected.encode())


async def _reply_json(writer: asyncio.StreamWriter, status: int, answer: Mapping[str, Any]) -> None:
    await _reply(writer, status, "application/json", json.dumps(answer).encode())


async def _reply(
    writer: asyncio.StreamWriter, status: int, kind: str, body: bytes, *headers: str
) -> None:
    lines = (
        f"HTTP/1.1 {status} {_REASONS.get(status, 'Refused')}",
        f"Content-Type: {kind}",
        f"Content-Length: {len(body)}",
        *_SAFE,
        *headers,
        "Connection: close",
    )
    writer.write("\r\n".join((*lines, "", "")).encode() + body)
    await writer.drain()
