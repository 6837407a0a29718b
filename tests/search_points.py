"""A working point as far as the search looks at it: what is placed, and whether noise is known."""

from __future__ import annotations

from dataclasses import dataclass

from levid.model.effects.base import Placed


@dataclass(frozen=True)
class Measured:
    """A disturbance that a still record told, or none did."""

    measured: bool = True


@dataclass(frozen=True)
class Point:
    """What is placed, in order."""

    placed: tuple[Placed, ...]
    disturbance: Measured = Measured()
