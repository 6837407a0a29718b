"""Keep the candidates of a search: accepted ones leave, rejected ones may be tested once more."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ....model.effects.base import Effect, Placed
from .gauss_newton import Candidate
from .tested_candidate import Tried

_STILL = 0.5
"""Of what it took when it was refused, an effect must still take this to be asked again."""


class CandidateQueue:
    """The accepted and the rejected candidates of a search.

    Held-out records that are full of one effect may refuse another: once the first is taken, the
    other is asked once more. If it explains less by then, that was what the first took.
    """

    def __init__(self, placed: Iterable[Placed]) -> None:
        self._taken = {p.effect.identity for p in placed}
        self._refused: dict[str, Tried] = {}
        self._barred: set[str] = set()
        self._again: set[str] = set()
        self.in_a_row = 0
        """How many were refused since one was taken."""

    def take(self, taken: Tried, placed: Iterable[Placed]) -> None:
        """Record an accepted effect, and the effects in the model with it."""
        self._taken |= {taken.effect.identity, *(p.effect.identity for p in placed)}
        self._barred, self.in_a_row = set(self._again), 0

    def refuse(self, tried: Tried) -> None:
        """Record a rejected effect."""
        name = tried.effect.identity
        if name in self._refused:
            self._again.add(name)
        self._refused.setdefault(name, tried)
        self._barred.add(name)
        self.in_a_row += 1

    def candidates(self, effects: Sequence[Effect]) -> list[Candidate]:
        """Return the candidates to test, with all shapes of their grids."""
        left = [e for e in effects if e.identity not in self._taken | self._barred]
        return [(effect, tuple(shape)) for effect in left for shape in effect.grid]

    def is_open(self, tried: Tried) -> bool:
        """Return whether a candidate was not refused before, or explains as much as it did then."""
        before = self._refused.get(tried.effect.identity)
        return before is None or tried.gain > _STILL * before.gain
