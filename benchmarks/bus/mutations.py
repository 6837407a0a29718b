"""What trials of a decoder came to, and bytes that were changed on their way."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np


@dataclass(frozen=True)
class Outcome:
    """Frames tried, accepted, judged wrongly or lost, and the share to be expected of accepted."""

    tried: int
    accepted: int
    wrong: int
    expected_share: float

    @property
    def z(self) -> float:
        """Distance of the accepted from the expected, in standard deviations of a binomial."""
        p = self.expected_share
        spread = sqrt(self.tried * p * (1.0 - p))
        return (self.accepted - self.tried * p) / spread if spread else float(self.accepted)


def mutated(good: bytes, rng: np.random.Generator) -> bytes:
    """Return a frame of which bytes were changed, cut off or added."""
    data = bytearray(good)
    for _ in range(int(rng.integers(1, 4))):
        kind = int(rng.integers(8))
        at = int(rng.integers(max(len(data), 1)))
        if kind == 0:
            del data[at:]
        elif kind == 1:
            data[at:at] = rng.integers(0, 256, int(rng.integers(1, 5)), np.uint8).tobytes()
        elif data:
            data[at % len(data)] ^= int(rng.integers(1, 256))
    return bytes(data)


def are(found: np.ndarray, expected: list[float], most: np.ndarray | float) -> bool:
    """Return whether these are the numbers expected, nan for none, each within `most`."""
    equal = np.allclose(found, expected, rtol=1e-12, atol=0.0, equal_nan=True)
    return bool(equal and (np.isnan(found) | (np.abs(found) <= most)).all())
