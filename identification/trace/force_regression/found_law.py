"""State an effect that a search of imported records added, and why its name may be uncertain."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ....config.model import EffectParameter
from ....model.effects.base import Placed
from ...value_with_interval import percent
from .rated_candidate import Rated

_COULOMB = "friction.coulomb"


@dataclass(frozen=True)
class FoundLaw:
    """An effect that the search added.

    support: share of bootstrap samples of the blocks in which an effect of this class at this place
    gains most. `alternatives` are of other classes or places, each with its support: these records
    do not tell them apart. laws: other laws of the same class and place, not told apart either.
    left_share: share of the squared missing force without it that is left with it, beyond the noise
    of the outputs; leaning: the same without the effects in doubt; unseen: the same of all effects,
    in the rows that neither fitted nor chose. least_gain: share that an effect must take. curve:
    free form of its signal that surely improves on it, None without one. grew: whether the model
    with all effects misses more force in the rows that neither fitted nor chose, and whether its
    free run is farther from them. floors: error of the free run over what the stated noise leaves
    of it, at the DOF where that is most, nan without them or if hardly any of the error before is
    left, infinite if it converges without effects only and the force does not confirm them. told:
    whether the force of one of its amplitudes is told from zero. surely: standard errors from which
    on two numbers differ; agreement: deviations within which data agree; accuracy: relative error
    of a right law. displaced: parameters of the model that are at a limit of their range with the
    effects, so that one of these may do what the parameter did; of zero, which a damping may be, it
    says nothing. impossible: what of the model cannot be with it.
    exchanged: with which columns exchanged the model explains as much without effects; empty if
    there are none. crowded: how many effects were found if the search looks for no more, else 0.
    outputs: how close to the outputs a model without effects is that is fitted to them, in per cent
    of these, if it is as close as with the effects found, else nan.
    """

    rated: Rated
    parameters: dict[str, EffectParameter]
    support: float
    alternatives: tuple[Rated, ...]
    laws: tuple[Rated, ...]
    left_share: float
    leaning: float
    unseen: float
    least_gain: float
    curve: Rated | None
    grew: tuple[bool, bool]
    floors: float
    told: bool
    surely: float
    agreement: float
    accuracy: float
    displaced: tuple[str, ...]
    impossible: tuple[str, ...]
    exchanged: str
    crowded: int
    outputs: float

    @property
    def doubtful(self) -> bool:
        """Whether the name is uncertain."""
        return bool(self.doubts)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why the name is uncertain, as sentences.

        A law that is right leaves far less: if what is there is not in the table, the best law
        still explains a part of it. A law of which no amplitude is told from zero has its shape at
        the edge of what it can be, where it stands for another one.
        """
        if self.free:
            return (self._outputs,) if np.isfinite(self.outputs) else ()
        left = percent(self.left_share)
        pair = " and ".join(self.placed.effect.equal_numbers or ())
        more, farther = self.grew
        reasons = {
            f"its {pair} are one number in the textbook law, and differ here": self.unequal,
            f"of the squared missing force without it, {left} is left": (
                self.left_share > self.least_gain
            ),
            f"without what is in doubt, {percent(self.leaning)} is left beside it": (
                self.leaning > self.least_gain
            ),
            "of the squared missing force in the rows that neither fitted nor chose, "
            f"{percent(self.unseen)} is left": (self.unseen > self.least_gain >= self.left_share),
            "no amplitude of it is told from zero": not self.told,
            f"its {' and '.join(self.at_limit)} ended at the limit of what it can be": bool(
                self.at_limit
            ),
            "it turns over a large part of the speeds, where dry friction turns at once: it may be "
            "a damping that levels off": self.turns_slowly,
            "the rows that neither fitted nor chose miss more force with what was found": more,
            "with what was found the free run is farther from these rows": farther,
            self._off: self.floors > self.agreement,
            f"{' and '.join(self.displaced)} ended at the limit of its range beside it": bool(
                self.displaced
            ),
            f"the search ended with {self.crowded} effects, the most that it looks for: several "
            "may stand for one that the table lacks": self.crowded > 0,
            self._outputs: bool(np.isfinite(self.outputs)),
            f"without any effect the model explains as much if {self.exchanged}": bool(
                self.exchanged
            ),
            f"with it {' and '.join(self.impossible)}, and not without": bool(self.impossible),
            f"its depth would be 1, but is {self.depth:.2g}": self.partial,
        }
        return tuple(reason for reason, so in reasons.items() if so)

    @property
    def _off(self) -> str:
        """How far off the free run is."""
        if np.isinf(self.floors):
            return "with what was found the free run does not converge, and the force leaves room"
        return f"with what was found the free run is {self.floors:.2g} times the noise off"

    @property
    def _outputs(self) -> str:
        """How close to the outputs a model without effects is."""
        return (
            f"fitted to the outputs themselves, the model without any effect is within "
            f"{self.outputs:.2g} % of them, as close as with what was found"
        )

    @property
    def _another_law(self) -> bool:
        """Whether a law that these records do not tell from it is not the same at another place."""
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
        se = self.parameters["depth"].se
        return se is not None and abs(self.depth - 1.0) > max(self.surely * se, self.accuracy)

    @property
    def at_limit(self) -> list[str]:
        """Its shape's numbers at a limit of their range where the law does not end, if the records
        tell them from zero."""
        found = []
        for q, value in zip(self.placed.effect.shape, self.placed.shape, strict=True):
            se = self.parameters[q.name].se
            told = se is not None and self.surely * se < value
            above = value >= q.high and not q.ends
            if told and (above or (q.another_below and value <= q.low)):
                found.append(q.name)
        return found

    @property
    def turns_slowly(self) -> bool:
        """Whether it is a dry friction that surely is not dry at most of the speeds."""
        effect, shape = self.placed.effect, self.placed.shape
        coulomb = tuple if effect.key == _COULOMB else effect.contains.get(_COULOMB)
        if coulomb is None:
            return False
        v_s = effect.shape[0]
        se = self.parameters[v_s.name].se
        told = se is not None and self.surely * se < shape[0]
        return told and coulomb(shape)[0] > v_s.another_above

    @property
    def unequal(self) -> bool:
        """Whether two numbers that are one if the law is all there is surely differ.

        By less than a right law's accuracy they may.
        """
        if self.placed.effect.equal_numbers is None or self._another_law:
            return False
        one, other = (self.parameters[name] for name in self.placed.effect.equal_numbers)
        if one.se is None or other.se is None:
            return False
        apart = abs(one.value - other.value)
        error = math.hypot(one.se, other.se)
        size = max(abs(one.value), abs(other.value))
        return apart > max(self.surely * error, self.accuracy * size)

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
