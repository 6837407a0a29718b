"""Hold what a search knows of its candidates: tested ones, rounds, and the records that judge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Effect, Placed
from ....model.effects.freeform import depends_on
from ..linearised.gram_matrices import Linearised
from ..linearised.linearisation_point import WorkingPoint
from .gauss_newton import Candidate, Fitted

Array = NDArray[np.float64]

FRICTION = "friction"


@dataclass(frozen=True)
class HeldError:
    """Free-run error of the held-out records: mean square, its noise floor, and by block (B,)."""

    squares: float
    floor: float
    blocks: Array


class TimeOverError(Exception):
    """The time for a search is over; what was confirmed before stays."""


class Records(Fitted, Protocol):
    """The training records, and the held-out records of the test.

    All methods raise TimeOverError once the time for the search is over.
    """

    def in_any_time(self) -> Self:
        """Return the same records, for what has to be done in any case."""

    @property
    def sensor_shape(self) -> Array:
        """Sensor matrix (S, n): readings of a rigid pose."""

    def held(self, point: WorkingPoint, candidates: Sequence[Candidate] = ()) -> list[Linearised]:
        """Return the held-out records, linearised."""

    def shown(self, point: WorkingPoint, candidates: Sequence[Candidate]) -> list[Linearised]:
        """Return the training records, with sensor candidates in the non-rigid readings only."""

    def held_error(self, point: WorkingPoint) -> HeldError:
        """Return the free-run error of the held-out records."""

    def with_estimated_noise(self, point: WorkingPoint) -> WorkingPoint:
        """Return the point with its noise estimated anew."""

    def noise_removed(self, point: WorkingPoint) -> Array:
        """Return the squared errors of noise that effects remove, by block of training records."""


@dataclass(frozen=True)
class Agreement:
    """How far beyond chance data agree with an effect that did not fit it, in standard deviations.

    between: blocks of the training records, each predicted by the others. expected: what the
    held-out records would say of a right prediction, and held: what they say. asked: whether they
    should say more than chance does.
    """

    between: float
    expected: float
    held: float
    asked: bool


UNTESTED = Agreement(np.inf, 0.0, 0.0, asked=False)


@dataclass(frozen=True)
class Tried:
    """A tested candidate, with its gain in cross-validated squared errors, by block too (B,)."""

    effect: Effect
    shape: tuple[float, ...]
    gain: float
    blocks: Array
    amplitudes: tuple[float, ...]
    agreement: Agreement = UNTESTED

    @property
    def placed(self) -> Placed:
        """The effect with its shape and amplitudes."""
        return Placed(self.effect, self.shape, self.amplitudes)

    def at(self, placed: Placed) -> Tried:
        """Return the candidate with the shape and the amplitudes of an effect of the model."""
        return replace(self, shape=placed.shape, amplitudes=placed.amplitudes)


@dataclass(frozen=True)
class Round:
    """One round of the search: residual before, best candidates, accepted effect.

    ranking: those that were fitted and tested, the best first; survivors: those of them that the
    criterion takes. instead_of: what had been taken, and led less far. shares: of resamples of the
    blocks in which each of [taken, *alternatives] fits best; empty before the final comparison.
    """

    excess: float
    count: float
    ranking: tuple[Tried, ...]
    survivors: tuple[Tried, ...]
    taken: Tried | None
    alternatives: tuple[Tried, ...]
    instead_of: Effect | None = None
    shares: tuple[float, ...] = ()


def is_internal(effect: Effect) -> bool:
    """Return whether an effect acts on the drives only: a force between beam and platform."""
    return effect.where == ("beam",)


def numbers(effect: Effect) -> int:
    """Return the number of parameters of an effect: amplitudes and shape."""
    return len(effect.amplitudes) + len(effect.shape)


def is_product(effect: Effect) -> bool:
    """Return whether an effect is a free form of two signals."""
    return effect.effect_class == "unknown" and len(depends_on(effect)) > 1
