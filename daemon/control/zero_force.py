"""Tell from the newest cycles whether the amplifiers confirm that no force acts."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...log.signals import Stale
from .following_limits import coil_follow_n

NOT_READ_BACK = "the amplifiers do not measure the coil forces"
_RECENT_S, _LEAST_CYCLES = 0.25, 16
"""Age of a reading, in s or in cycles if that is longer, from which it is no evidence."""


@dataclass(frozen=True)
class ZeroForce:
    """Whether all coils read back zero force. confirmed: None if it cannot be known."""

    confirmed: bool | None
    found: str

    def as_json(self) -> dict[str, Any]:
        """Return a JSON object."""
        return asdict(self)


def zero_force(rows: NDArray[np.void], cycle: int, rig: RigConfig, reads_back: bool) -> ZeroForce:
    """Return what the newest log rows (n,), oldest first, say about the coil forces.

    cycle: number of the present cycle. reads_back: whether the amplifiers measure the force.
    Zero is a readback below `limits.coil_follow_n`.
    """
    if not reads_back:
        return ZeroForce(None, NOT_READ_BACK)
    unread = rows["stale"] & int(Stale.AMPLIFIERS) != 0
    age = cycle - rows["cycle"].astype(np.int64)
    fresh = rows[~unread & (age <= max(_RECENT_S * rig.rate_hz, _LEAST_CYCLES))]
    if not len(fresh):
        return ZeroForce(None, "the amplifiers have sent no reading in the last cycles")
    force_n = np.abs(fresh["coil_readback_n"][-1].astype(float))
    coil = int(np.argmax(force_n))  # nan counts as the largest
    value = f"{fresh['coil_readback_n'][-1][coil]:.2f} N"
    if not force_n[coil] <= coil_follow_n(rig):
        return ZeroForce(False, f"coil {coil} reads back {value}")
    return ZeroForce(True, f"all coils read back zero, within {coil_follow_n(rig):g} N")
