"""State an effect that a search of imported records added, and why its name may be uncertain."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ....config.model import EffectParameter
from ....model.effects.base import Placed
from ...value_with_interval import percent
from ..force_search.rated_candidate import Rated
from .model_check import ModelCheck

_COULOMB = "friction.coulomb"


@dataclass(frozen=True)
class FoundLaw:
    """An effect that the search added.

    parameters: its numbers by name, with standard errors. support: share of bootstrap samples of
    the blocks in which an effect of this class at this place gains most. alternatives: effects of
    other classes or places that these records cannot separate from it, each with its support. laws:
    such effects of the same class and place. left_share: share of the squared missing force without
    it that it leaves, beyond the noise of the outputs; leaning: the same without the uncertain
    effects. curve: free form of its signal that surely improves on it, None without one.
    significant: whether the force of one of its amplitudes differs from zero. impossible: what is
    physically impossible in the model with it and not without it. check: the checks of the model
    with all effects.
    """

    rated: Rated
    parameters: dict[str, EffectParameter]
    support: float
    alternatives: tuple[Rated, ...]
    laws: tuple[Rated, ...]
    left_share: float
    leaning: float
    curve: Rated | None
    significant: bool
    impossible: tuple[str, ...]
    check: ModelCheck

    @property
    def doubtful(self) -> bool:
        """Whether the name is uncertain."""
        return bool(self.doubts)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why the name is uncertain, as clauses."""
        if self.free:
            return self.check.close_without_effects
        return (*self.own_doubts, *self.check.doubts)

    @property
    def own_doubts(self) -> tuple[str, ...]:
        """Why this name is uncertain, whatever the check of the whole model says, as clauses.

        A right law leaves far less: if the table lacks the true effect, the best law still explains
        a part of it. A law without a significant amplitude has its shape at the edge of its range,
        where it resembles another law.
        """
        if self.free:
            return ()
        least = self.check.options.least_gain
        pair = " and ".join(self.placed.effect.equal_numbers or ())
        reasons = {
            f"the textbook law has one number for {pair}, and these differ": self.unequal,
            f"it leaves {percent(self.left_share)} of the squared missing force that the model has "
            "without it": self.left_share > least,
            f"without the other uncertain effects, it leaves {percent(self.leaning)} of the "
            "squared missing force": self.leaning > least,
            "each of its amplitudes may be zero": not self.significant,
            f"its {' and '.join(self.at_limit)} ended at the limit of the allowed range": bool(
                self.at_limit
            ),
            "it changes sign gradually over a large part of the speeds, and dry friction changes "
            "sign at once: it may be a damping that levels off": self.turns_slowly,
            f"{' and '.join(self.impossible)} with it, and not without it": bool(self.impossible),
            f"its depth is {self.depth:.2g}, and the textbook law has 1": self.partial,
        }
        return tuple(reason for reason, so in reasons.items() if so)

    @property
    def _another_law(self) -> bool:
        """Whether an alternative is another law, not the same law at another place."""
        own = self.placed.effect
        others = [r.placed.effect for r in self.alternatives]
        return any(e.key not in own.same_if_linear for e in others)

    @property
    def depth(self) -> float:
        """Its depth, 1 for a law of which it is the whole."""
        found = self.parameters.get("depth")
        return 1.0 if found is None else found.value

    @property
    def partial(self) -> bool:
        """Whether its depth surely is not 1, though the law has no other value."""
        if not self.placed.effect.whole or self._another_law:
            return False
        se, options = self.parameters["depth"].se, self.check.options
        return se is not None and abs(self.depth - 1.0) > max(
            options.standard_errors * se, options.alike
        )

    @property
    def at_limit(self) -> list[str]:
        """The numbers of its shape that differ from zero and are at a limit of their range that is
        not the end of the law."""
        found, surely = [], self.check.options.standard_errors
        for q, value in zip(self.placed.effect.shape, self.placed.shape, strict=True):
            se = self.parameters[q.name].se
            known = se is not None and surely * se < value
            above = value >= q.high and not q.ends
            if known and (above or (q.another_below and value <= q.low)):
                found.append(q.name)
        return found

    @property
    def turns_slowly(self) -> bool:
        """Whether it is a dry friction that changes sign gradually over most of the speeds."""
        effect, shape = self.placed.effect, self.placed.shape
        coulomb = tuple if effect.key == _COULOMB else effect.contains.get(_COULOMB)
        if coulomb is None:
            return False
        v_s = effect.shape[0]
        se = self.parameters[v_s.name].se
        known = se is not None and self.check.options.standard_errors * se < shape[0]
        return known and coulomb(shape)[0] > v_s.another_above

    @property
    def unequal(self) -> bool:
        """Whether two numbers that the textbook law has in common differ, by more than the accuracy
        of a right law.
        """
        if self.placed.effect.equal_numbers is None or self._another_law:
            return False
        one, other = (self.parameters[name] for name in self.placed.effect.equal_numbers)
        if one.se is None or other.se is None:
            return False
        apart = abs(one.value - other.value)
        error = math.hypot(one.se, other.se)
        size = max(abs(one.value), abs(other.value))
        options = self.check.options
        return apart > max(options.standard_errors * error, options.alike * size)

    @property
    def inexact(self) -> str:
        """What a curve over its signal explains better, as a clause; empty if none surely does."""
        if self.curve is None:
            return ""
        title = self.curve.placed.effect.title
        return (
            f"a {title[0].lower()}{title[1:]} in a way that no law of the table has would take "
            f"{percent(self.curve.share)} of the squared missing force that is left"
        )

    @property
    def placed(self) -> Placed:
        """The effect with its values."""
        return self.rated.placed

    @property
    def free(self) -> bool:
        """Whether it is a free form, not a known law."""
        return self.placed.effect.effect_class == "unknown"

    @property
    def name(self) -> str:
        """Its name; those of the alternatives follow."""
        names = [self.placed.effect.name, *(r.placed.effect.name for r in self.alternatives)]
        return " or ".join(dict.fromkeys(names))
