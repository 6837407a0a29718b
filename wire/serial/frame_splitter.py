"""Split a byte stream into frames at zero bytes, which also restores framing after errors."""

from __future__ import annotations


class FrameStream:
    """Collects received bytes and returns complete blocks between zeros.

    A block longer than `longest` (a zero was lost, for example) is discarded up to the next zero,
    which bounds the memory.
    """

    def __init__(self, longest: int) -> None:
        self._longest = longest
        self._rest = b""
        self.overlong = 0
        """Number of discarded blocks that were too long."""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the blocks that `data` completes, without their zeros; empty ones are omitted."""
        *blocks, rest = (self._rest + data).split(b"\0")
        if len(rest) > self._longest:
            # Keep one byte more than the longest: at its zero, the block is discarded as too long.
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
        """Discard the incomplete frame."""
        self._rest = b""
