"""Hold the state of a search for effects: the model, its ratings, and what was not chosen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ....model.effects.actuator_chain import same_law
from ....model.effects.base import Effect
from ..force_balance.force_record import ForceModel
from ..force_regression.training_records import Training
from ..search_options import SearchOptions
from .rated_candidate import Rated


@dataclass(frozen=True)
class SearchTask:
    """What a search works with: all laws that have a name, the records to fit, and the options."""

    laws: Sequence[Effect]
    training: Training
    options: SearchOptions


@dataclass(frozen=True)
class SearchState:
    """A fitted model, the ratings of its added effects by identity, and the removed effects.

    other_choices: for each added effect, the states with another effect in its place, best first.
    """

    point: ForceModel
    rated: dict[str, Rated]
    dropped: tuple[str, ...]
    other_choices: tuple[tuple[SearchState, ...], ...] = ()

    def ratings_without(self, replaced: Rated) -> dict[str, Rated]:
        """Return the ratings without that of the effect that a candidate replaces."""
        gone = None if replaced.instead_of is None else replaced.instead_of.effect.identity
        return {key: r for key, r in self.rated.items() if key != gone}


def ratings_of_model(rated: Mapping[str, Rated], point: ForceModel) -> dict[str, Rated]:
    """Return the ratings of a model's effects by identity.

    A fit may move an effect before or behind a lag, which changes its identity.
    """
    found = {}
    for p in point.placed:
        own = next((r for r in rated.values() if same_law(r.placed.effect, p.effect)), None)
        if own is not None:
            found[p.effect.identity] = own
    return found
