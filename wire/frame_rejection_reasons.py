"""List the reasons for which a frame is rejected."""

from __future__ import annotations

from enum import Enum


class Rejected(Enum):
    """Reason for which a frame is rejected; the words follow "N frames" in faults."""

    LENGTH = "of the wrong length"
    CHECKSUM = "with a wrong checksum"
    COUNTER = "of another cycle"
    REPEATED = "repeated"
    VERSION = "of another protocol version"
    KIND = "of an unknown kind"
    FRAMING = "with invalid framing"
    CYCLE = "with a cycle number out of range"
