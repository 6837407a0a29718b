"""Cuts a stream of bytes into frames at its zeros, and is in step again after anything."""

from __future__ import annotations


class FrameStream:
    """What arrives on a port, as whole blocks between zeros.

    A block longer than `longest` (what lies between two zeros that were lost, say) is thrown away
    up to the next zero, so that memory is bounded whatever comes.
    """

    def __init__(self, longest: int) -> None:
        self._longest = longest
        self._rest = b""
        self.overlong = 0
        """How many blocks were thrown away for their length."""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the blocks that `data` completes, without their zeros; empty ones are left out."""
        *blocks, rest = (self._rest + data).split(b"\0")
        if len(rest) > self._longest:
            # Keep one byte too many: when its zero comes, the block is refused for its length.
            rest = rest[: self._longest + 1]
        self._rest = rest
        whole = []
        for block in blocks:
            if len(block) > self._longest:
                self.overlong += 1
            elif block:
                whole.append(block)
        return whole

    def clear(self) -> None:
        """Forget what has come of a frame that is not whole."""
        self._rest = b""
