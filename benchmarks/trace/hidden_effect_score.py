"""Score what a trace reports of a plant against the effects that are in the plant.

A reported effect, or one of its alternatives, *matches* an effect of the plant if it has its class
and shares a place with it. The effect is *right* if, besides,

- its places and those of all matching reports have more than half in common (the intersection over
  the union); `beam` and `rotor`, which a class implies, count only where there is no other place;
- no matching report has more than three alternatives (class and places).

A plant is right if each of its effects is right by a report of its own and there is no *false
alarm*: a report that matches none of the effects, unless it has an equivalent class (`alike`) and
no report names the true one. If the refitted model absorbs the effect and its error is at the
floor, not to report it is right too (*hidden*): without any effect, or with the others. For a plant
without effects it is right to report nothing, and that the rest is not significant.

A plant with an unlisted effect is right if no report is *misnamed* (has a known class that the case
does not allow, without being marked as doubtful), if it is *described* (a report of class `unknown`
has more than half of its places in common with the truth; its signals include one of the first set
and have at least half in common with all of them), and if the error is *halved*, or at the floor.

Errors are over the noise floor of a plant without effects: the floor in a report moves with the
effect, since a faulty sensor may pass for a noisy one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import Any

from levid.benchmarks.trace.hidden_effect_cases import Case

EXPLAINED = 1.15
"""Error over the floor of a model that explains the records."""
_IMPLIED_BY_CLASS = {"beam", "rotor"}
_IN_COMMON = 0.5
"""Places need more, signals at least."""
_MOST_ALTERNATIVES = 3


@dataclass(frozen=True)
class Score:
    """The score of a plant; before and after are errors over the floor."""

    said: str
    before: float
    after: float
    right: bool = False
    false_alarms: int = 0
    hidden: bool = False


@dataclass(frozen=True)
class _Named:
    """A reported class at its places; the first place is where it acts."""

    kind: str
    where: frozenset[str]
    first: str = field(compare=False)

    def near(self, case: Case) -> bool:
        return bool(self.where & _counted(case.where))

    def matches(self, case: Case) -> bool:
        return self.kind == case.kind and self.near(case)

    def fits_unlisted(self, case: Case) -> bool:
        return self.kind == "unknown" or (self.kind in case.alike and self.first in case.where)

    def depends_on(self, case: Case) -> frozenset[str]:
        """Return places of an allowed class that are signals, as the neighbour in a crosstalk."""
        return self.where - {self.first, *case.where} if self.kind in case.alike else frozenset()

    def __str__(self) -> str:
        where = sorted(self.where)
        places = ", ".join(where) if len(where) <= 3 else f"{where[0]} .. {where[-1]}"
        return f"{self.kind} {places}".strip()


@dataclass(frozen=True)
class _Report:
    """A reported effect, its alternatives behind it."""

    options: tuple[_Named, ...]
    signals: frozenset[str]
    doubtful: bool

    def match(self, case: Case) -> _Named | None:
        return next((option for option in self.options if option.matches(case)), None)

    def is_alike(self, case: Case) -> bool:
        return any(option.kind in case.alike and option.near(case) for option in self.options)

    def __str__(self) -> str:
        return " or ".join(dict.fromkeys(map(str, self.options)))


def score_plant(cases: Sequence[Case], summary: Mapping[str, Any], floor: float) -> Score:
    """Return the score of a trace of a plant with these effects.

    summary: the output of `levid trace --json`. floor: that of a plant without effects, in the unit
    of the summary's errors.
    """
    told = summary["validation"]
    # The error of a model that diverges is null in JSON.
    before, after = (math.nan if told[k] is None else told[k] / floor for k in ("before", "after"))
    reports = [_report(effect) for effect in summary["effects"]]
    score = Score("; ".join(map(str, reports)) or "nothing", before, after)
    if len(cases) == 1 and cases[0].kind == "unknown":
        return _score_unlisted(cases[0], reports, score)
    return _score_listed(cases, reports, summary, score)


def named_truly(cases: Sequence[Case], named: Mapping[str, Any]) -> bool:
    """Return whether a reported name, with its class and places, is one of these effects.

    A class that fits the data as well as the true one (`alike`) counts.
    """
    one = _Named(named["class"], frozenset(named["where"]), (named["where"] or [""])[0])
    return any(one.matches(case) or (one.kind in case.alike and one.near(case)) for case in cases)


def _score_listed(
    cases: Sequence[Case], reports: Sequence[_Report], summary: Mapping[str, Any], score: Score
) -> Score:
    unmatched = [case for case in cases if not any(r.match(case) for r in reports)]
    error = score.before if len(cases) == 1 else score.after
    hidden = [case for case in unmatched if case.absorbed and error <= EXPLAINED]
    alarms = [
        r
        for r in reports
        if not any(r.match(case) for case in cases)
        and not any(r.is_alike(case) for case in unmatched)
    ]
    there = [case for case in cases if case not in hidden]
    right = (
        not alarms
        and math.isfinite(score.after)
        and all(_is_right(case, reports) for case in there)
        and any(
            all(r.match(case) for case, r in zip(there, some, strict=True))
            for some in permutations(reports, len(there))
        )
        and bool(cases or not summary["unexplained"]["significant"])
    )
    return replace(score, right=right, false_alarms=len(alarms), hidden=right and bool(hidden))


def _score_unlisted(case: Case, reports: Sequence[_Report], score: Score) -> Score:
    wrong = [r for r in reports if not any(o.fits_unlisted(case) for o in r.options)]
    if all(r.doubtful for r in wrong):
        wrong = []
    free = [r for r in reports if r.options[0].fits_unlisted(case)]
    where = frozenset().union(*(r.options[0].where - r.options[0].depends_on(case) for r in free))
    signals = frozenset().union(*(r.signals | r.options[0].depends_on(case) for r in free))
    found = sum(bool(one & signals) for one in case.signals)
    false = signals.difference(*case.signals)
    described = (
        _in_common(where, case) > _IN_COMMON
        and bool(case.signals[0] & signals)
        and found / (len(case.signals) + len(false)) >= _IN_COMMON
    )
    halved = score.after <= max(0.5 * score.before, EXPLAINED)  # 1.5 floors cannot be halved
    return replace(score, right=not wrong and described and halved, false_alarms=len(wrong))


def _is_right(case: Case, reports: Sequence[_Report]) -> bool:
    matching = [(r, option) for r in reports if (option := r.match(case)) is not None]
    # Other forms of one class at one place are one alternative.
    if any(len(set(r.options)) > _MOST_ALTERNATIVES for r, _ in matching):
        return False
    where = frozenset().union(*(option.where for _, option in matching))
    return _in_common(where, case) > _IN_COMMON


def _counted(where: Sequence[str]) -> set[str]:
    return set(where) - _IMPLIED_BY_CLASS or set(where)


def _in_common(where: frozenset[str], case: Case) -> float:
    """Return the places that are reported and true over those that are either."""
    true, named = set(case.where) - set(case.implied), where - set(case.implied)
    if true - _IMPLIED_BY_CLASS:
        true, named = true - _IMPLIED_BY_CLASS, named - _IMPLIED_BY_CLASS
    return len(true & named) / max(len(true | named), 1)


def _report(effect: Mapping[str, Any]) -> _Report:
    evidence = effect.get("evidence", {})
    members = effect["alternatives"] if effect["class"] == "ambiguous" else [effect]
    options = tuple(
        _Named(o["class"], frozenset(o["where"]), (o["where"] or [""])[0])
        for o in (*members, *evidence.get("alternatives", []))
    )
    doubtful = bool(evidence.get("perhaps_part_of") or evidence.get("doubtful"))
    return _Report(options, frozenset(evidence.get("signals", [])), doubtful)
