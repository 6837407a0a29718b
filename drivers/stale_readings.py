"""Watches over the readings of one device: what is stale is counted, bounded and then an error."""

from __future__ import annotations

from collections import Counter

from ..wire.frame_rejection import Rejected
from .base import StaleError


class Watch:
    """Judges every cycle: clean, if its reading came in time and nothing came that should not.

    More than `tolerated` cycles in a row that are not clean raise StaleError, whose message says
    what came instead. In between, the last reading stands in.
    """

    def __init__(self, what: str, tolerated: int) -> None:
        self._what, self._tolerated = what, tolerated
        self._reasons: Counter[str] = Counter()
        self._in_a_row = 0
        self._fresh, self._unclean = True, False
        self._missed_before = 0
        self.stale = 0
        """Cycles without a reading in time since the start."""

    def begin(self) -> None:
        """Judge the cycle that ends, and begin the next."""
        self._missed_before = 0 if self._fresh else self._missed_before + 1
        if self._fresh and not self._unclean:
            self._in_a_row = 0
            self._reasons.clear()
        else:
            self._in_a_row += 1
        self._fresh = self._unclean = False

    def reject(self, reason: Rejected, behind: int = 0) -> None:
        """Note a frame that does not count; `behind`: how many cycles old its counter says it is.

        A reading of the cycles that were just missed is merely late: it is no disorder unless it
        comes after that of this cycle.
        """
        if 0 < behind <= self._missed_before and not self._fresh:
            self._reasons["too late"] += 1
            return
        self._reasons[reason.value] += 1
        self._unclean = True

    def late(self) -> None:
        """Note that this cycle's reading came after its deadline."""
        self._reasons["too late"] += 1

    def arrived(self) -> None:
        """Note that this cycle's reading came: what comes after it is out of order."""
        self._fresh = True

    def fresh(self) -> None:
        """Judge this cycle's reading, which came; StaleError if too much went wrong before."""
        self._fresh = True
        if self._in_a_row > self._tolerated:
            raise StaleError(self._words(self._in_a_row))

    def missing(self) -> None:
        """Note that this cycle's reading did not come in time; raises StaleError at the bound."""
        self.stale += 1
        if self._in_a_row + 1 > self._tolerated:
            raise StaleError(self._words(self._in_a_row + 1))

    def reset(self) -> None:
        """Begin anew after a fault."""
        self._in_a_row = 0
        self._fresh, self._unclean, self._missed_before = True, False, 0
        self._reasons.clear()

    def _words(self, cycles: int) -> str:
        came = ", ".join(f"{n} frames {reason}" for reason, n in sorted(self._reasons.items()))
        return f"{self._what}: no clean reading in {cycles} cycles; came: {came or 'nothing'}"
