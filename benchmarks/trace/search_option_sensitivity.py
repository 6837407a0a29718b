"""Halve and double each number of SearchOptions: how far the score of imported plants moves.

The plants are those of imported_plants.py, drawn with and without effects. The score is the share
of records with the right name alone or in a group and no false one, or without any name where
nothing is missing. Each number is changed everywhere, also where constants follow from it. What
decides in prediction errors of the rig only is not among them: it needs the hours of
hidden_effects.py for each number. Which plants change is printed on the way.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields

from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.benchmarks.trace import imported_plants_with_search_option
from levid.benchmarks.trace.imported_plant_effects import CASES, LAWS
from levid.benchmarks.trace.imported_plants import jobs
from levid.identification.trace.search_options import SearchOptions

SEEDS, QUICK = 1, 1
PLANTS = ("drive", "pendulum", "levitation")
"""Plants of one DOF, which are traced in seconds."""
FIRST_SEED = 130_000
"""No plant of these seeds was used to develop the trace."""
OF_THE_RIG = ("law_accuracy", "block_s")
"""Numbers that the search in prediction errors alone reads."""
EVEN = ("interpolated",)
"""Numbers that have to be even; a half that is odd is rounded up."""
MOST_POINTS = 2.0

Job = tuple[str, str, int]


@dataclass(frozen=True)
class Variant:
    """One number of SearchOptions with another value; as they are, without a name."""

    label: str
    name: str = ""
    value: float = 0.0


def main() -> None:
    """Score the plants with each number changed, and print by how much the score moves."""
    options = parser("Sensitivity of the trace to its numbers; --quick: one seed, two numbers")
    options.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help="of each plant")
    options.add_argument("--first-seed", type=int, default=FIRST_SEED, metavar="N")
    options.add_argument("--plants", nargs="+", default=PLANTS, choices=CASES, metavar="PLANT")
    names = [f.name for f in fields(SearchOptions) if f.name not in OF_THE_RIG]
    options.add_argument("--numbers", nargs="+", default=names, metavar="NUMBER", choices=names,
                         help="only these")  # fmt: skip
    arguments = options.parse_args()
    seeds = QUICK if arguments.quick else arguments.seeds
    chosen = [v for v in variants(SearchOptions()) if v.name in arguments.numbers]
    changed = chosen[: 4 if arguments.quick else None]

    def measure() -> Iterator[Figure]:
        todo = jobs(arguments.plants, [*LAWS], arguments.first_seed, seeds)
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            every = [Variant("as they are"), *changed]
            futures = [pool.submit(right, one, todo) for one in every]
            plain = futures[0].result()
            score = 100.0 * sum(plain) / len(todo)
            yield Figure("score", score, "%", f"right, numbers as they are (of {len(todo)})")
            for one, future in zip(changed, futures[1:], strict=True):
                now = future.result()
                said = ", ".join(differences(todo, plain, now)) or "no plant changes"
                print(f"{one.label}: {said}", file=sys.stderr, flush=True)
                moved = abs(100.0 * sum(now) / len(todo) - score)
                target = Target(most=MOST_POINTS)
                yield Figure(one.label.replace(" ", "_"), moved, "points", one.label, target=target)

    show("Sensitivity to the numbers of the search", arguments, measure)


def variants(options: SearchOptions) -> Iterator[Variant]:
    """Yield each number halved and doubled."""
    for field in fields(options):
        if field.name in OF_THE_RIG:
            continue
        value = getattr(options, field.name)
        for word, factor in (("half", 0.5), ("double", 2.0)):
            other = type(value)(round(factor * value, 12))
            if field.name in EVEN:
                other += other % 2
            yield Variant(f"{field.name} {word}", field.name, other)


def right(variant: Variant, todo: Sequence[Job]) -> list[bool]:
    """Return whether each plant's trace is right with a number changed, in another process."""
    numbers = {variant.name: variant.value} if variant.name else {}
    done = subprocess.run(
        [sys.executable, "-m", imported_plants_with_search_option.__name__],
        input=json.dumps({"numbers": numbers, "jobs": todo}),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return [bool(ok) for ok in json.loads(done.stdout)]


def differences(todo: Sequence[Job], plain: Sequence[bool], now: Sequence[bool]) -> list[str]:
    """Return the plants whose trace is right by one of two variants only, in words."""
    return [
        f"{plant} {law} {seed} {'right' if ok else 'wrong'}"
        for (plant, law, seed), before, ok in zip(todo, plain, now, strict=True)
        if ok != before
    ]


if __name__ == "__main__":
    main()
