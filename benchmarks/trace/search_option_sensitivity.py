"""Halve and double each number of SearchOptions: how far the score of imported plants moves.

The plants are those of imported_plants.py, drawn with and without effects. The score is the share
of records with the right name alone or in a group and no false one, or without any name where
nothing is missing. Numbers that are ratios to 1 are halved and doubled in what they exceed it by.
What decides in prediction errors of the rig only is not among them: it needs the hours of
hidden_effects.py for each number.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields, replace
from multiprocessing import get_context

from threadpoolctl import threadpool_limits

from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.benchmarks.trace.imported_plant_effects import CASES, LAWS
from levid.benchmarks.trace.imported_plants import jobs, scored
from levid.identification.trace.search_options import SearchOptions

SEEDS, QUICK = 1, 1
PLANTS = ("drive", "pendulum", "levitation")
"""Plants of one DOF, which are traced in seconds."""
FIRST_SEED = 130_000
"""No plant of these seeds was used to develop the trace."""
RATIOS = ("explained", "much_left")
OF_THE_RIG = ("law_accuracy", "explained")
"""Numbers that the search in prediction errors alone reads."""
MOST_POINTS = 2.0


def main() -> None:
    """Score the plants with each number changed, and print by how much the score moves."""
    options = parser("Sensitivity of the trace to its numbers; --quick: one seed, two numbers")
    options.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help="of each plant")
    options.add_argument("--first-seed", type=int, default=FIRST_SEED, metavar="N")
    options.add_argument("--plants", nargs="+", default=PLANTS, choices=CASES, metavar="PLANT")
    arguments = options.parse_args()
    seeds = QUICK if arguments.quick else arguments.seeds
    changed = list(variants(SearchOptions()))[: 4 if arguments.quick else None]

    def measure() -> Iterator[Figure]:
        with ProcessPoolExecutor(len(os.sched_getaffinity(0)), get_context("spawn")) as pool:
            todo = jobs(arguments.plants, [*LAWS], arguments.first_seed, seeds)
            every = [("as they are", SearchOptions()), *changed]
            futures = [[pool.submit(is_right, *job, option) for job in todo] for _, option in every]
            scores = []
            for (name, _), some in zip(every, futures, strict=True):
                scores.append(100.0 * sum(f.result() for f in some) / len(todo))
                print(f"{name}: {scores[-1]:.1f} %", file=sys.stderr)
        yield Figure("score", scores[0], "%", f"right, numbers as they are (of {len(todo)})")
        for (name, _), score in zip(changed, scores[1:], strict=True):
            key = name.replace(" ", "_")
            yield Figure(
                key, abs(score - scores[0]), "points", name, target=Target(most=MOST_POINTS)
            )

    show("Sensitivity to the numbers of the search", arguments, measure)


def variants(options: SearchOptions) -> Iterator[tuple[str, SearchOptions]]:
    """Yield the options with one number halved or doubled, by name."""
    for field in fields(options):
        if field.name in OF_THE_RIG:
            continue
        value = getattr(options, field.name)
        for word, factor in (("half", 0.5), ("double", 2.0)):
            one = 1.0 if field.name in RATIOS else 0.0
            other = type(value)(round(one + factor * (value - one), 12))
            yield f"{field.name} {word}", replace(options, **{field.name: other})


def is_right(plant: str, law: str, seed: int, options: SearchOptions) -> bool:
    """Return whether a trace of a plant with these options says what is right, and nothing else."""
    with threadpool_limits(1):
        return scored(plant, law, seed, options).good


if __name__ == "__main__":
    main()
