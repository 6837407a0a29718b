"""The result of a trace of the rig in numbers and sentences: effects, evidence, errors, doubts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ...config.model import EffectParameter
from ...model.effects.base import Effect, Placed
from ..value_with_interval import percent
from .residual.random_vibration import RandomVibration
from .search.tested_candidate import Tried
from .search_options import SearchOptions
from .traced_model import effect_parameters

NOISE_MOST = SearchOptions().explained_by_laws
"""Largest error over noise floor that counts as noise: the floor has errors of a few percent."""
SQUARE_MOST = SearchOptions().explained ** 2
_FAR_BELOW = 0.5
"""Mean square of one-step errors (1 for noise) below which the noise was overestimated."""
NO_STILL = (
    "No record is still: the noise is estimated from the fit's residual, which includes undeclared "
    "effects. The residual may be above noise; free forms and vibration were not searched."
)
_NO_FLOOR = "no record tells noise from the model's error"
_IN_DOUBT, _MUCH = 2.0, 0.5
"""Named effects are uncertain if the error stays above this multiple of the noise floor, and what
is left of the squared error above it is more than this share of what they explain."""
_MANY = 2
"""More coils than this with equal forces act like a force on the DOF."""
PERHAPS_A_PART = "perhaps a part of what is described freely there"


@dataclass(frozen=True)
class Evidence:
    """The evidence for an effect.

    statistic: agreement of the effect's prediction with the errors of held-out records (if `held`),
    else between time blocks of the training records, in standard deviations of chance. explained:
    reduction of the cross-validated squared error; `share`: the same over the squared error above
    noise at that time, None if that was negligible. `alternatives` are not told from it by these
    records. support: share of resamples of the blocks that choose the effect or one of these;
    shares: of resamples in which each of [the effect, *alternatives] fits best. left_share: of the
    one-step-ahead squared error above noise without the effect, the share that is left with it; 0
    where noise leaves as much.
    """

    statistic: float
    held: bool
    explained: float
    share: float | None
    round: int
    alternatives: tuple[Effect, ...]
    support: float = math.nan
    shares: tuple[float, ...] = ()
    left_share: float = 0.0


@dataclass(frozen=True)
class RandomForce:
    """A random force on a DOF, which a model cannot predict."""

    shaking: RandomVibration
    dof: str
    unit: str

    equation = "force = noise of this rms, nine tenths of its power between low and high"

    @property
    def name(self) -> str:
        """Name and place of the force, for display."""
        low, high = self.shaking.band_hz
        return f"Random vibration at {self.dof}, {low:.3g} to {high:.3g} Hz"


@dataclass(frozen=True)
class FoundEffect:
    """An effect in the model; `evidence` is None for a declared effect."""

    placed: Placed
    evidence: Evidence | None

    @property
    def effect(self) -> Effect:
        """The effect, without parameter values."""
        return self.placed.effect

    @property
    def unknown(self) -> bool:
        """Whether it is a free form, not a known effect."""
        return self.effect.effect_class == "unknown"

    @property
    def others(self) -> tuple[Effect, ...]:
        """Effects of another class or place that these records do not tell from it."""
        found = () if self.evidence is None else self.evidence.alternatives
        return tuple(e for e in found if kind_of(e) != kind_of(self.effect))

    @property
    def name(self) -> str:
        """Its name; those of effects that are not told from it follow."""
        return " or ".join(dict.fromkeys([self.effect.name, *(e.name for e in self.others)]))

    def parameters(self) -> dict[str, EffectParameter]:
        """Return values, standard errors and units by name, amplitudes first."""
        return effect_parameters(self.placed)


@dataclass(frozen=True)
class DofError:
    """Free-run error of one DOF in SI units; band_hz: middle 80 % of its power after the trace."""

    name: str
    unit: str
    before: float
    after: float
    floor: float
    band_hz: tuple[float, float]


@dataclass(frozen=True)
class Outcome:
    """The result of a trace in numbers.

    before, after, floor: ABOUT_METRIC of the refitted declared model, of the model with effects,
    and of noise alone. mean_square: of the one-step-ahead errors after the trace on held-out
    records, in noise variances; `beyond`: the same of the readings' non-rigid free-run error, None
    without redundant sensors. `nearest`: candidates of the last round that explain most, none
    significant. gone: accepted or declared effects removed because others explain the same.
    noise_measured: the noise comes from still records. unpredicted: share of the one-step-ahead
    errors above noise, before the search, that no effect takes; 0 where noise leaves as much.
    least_gain: that of the search options.
    """

    effects: tuple[FoundEffect, ...]
    declared: tuple[FoundEffect, ...]
    before: float
    after: float
    floor: float
    dof: tuple[DofError, ...]
    mean_square: float
    beyond: float | None
    nearest: tuple[Tried, ...]
    gone: tuple[str, ...]
    unsettled: tuple[str, ...]
    shaken: tuple[RandomForce, ...] = ()
    noise_measured: bool = True
    actuators: frozenset[str] = frozenset()
    """Names of actuators that are located by their input's name instead of coil:N."""
    unpredicted: float = 0.0
    least_gain: float = SearchOptions.least_gain

    @property
    def overrated(self) -> bool:
        """Whether the errors are far below the estimated sensor noise."""
        return self.mean_square < _FAR_BELOW

    @property
    def significant(self) -> bool:
        """Whether the residual is significantly above noise."""
        return self.mean_square > SQUARE_MOST or not self.after <= NOISE_MOST * self.floor

    @property
    def explained(self) -> float:
        """Share of the squared error above noise that the effects explain; nan if none."""
        there = self.before**2 - self.floor**2
        return 1.0 - (self.after**2 - self.floor**2) / there if there > 0.0 else math.nan

    def in_doubt(self, found: FoundEffect) -> bool:
        """Return whether a name is uncertain: much of what is there is left with it.

        If the true effect is not in the table, the best candidate still explains a part of it. What
        is left is large, or as large a share of what it takes as an effect must take itself: an
        equation that is right leaves far less.
        """
        left = 0.0 if found.evidence is None else found.evidence.left_share
        return not found.unknown and (bool(self.doubt) or left > self.least_gain)

    @property
    def doubtful(self) -> bool:
        """Whether any name is uncertain."""
        return any(self.in_doubt(f) for f in self.effects)

    @property
    def doubt(self) -> str:
        """Why all names are uncertain, in words; empty if they are not."""
        named = any(not f.unknown for f in self.effects)
        much = 1.0 - self.explained > _MUCH * self.explained
        if named and self.after > _IN_DOUBT * self.floor and much:
            return (
                f"the effects explain {percent(self.explained)} of the squared error above "
                f"noise, and {self.after / self.floor:.2g} times the noise floor is left"
            )
        return ""

    def perhaps_part_of(self, found: FoundEffect) -> tuple[str, ...]:
        """Return the free forms at the same place as a known effect.

        The effect may then be a part of what they describe, which is not in the table.
        """
        if found.unknown:
            return ()
        return tuple(
            f.effect.name
            for f in self.effects
            if f.unknown and _acts_at(found.effect.where, f.effect.where[0], self.actuators)
        )

    @property
    def verdict(self) -> str:
        """The result in a sentence."""
        parts = []
        for word, doubtful in (("found", False), ("perhaps", True)):
            names = [
                f.name + (f" ({PERHAPS_A_PART})" if self.perhaps_part_of(f) else "")
                for f in self.effects
                if not f.unknown and self.in_doubt(f) is doubtful
            ]
            if not doubtful:
                names += [s.name for s in self.shaken]
            if names:
                parts.append(f"{word}: {', '.join(names)}")
        forms = ", ".join(f.effect.name for f in self.effects if f.unknown)
        if forms:
            parts.append(f"not explained by a known effect, described by free forms: {forms}")
        if parts:
            return "; ".join([*parts, self.rest])
        if self.significant:
            return (
                "nothing found: the residual is above noise, and no known effect explains it "
                "significantly"
            )
        if self.overrated:
            return f"no conclusion: {self._too_loud}"
        if not self.noise_measured:
            return f"no effect added, and no conclusion on the residual: {_NO_FLOOR}"
        return "nothing found: the model explains the records down to the noise"

    @property
    def rest(self) -> str:
        """The residual, described in a clause."""
        if self.significant:
            return "the residual is above noise"
        if self.overrated:
            return f"no conclusion on the residual: {self._too_loud}"
        return "the residual is noise" if self.noise_measured else f"residual: {_NO_FLOOR}"

    @property
    def _too_loud(self) -> str:
        return (
            f"the one-step errors have only {self.mean_square:.2g} of the sensor noise variance, "
            "which was estimated at the readings' highest frequencies; sample faster, or excite "
            "less at these frequencies"
        )


def _acts_at(where: Sequence[str], place: str, actuators: frozenset[str]) -> bool:
    """Return whether an effect at `where` acts at a place; many equal coils act at every DOF."""
    if len(where) > _MANY and all(w.startswith("coil:") or w in actuators for w in where):
        return (":" not in place and place not in actuators) or place in where
    return place in where


def telling(found: FoundEffect) -> str:
    """Return the excitation that distinguishes an effect from its alternatives; '' if unknown."""
    if found.evidence is None:
        return found.effect.told_apart_by
    both = (found.effect, *found.evidence.alternatives)
    return "; or ".join(dict.fromkeys(e.told_apart_by for e in both if e.told_apart_by))


def kind_of(effect: Effect) -> tuple[str, tuple[str, ...]]:
    """Return class and place of an effect, by which names are told apart."""
    return effect.effect_class, effect.where
