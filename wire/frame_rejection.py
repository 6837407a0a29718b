"""Why a frame does not count."""

from __future__ import annotations

from enum import Enum


class Rejected(Enum):
    """Why a frame does not count; the words end up in the fault."""

    LENGTH = "of the wrong length"
    CHECKSUM = "with a wrong checksum"
    COUNTER = "out of their cycle"
    REPEATED = "repeated"
    VERSION = "of another protocol version"
    KIND = "of an unknown kind"
    FRAMING = "wrongly framed"
    CYCLE = "of a cycle beyond those that are counted"
