"""Read the head of an HTTP request, and refuse what a web page of another site could send.

A browser sends requests of any page to this machine. It states that page in the header `Origin`,
and the name that the page used for this machine in `Host`: a name other than localhost is DNS
rebinding, where a site gives its own name the address 127.0.0.1.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Mapping
from dataclasses import dataclass

HEAD_BYTES = 8192
"""Longest head, which is the limit of the stream reader as well."""
TIMEOUT_S = 5.0
"""Time limit of a head."""
END = b"\r\n\r\n"
_LOCAL = frozenset(("localhost", "127.0.0.1"))
_CROSS = frozenset(("cross-site", "same-site"))


class BadRequestError(Exception):
    """Report a request that is not answered: its HTTP status and the reason."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


@dataclass(frozen=True)
class Head:
    """Hold method, path and headers (names in lower case) of a request; `raw` has its bytes."""

    method: str
    path: str
    headers: Mapping[str, str]
    raw: bytes


async def read_head(reader: asyncio.StreamReader) -> Head | None:
    """Read one head; None if none comes: browsers connect in advance. Raises BadRequestError."""
    try:
        async with asyncio.timeout(TIMEOUT_S):
            raw = await reader.readuntil(END)
    except (asyncio.IncompleteReadError, TimeoutError):
        return None
    except asyncio.LimitOverrunError:
        raise BadRequestError(431, f"expected headers of at most {HEAD_BYTES} bytes") from None
    return parse_head(raw)


def parse_head(raw: bytes) -> Head:
    """Return the head with these bytes; raises BadRequestError."""
    first, *lines = raw.removesuffix(END).decode("latin-1").split("\r\n")
    words = first.split(" ")
    if len(words) != 3 or not words[2].startswith("HTTP/1."):
        raise BadRequestError(400, "expected an HTTP/1.1 request")
    headers: dict[str, str] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        name = name.lower()
        if not colon or name != name.strip() or name in headers:
            raise BadRequestError(400, "expected each header once, as 'Name: value'")
        headers[name] = value.strip()
    return Head(words[0], words[1], headers, raw)


def require_local(head: Head, origins: Collection[str] = ()) -> None:
    """Refuse a request whose page is neither served by this machine nor one of `origins`.

    Raises:
        BadRequestError: `Host` is not localhost, or `Origin` is another page.
    """
    host = head.headers.get("host", "")
    name, _, port = host.partition(":")
    if name.lower() not in _LOCAL or not (port.isdecimal() or not port):
        raise BadRequestError(
            421, f"Host: expected localhost or 127.0.0.1, found '{host[:80]}'; see docs/live.md"
        )
    origin = head.headers.get("origin")
    if origin is not None and origin != f"http://{host}" and origin not in origins:
        raise BadRequestError(
            403, f"Origin: '{origin[:80]}' may not use this; see live.origins in RIG.yaml"
        )
    if head.headers.get("sec-fetch-site") in _CROSS and origin is None and not _navigates(head):
        raise BadRequestError(403, "requests of pages of other sites are refused")


def _navigates(head: Head) -> bool:
    """Return whether a user follows a link here, which shows the page but reads nothing."""
    return head.headers.get("sec-fetch-mode") == "navigate"
