"""Send requests to the supervisor over a connection that was inherited from it, with its role."""

from __future__ import annotations

import asyncio
import json
import socket
from typing import Any

_LINE_BYTES = 1 << 20


class RefusedByDaemonError(Exception):
    """Report that the daemon refused a request, and why."""


class ControlLink:
    """Ask the daemon, one request at a time: the daemon reads the next one after its answer."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._turn = asyncio.Lock()

    async def open(self) -> None:
        """Use the socket in the running event loop."""
        self._streams = await asyncio.open_connection(sock=self._end, limit=_LINE_BYTES)

    @property
    def busy(self) -> bool:
        """Whether a request waits for its answer."""
        return self._turn.locked()

    async def ask(self, op: str, **more: Any) -> dict[str, Any]:
        """Return the answer to a request; progress before it is skipped.

        Raises:
            RefusedByDaemonError: the daemon refuses it.
            ConnectionError: the daemon closed the connection.
        """
        assert self._streams is not None
        reader, writer = self._streams
        async with self._turn:
            writer.write(json.dumps({"op": op, **more}).encode() + b"\n")
            await writer.drain()
            while line := await reader.readline():
                answer: dict[str, Any] = json.loads(line)
                if "ok" not in answer:
                    continue
                if not answer["ok"]:
                    raise RefusedByDaemonError(str(answer.get("error", "")))
                return answer
        raise ConnectionError("the daemon closed the connection")
