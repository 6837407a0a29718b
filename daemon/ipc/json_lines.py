"""Exchange JSON lines over a non-blocking socket, between processes and with clients."""

from __future__ import annotations

import json
import re
import socket
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

_BLOCK_BYTES = 65_536


class Closed(Exception):  # noqa: N818 - the end of a connection is no error
    """Report that the peer hung up, or does not read what it is sent."""


class TooLong(Exception):  # noqa: N818
    """Report a line that exceeds the agreed length."""


class Lines:
    """Buffer lines of a socket in both directions: `max_in` bytes a line, `max_out` unsent."""

    def __init__(self, end: socket.socket, max_in: int, max_out: int) -> None:
        end.setblocking(False)
        self.socket = end
        self._max_in, self._max_out = max_in, max_out
        self._in, self._out = bytearray(), bytearray()
        self._searched = 0

    @property
    def wants_to_send(self) -> bool:
        """Whether unsent bytes remain."""
        return bool(self._out)

    def receive(self) -> bool:
        """Read available bytes; return whether any came. Raises Closed and TooLong."""
        try:
            data = self.socket.recv(_BLOCK_BYTES)
        except (BlockingIOError, InterruptedError):
            return False
        except OSError as error:
            raise Closed(str(error)) from None
        if not data:
            raise Closed("the peer hung up")
        self._in += data
        if len(self._in) > 2 * self._max_in:
            raise TooLong
        return True

    def next_line(self) -> bytes | None:
        """Return the oldest complete line, None if there is none; raises TooLong."""
        end = self._in.find(b"\n", self._searched)
        if max(end, len(self._in) if end < 0 else 0) > self._max_in:
            raise TooLong
        if end < 0:
            self._searched = len(self._in)
            return None
        line = bytes(self._in[:end])
        del self._in[: end + 1]
        self._searched = 0
        return line

    def discard(self) -> None:
        """Discard all received bytes."""
        self._in.clear()
        self._searched = 0

    def lines(self) -> Iterator[bytes]:
        """Yield the complete lines received so far; raises TooLong."""
        while (line := self.next_line()) is not None:
            yield line

    def lines_with(self, words: Iterable[bytes]) -> Iterator[bytes]:
        """Yield the complete lines that contain one of `words`; discard all other lines.

        The search is fast: two million empty lines are skipped at once.
        """
        data, at = bytes(self._in), 0
        self.discard()
        pattern = re.compile(b"|".join(map(re.escape, words)))
        while found := pattern.search(data, at):
            begin = max(data.rfind(b"\n", at, found.start()) + 1, at)
            at = data.find(b"\n", found.end()) + 1
            if not at:
                return
            yield data[begin : at - 1]

    def put(self, message: Mapping[str, Any]) -> None:
        """Send or buffer a message; raises Closed if too many bytes are unsent."""
        self._out += json.dumps(message).encode() + b"\n"
        self.flush()
        if len(self._out) > self._max_out:
            raise Closed("the peer does not read")

    def flush(self) -> None:
        """Send as many bytes as the socket accepts; raises Closed."""
        while self._out:
            try:
                sent = self.socket.send(self._out[:_BLOCK_BYTES])
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                raise Closed(str(error)) from None
            del self._out[:sent]

    def close(self) -> None:
        """Close the socket."""
        self.socket.close()
