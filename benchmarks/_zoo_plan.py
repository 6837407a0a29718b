"""Which plants of the zoo are flown: what is in each, how large, with which seed."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from _zoo_cases import CASES, UNLISTED, ZooCase
from _zoo_sizes import Sizes

QUICK = (
    "cubic-z",
    "coulomb-z",
    "bouc-wen-psi",
    "magnet-field",
    "gain-coil-3",
    "gain-sensor-2",
    "mains-z",
)
"""One of every sort; with a plant that holds nothing they are eight."""
_PAIR_TIMES = 5.0
_FIRST_SEED = 1000


@dataclass(frozen=True)
class Plant:
    """A plant: `times` the noise floor is the error of each of its cases by itself.

    kind: alone, pair, nothing or unlisted.
    """

    kind: str
    cases: tuple[ZooCase, ...]
    times: float
    seed: int

    @property
    def name(self) -> str:
        """What it is called in tables."""
        what = " + ".join(case.name for case in self.cases)
        size = f" {self.times:g}x" if self.cases else ""
        return f"{what or 'nothing'}{size} (seed {self.seed})"

    @property
    def group(self) -> str:
        """What it is counted with."""
        return f"{self.kind} {self.times:g}x" if self.cases else self.kind

    def entries(self, sizes: Mapping[str, Sizes]) -> list[dict[str, Any]]:
        """Return the `effects` of its SIM.yaml."""
        return [case.effect(sizes[case.name].scale(self.times)) for case in self.cases]


def plan(quick: bool, full: bool) -> list[Plant]:
    """Return the plants of the benchmark, of its quick or of its full edition."""
    if quick:
        by_name = {case.name: case for case in CASES}
        alone = [
            Plant("alone", (by_name[name],), 5.0, _FIRST_SEED + i) for i, name in enumerate(QUICK)
        ]
        return [*alone, Plant("nothing", (), 0.0, _FIRST_SEED)]
    seeds = 3 if full else 1
    times = (1.5, 5.0, 20.0) if full else (5.0, 20.0)
    plants = [
        Plant(kind, (case,), t, _FIRST_SEED * (s + 1) + i)
        for s in range(seeds)
        for t in times
        for kind, cases in (("alone", CASES), ("unlisted", UNLISTED))
        for i, case in enumerate(cases)
    ]
    count = 20 if full else 10
    plants += [
        Plant("pair", pair, _PAIR_TIMES, 5 * _FIRST_SEED + i)
        for i, pair in enumerate(_pairs(count))
    ]
    plants += [Plant("nothing", (), 0.0, 6 * _FIRST_SEED + i) for i in range(count)]
    # What was left when it was stopped is then of every sort.
    random.Random(0).shuffle(plants)
    return plants


def _pairs(count: int) -> Iterator[tuple[ZooCase, ZooCase]]:
    """Yield pairs of cases of different classes that a refit leaves something of."""
    rng = random.Random(1)
    visible: Sequence[ZooCase] = [case for case in CASES if case.absorbed is None and case.sized]
    while count:
        one, other = rng.sample(visible, 2)
        if one.kind != other.kind:
            yield one, other
            count -= 1
