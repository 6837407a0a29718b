"""Count stale readings of a device, and raise an error if too many follow each other."""

from __future__ import annotations

from collections import Counter

from ..wire.frame_rejection_reasons import Rejected
from .base import StaleError


class Watch:
    """Classifies cycles: clean if the reading arrived in time and no frame was rejected.

    More than `tolerated` consecutive cycles that are not clean raise StaleError; its message counts
    the rejected frames. Until then the last reading is used.
    """

    def __init__(self, what: str, tolerated: int) -> None:
        self._what, self._tolerated = what, tolerated
        self._reasons: Counter[str] = Counter()
        self._in_a_row = 0
        self._fresh, self._unclean = True, False
        self._missed_before = 0
        self.stale = 0
        """Number of cycles without a reading in time."""

    def begin(self) -> None:
        """Classify the cycle that ends, and begin the next."""
        self._missed_before = 0 if self._fresh else self._missed_before + 1
        if self._fresh and not self._unclean:
            self._in_a_row = 0
            self._reasons.clear()
        else:
            self._in_a_row += 1
        self._fresh = self._unclean = False

    def reject(self, reason: Rejected, behind: int = 0) -> None:
        """Note a rejected frame; `behind`: its age in cycles by its counter, 0 if unknown.

        A reading of a cycle that was just missed is late. It makes this cycle unclean only if it
        arrives after the reading of this cycle.
        """
        if 0 < behind <= self._missed_before and not self._fresh:
            self._reasons["too late"] += 1
            return
        self._reasons[reason.value] += 1
        self._unclean = True

    def late(self) -> None:
        """Note that this cycle's reading arrived after its deadline."""
        self._reasons["too late"] += 1

    def arrived(self) -> None:
        """Note that this cycle's reading arrived; frames after it are out of order."""
        self._fresh = True

    def fresh(self) -> None:
        """Accept this cycle's reading; raises StaleError after too many unclean cycles."""
        self._fresh = True
        if self._in_a_row > self._tolerated:
            raise StaleError(self._message(self._in_a_row))

    def missing(self) -> None:
        """Note that this cycle's reading is missing; raises StaleError after too many."""
        self.stale += 1
        if self._in_a_row + 1 > self._tolerated:
            raise StaleError(self._message(self._in_a_row + 1))

    def reset(self) -> None:
        """Clear all counts after a fault, except `stale`."""
        self._in_a_row = 0
        self._fresh, self._unclean, self._missed_before = True, False, 0
        self._reasons.clear()

    def _message(self, cycles: int) -> str:
        received = ", ".join(f"{n} frames {reason}" for reason, n in sorted(self._reasons.items()))
        return (
            f"{self._what}: no clean reading in {cycles} cycles; received: {received or 'nothing'}"
        )
