"""Encode and decode consistent overhead byte stuffing (COBS): a zero byte ends a frame.

S. Cheshire and M. Baker, Consistent Overhead Byte Stuffing, IEEE/ACM Transactions on Networking
7(2), 1999.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]


def encoded_length(n: int) -> int:
    """Return the largest encoded length of `n` bytes, final zero included."""
    return n + n // 254 + 2


def encode(data: Bytes, out: Bytes) -> int:
    """Encode `data` and a final zero into `out` (encoded_length bytes); return the length."""
    return int(_encode(data, out))


def decode(data: Bytes, out: Bytes) -> int:
    """Decode `data`, without the final zero, into `out`; return the length, -1 if it is invalid.

    Data that exceeds `out` is invalid.
    """
    return int(_decode(data, out))


@njit(cache=True)
def _encode(data: Any, out: Any) -> int:
    code_at, at, code = 0, 1, 1
    for i in range(data.size):
        byte = data[i]
        if byte != 0:
            out[at] = byte
            at += 1
            code += 1
        if byte == 0 or (code == 0xFF and i + 1 < data.size):
            out[code_at] = code
            code_at, at, code = at, at + 1, 1
    out[code_at] = code
    out[at] = 0
    return at + 1


@njit(cache=True)
def _decode(data: Any, out: Any) -> int:
    at, n = 0, 0
    while at < data.size:
        code = int(data[at])
        end = at + code
        if code == 0 or end > data.size or n + code > out.size + 1:
            return -1
        for i in range(at + 1, end):
            if data[i] == 0:
                return -1
            out[n] = data[i]
            n += 1
        at = end
        if code < 0xFF and at < data.size:
            if n >= out.size:
                return -1
            out[n] = 0
            n += 1
    return n if data.size else -1
