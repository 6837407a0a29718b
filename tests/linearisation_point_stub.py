"""A minimal working point for tests of the search: the accepted effects and a noise flag."""

from __future__ import annotations

from dataclasses import dataclass

from levid.model.effects.base import Placed


@dataclass(frozen=True)
class Measured:
    """A disturbance; `measured` if its noise comes from a still record."""

    measured: bool = True


@dataclass(frozen=True)
class Point:
    """The accepted effects, in order."""

    placed: tuple[Placed, ...]
    disturbance: Measured = Measured()
