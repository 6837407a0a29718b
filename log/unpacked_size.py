"""Bound what a file may hold when unpacked, in proportion to its size on disk.

Compressed zeros take next to no bytes, so a file of megabytes could claim all memory. Measured data
have noise: they compress to a half or a third, steps of a simulation to a tenth.
"""

from __future__ import annotations

_ALWAYS_BYTES = 32 << 20
_RATIO = 24


def most_unpacked_bytes(file_bytes: int) -> int:
    """Return how many bytes a file of `file_bytes` on disk may hold when unpacked."""
    return _ALWAYS_BYTES + _RATIO * file_bytes


def too_much(file_bytes: int, unpacked_bytes: int) -> str:
    """Return an error text for a file that holds more than that."""
    most = most_unpacked_bytes(file_bytes)
    return (
        f"expected at most {_mib(most)} when unpacked in a file of {_mib(file_bytes)}, found "
        f"{_mib(unpacked_bytes)}: damaged, or made of repeated values"
    )


def _mib(size: int) -> str:
    return f"{size / 2**20:.3g} MiB"
