"""JSON objects, one a line, over a socket that never blocks: between processes, and to clients."""

from __future__ import annotations

import json
import re
import socket
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

_PIECE = 65_536


class Closed(Exception):  # noqa: N818 - the end of a conversation is no error
    """The other end hung up, or takes too little of what it is sent."""


class TooLong(Exception):  # noqa: N818
    """A line that is longer than agreed."""


class Lines:
    """One end of a conversation, with bounds on what is kept in either direction."""

    def __init__(self, end: socket.socket, most_in: int, most_out: int) -> None:
        end.setblocking(False)
        self.socket = end
        self._most_in, self._most_out = most_in, most_out
        self._in, self._out = bytearray(), bytearray()
        self._searched = 0

    @property
    def wants_to_send(self) -> bool:
        """Whether something waits to be sent."""
        return bool(self._out)

    def receive(self) -> bool:
        """Take in what has come, if anything; raises Closed at the end, TooLong at too much."""
        try:
            data = self.socket.recv(_PIECE)
        except (BlockingIOError, InterruptedError):
            return False
        except OSError as error:
            raise Closed(str(error)) from None
        if not data:
            raise Closed("the other end hung up")
        self._in += data
        if len(self._in) > 2 * self._most_in:
            raise TooLong
        return True

    def next_line(self) -> bytes | None:
        """Return the oldest whole line that has come, if there is one; raises TooLong."""
        end = self._in.find(b"\n", self._searched)
        if max(end, len(self._in) if end < 0 else 0) > self._most_in:
            raise TooLong
        if end < 0:
            self._searched = len(self._in)
            return None
        line = bytes(self._in[:end])
        del self._in[: end + 1]
        self._searched = 0
        return line

    def forget(self) -> None:
        """Drop what has come: nobody will take it up."""
        self._in.clear()
        self._searched = 0

    def lines(self) -> Iterator[bytes]:
        """Yield the whole lines that have come; raises TooLong."""
        while (line := self.next_line()) is not None:
            yield line

    def rest(self, words: Iterable[bytes]) -> Iterator[bytes]:
        """Yield the whole lines that have come and hold one of these words; no others will be read.

        Two million empty ones are passed over at once.
        """
        data, at = bytes(self._in), 0
        self.forget()
        pattern = re.compile(b"|".join(map(re.escape, words)))
        while found := pattern.search(data, at):
            begin = max(data.rfind(b"\n", at, found.start()) + 1, at)
            at = data.find(b"\n", found.end()) + 1
            if not at:
                return
            yield data[begin : at - 1]

    def put(self, message: Mapping[str, Any]) -> None:
        """Send a message, or keep it until there is room; raises Closed where too much is kept."""
        self._out += json.dumps(message).encode() + b"\n"
        self.flush()
        if len(self._out) > self._most_out:
            raise Closed("the other end takes nothing")

    def flush(self) -> None:
        """Send what can be sent; raises Closed."""
        while self._out:
            try:
                sent = self.socket.send(self._out[:_PIECE])
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                raise Closed(str(error)) from None
            del self._out[:sent]

    def close(self) -> None:
        """Hang up."""
        self.socket.close()
