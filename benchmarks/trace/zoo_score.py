"""Whether what a trace says of a plant of the zoo is right.

An effect in the plant is *spoken of* by a reported one that has its class and shares a place with
it, or names such a one among its alternatives. It is *right* if, besides,

- its places and those of all that speaks of it have more than half in common (in common over named
  or true); `beam` and `rotor`, which a class implies, do not count where there are other places;
- nothing speaks of it only together with more than two other things (class and place): whoever
  says that four may be it has named none.

A plant is right if all its effects are, each by a reported one of its own, and nothing reported
speaks of none of them: that is a *false alarm*, be it of the right class at a wrong place; a class
that the case says to be alike raises none where it stands for the true one, and one where it is
said beside it. Where a refit of the declared model absorbs the effect and has an error of the
floor, saying nothing is right too ('not visible'). With nothing undeclared in the plant, to report
nothing is right, and to find no more than noise left.

*Family* right: for every effect something reported, or an alternative of it, is of the same family
(FAMILIES) and shares a place with it. *Missed*: there is no such thing. Alternatives count as much
as what they stand beside, since the trace says no more; a class that fits the data as well but
is reported alone is wrong.

*Mechanism* right: what is named first, of its alternatives, is for every effect of an equation that
the case allows (its `keys`), at a place of it. A random force is in no model that a trace ends
with: it is named by what the result says of it. *Extra*: effects reported beyond one for each in
the plant, right as they may be.

A plant with an unlisted effect is right if nothing is *misnamed* (classes are reported none of
which the case allows there, and the result does not say that its names are in doubt), if something
`unknown` is reported that has more than half of its places in common with the truth, if it names
the first of what the effect depends on (SIGNALS) and has half or more in common with all of it (in
common over named or true), and if the error is at least halved, or at the floor.

Errors are over the floor of a plant that holds nothing, where it is given: the floor that a result
itself tells moves with the effect, since what a sensor does wrong may pass for its noise.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import permutations
from typing import Any

from levid.benchmarks.trace.zoo_cases import ZooCase, is_called

FAMILIES = (
    {"rod_stiffness"},
    {"air_damping", "friction"},
    {"flexible_mode"},
    {"centre_of_mass", "payload"},
    {"beam_motion", "external_field", "rotor", "cogging"},
    {"coil_gain", "force_constant", "saturation", "dead_zone", "thermal_drift", "force_offset"},
    {"actuator_lag", "delay"},
    {"sensor_gain", "sensor_nonlinearity", "sensor_crosstalk"},
    {"sensor_offset", "sensor_lag", "sensor_stuck"},
    {"vibration"},
)
SIGNALS: Mapping[str, tuple[set[str], ...]] = {
    # It hangs 10 cm along y, and answers what psi and z make of it there: either tells.
    "hung-plug": ({"psi", "psi'", "psi''", "z", "z'", "z''"},),
    "eddy-brake": ({"theta'"}, {"x_b"}, {"z'"}),
    "gyroscope": ({"phi'"}, {"psi'"}, {"theta'"}),
    "passing-beam": ({"x_b"},),
    "stray-field": ({"coil:3"},),
    "shared-yoke": ({"coil:4"}, {"coil:5"}),
    "cable-loop": ({"x_b", "v_b"},),
    "closed-cover": ({"v_b"}, {"x_b"}),
    # 12 cm apart along y: their gaps differ by psi alone.
    "pulled-oscillator": ({"psi", "sensor:8"},),
    "second-stage": ({"coil:3"},),
    "transducer-core": ({"coil:6"},),
    "loaded-rod": ({"a_b"}, {"z"}),
    # A phase of its motor: the current of a_b, with a wave along x_b.
    "shared-return": ({"x_b"}, {"a_b"}),
    # A spring that goes along with the beam: torque x_b (z + x_b theta), force x_b theta.
    "steel-plate": ({"x_b"}, {"theta", "z"}),
    # What the beam gave back since it last started: mostly its speed squared, from the last peak.
    "pumped-bus": ({"v_b", "a_b"}, {"v_b", "a_b", "x_b", "time"}),
    # A wave along x_b that is felt with the speed squared; a little with a_b, which bends the way.
    "wavy-rail": ({"x_b"}, {"v_b", "a_b"}),
    # What its coil carried, which is mostly what the beam's place makes it carry: either tells.
    "warm-post": ({"coil:8", "x_b"},),
    # What made its table rock: the beam's push, and its weight, which goes with it; either tells.
    "rocking-table": ({"a_b", "x_b"},),
    "rectified-drive": ({"phi'"},),
    # A table that rings after the beam's starts and stops, and leans with where it stands.
    "soft-feet": ({"a_b", "v_b", "x_b"},),
    # The beam's magnets over a coil, times what it carries, which is nearly always the same.
    "passed-coil": ({"x_b"}, {"coil:5"}),
}
"""What the unlisted effects depend on, as the report of a trace calls its signals.

Of signals in one set any tells of it; without one of the first set it is not described. An unknown
effect names them in its evidence, under `signals`; what is allowed beside it, by its second place.
"""
_CARRIERS = {"beam", "rotor"}
_IN_COMMON = 0.5
"""Of places there has to be more, of signals not less."""
_MOST_IN_A_SET = 3
_EXPLAINED = 1.15
"""Error over the floor of a model that explains the records."""


@dataclass(frozen=True)
class Score:
    """What a result is worth, with its errors before and after over the floor.

    in_a_set: right as one of several that fit about as well. hidden: right in saying
    nothing of an effect that a refit absorbs. in_doubt: classes are reported of an unlisted effect,
    and the result itself doubts them. own_floor: what the result takes for the floor, over the one
    that errors are over. `said` in words.
    """

    right: bool
    family: bool
    missed: int
    false_alarms: int
    in_a_set: bool
    said: str
    before_over_floor: float
    after_over_floor: float
    own_floor: float
    hidden: bool = False
    misnamed: bool = False
    in_doubt: bool = False
    mechanism: bool = False
    extra: int = 0
    described: bool = False
    halved: bool = False


@dataclass(frozen=True)
class Named:
    """A class at places, as reported; the first of them is where it acts."""

    kind: str
    where: frozenset[str]
    first: str = field(default="", compare=False)

    def like(self, case: ZooCase) -> bool:
        return self.kind == case.kind and self.near(case)

    def akin(self, case: ZooCase) -> bool:
        return bool(_family(self.kind) & {case.kind, *case.alike}) and self.near(case)

    def near(self, case: ZooCase) -> bool:
        true = set(case.where) - _CARRIERS
        return bool(self.where & (true or set(case.where)))


@dataclass(frozen=True)
class Reported:
    """One reported effect: itself first, then what fits about as well.

    `doubted`: the result says that it may be a part of what it describes freely.
    """

    options: tuple[Named, ...]
    signals: frozenset[str]
    doubted: bool = False

    def speaks_of(self, case: ZooCase) -> Named | None:
        return next((option for option in self.options if option.like(case)), None)

    def stands_for(self, case: ZooCase) -> bool:
        return any(option.kind in case.alike and option.near(case) for option in self.options)


def score_plant(
    cases: Sequence[ZooCase],
    summary: Mapping[str, Any],
    placed: Sequence[Mapping[str, Any]] = (),
    floor: float | None = None,
) -> Score:
    """Return the score of a result for a plant with these effects.

    `summary` is what `levid trace --json` prints, `placed` the effects of the model that it ends
    with, each with its name in the table and its places. `floor` is that of a plant that holds
    nothing, in the unit of the result's errors; without it errors are over the result's own.
    """
    errors = _errors(summary, floor)
    if len(cases) == 1 and cases[0].kind == "unknown":
        return _score_unlisted(cases[0], summary, errors)
    return _score_listed(cases, summary, named(summary, placed), errors)


def named(
    summary: Mapping[str, Any], placed: Sequence[Mapping[str, Any]]
) -> list[Mapping[str, Any]]:
    """Return the effects of the model that a trace ends with, and the random forces beside them."""
    random = [
        {"effect": "vibration.random", "where": e["where"], "parameters": e["parameters"]}
        for e in summary["effects"]
        if e["class"] == "vibration" and "rms" in e.get("parameters", {})
    ]
    return [*placed, *random]


def _score_listed(
    cases: Sequence[ZooCase],
    summary: Mapping[str, Any],
    placed: Sequence[Mapping[str, Any]],
    errors: _Errors,
) -> Score:
    reported = _reported(summary)
    before, after = errors.before, errors.after
    absorbed = [
        case
        for case in cases
        if case.absorbed is not None and before <= _EXPLAINED and not _akin(case, reported)
    ]
    unsaid = [case for case in cases if not any(r.speaks_of(case) for r in reported)]
    alarms = [
        r
        for r in reported
        if not any(r.speaks_of(case) for case in cases)
        and not any(r.stands_for(case) for case in unsaid)
    ]
    there = [case for case in cases if case not in absorbed]
    right = not alarms and all(_right(case, reported) for case in there)
    right = right and _each_its_own(there, reported) and math.isfinite(after)
    if not cases:
        right = right and not summary["unexplained"]["significant"]
    in_a_set = any(
        r.speaks_of(case) not in (None, r.options[0]) for case in cases for r in reported
    )
    return Score(
        right,
        right or all(_akin(case, reported) or case in absorbed for case in cases),
        sum(not _akin(case, reported) and case not in absorbed for case in cases),
        len(alarms),
        right and in_a_set,
        _said(reported),
        before,
        after,
        errors.own_floor,
        hidden=right and bool(absorbed),
        mechanism=right and all(case in absorbed or _told(case, placed) for case in cases),
        extra=max(len(reported) - len(cases), 0),
    )


def _told(case: ZooCase, placed: Sequence[Mapping[str, Any]]) -> bool:
    return any(
        any(is_called(one["effect"], key) for key in case.keys)
        and Named("", frozenset(one["where"])).near(case)
        for one in placed
    )


def _each_its_own(cases: Sequence[ZooCase], reported: Sequence[Reported]) -> bool:
    """Return whether each case has a reported effect that speaks of it and stands for no other."""
    return any(
        all(r.speaks_of(case) for case, r in zip(cases, some, strict=True))
        for some in permutations(reported, len(cases))
    )


def _score_unlisted(case: ZooCase, summary: Mapping[str, Any], errors: _Errors) -> Score:
    reported = _reported(summary)
    wrong = [r for r in reported if not any(_may_be(case, o) for o in r.options)]
    all_doubted = summary["unexplained"].get("doubtful") or all(r.doubted for r in wrong)
    in_doubt = bool(wrong and all_doubted)
    if in_doubt:
        wrong = []
    unknown = [r for r in reported if _may_be(case, r.options[0])]
    there = frozenset().union(*(_acts_at(case, r.options[0]) for r in unknown))
    signals = frozenset().union(*(r.signals | _second(case, r.options[0]) for r in unknown))
    described = _in_common(there, case) > _IN_COMMON and _depends(signals, SIGNALS[case.name])
    before, after = errors.before, errors.after
    # One of 1.5 times the floor cannot be halved: nothing falls below the floor.
    halved = after <= max(0.5 * before, _EXPLAINED)
    return Score(
        not wrong and described and halved,
        not wrong and bool(there & set(case.where)),
        int(not unknown),
        len(wrong),
        False,
        _said(reported),
        before,
        after,
        errors.own_floor,
        misnamed=bool(wrong),
        in_doubt=in_doubt,
        described=described,
        halved=halved,
    )


def _may_be(case: ZooCase, option: Named) -> bool:
    """Return whether what is reported may describe an unlisted effect: freely, or as one alike."""
    return option.kind == "unknown" or (option.kind in case.alike and option.first in case.where)


def _acts_at(case: ZooCase, option: Named) -> frozenset[str]:
    return option.where - _second(case, option)


def _second(case: ZooCase, option: Named) -> frozenset[str]:
    """Return places of a class that is alike which say on what it depends: a sensor's neighbour."""
    alike = option.kind in case.alike
    return option.where - {option.first, *case.where} if alike else frozenset()


def _depends(signals: frozenset[str], true: Sequence[set[str]]) -> bool:
    hit, false = sum(bool(one & signals) for one in true), signals.difference(*true)
    return bool(true[0] & signals) and hit / (len(true) + len(false)) >= _IN_COMMON


def median(values: Sequence[float]) -> float:
    """Return the median of those that are finite, nan of nothing."""
    finite = [value for value in values if math.isfinite(value)]
    return statistics.median(finite) if finite else math.nan


def _right(case: ZooCase, reported: Sequence[Reported]) -> bool:
    speaking = [(r, option) for r in reported if (option := r.speaks_of(case)) is not None]
    if not speaking:
        return False
    # Other forms of the same class at the same place are no other thing.
    if any(len(set(r.options)) > _MOST_IN_A_SET for r, _ in speaking):
        return False
    there = frozenset().union(*(option.where for _, option in speaking))
    return _in_common(there, case) > _IN_COMMON


def _in_common(there: frozenset[str], case: ZooCase) -> float:
    """Return how much of all places, named or true, is both."""
    true, named = set(case.where) - set(case.implied), set(there) - set(case.implied)
    if true - _CARRIERS:
        true, named = true - _CARRIERS, named - _CARRIERS
    return len(true & named) / max(len(true | named), 1)


def _akin(case: ZooCase, reported: Sequence[Reported]) -> bool:
    return any(option.akin(case) for r in reported for option in r.options)


def _family(kind: str) -> set[str]:
    return next((family for family in FAMILIES if kind in family), {kind})


def _reported(summary: Mapping[str, Any]) -> list[Reported]:
    found = []
    for effect in summary["effects"]:
        evidence = effect.get("evidence", {})
        options = [effect, *evidence.get("alternatives", [])]
        found.append(
            Reported(
                tuple(
                    Named(o["class"], frozenset(o["where"]), _first(o["where"])) for o in options
                ),
                frozenset(evidence.get("signals", [])),
                bool(evidence.get("perhaps_part_of")),
            )
        )
    return found


def _first(where: Sequence[str]) -> str:
    return where[0] if where else ""


@dataclass(frozen=True)
class _Errors:
    """Errors over the floor, nan of a model that ran away, and the result's own floor over it."""

    before: float
    after: float
    own_floor: float


def _errors(summary: Mapping[str, Any], floor: float | None) -> _Errors:
    told = summary["validation"]
    before, after = (math.nan if told[k] is None else float(told[k]) for k in ("before", "after"))
    own = float(told["noise_floor"])
    floor = own if floor is None else floor
    return _Errors(before / floor, after / floor, own / floor)


def _said(reported: Sequence[Reported]) -> str:
    return "; ".join(
        " or ".join(dict.fromkeys(_words(option) for option in r.options)) for r in reported
    )


def _words(named: Named) -> str:
    where = sorted(named.where)
    places = ", ".join(where) if len(where) <= 3 else f"{where[0]} .. {where[-1]}"
    return f"{named.kind} {places}".strip()
