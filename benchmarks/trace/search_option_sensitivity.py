"""Halve and double each number that decides: how far the score of imported plants moves.

These are the numbers of SearchOptions, and those of the methods for imported records that could
change a name: when a DOF rests, how rich a free form is, how finely a spectrum is resolved.

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
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from multiprocessing import get_context

from threadpoolctl import threadpool_limits

from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.benchmarks.trace.imported_plant_effects import CASES, LAWS
from levid.benchmarks.trace.imported_plants import jobs, scored
from levid.identification.trace.force_regression import (
    force_record,
    held_out_gain,
    residual_whitening,
    rests,
    richest_free_form,
)
from levid.identification.trace.search_options import SearchOptions

SEEDS, QUICK = 1, 1
PLANTS = ("drive", "pendulum", "levitation")
"""Plants of one DOF, which are traced in seconds."""
FIRST_SEED = 130_000
"""No plant of these seeds was used to develop the trace."""
OF_THE_RIG = ("law_accuracy", "block_s")
"""Numbers that the search in prediction errors alone reads."""
MOST_POINTS = 2.0


METHODS = {
    "rest_turns": (rests, "_TURNS"),
    "foretold_variances": (held_out_gain, "_FORETOLD"),
    "form_degree": (richest_free_form, "_DEGREE"),
    "form_range": (richest_free_form, "_WIDE"),
    "form_rows": (richest_free_form, "_ROWS_PER_NUMBER"),
    "spectrum_segments": (residual_whitening, "SEGMENTS"),
    "rows_per_period": (force_record, "_OVERSAMPLED"),
}
"""Numbers of the methods by name: module and constant."""


@dataclass(frozen=True)
class Variant:
    """One number halved or doubled: the options, or a method's number by name."""

    name: str
    options: SearchOptions
    method: tuple[str, float] | None = None


def main() -> None:
    """Score the plants with each number changed, and print by how much the score moves."""
    options = parser("Sensitivity of the trace to its numbers; --quick: one seed, two numbers")
    options.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help="of each plant")
    options.add_argument("--first-seed", type=int, default=FIRST_SEED, metavar="N")
    options.add_argument("--plants", nargs="+", default=PLANTS, choices=CASES, metavar="PLANT")
    names = [f.name for f in fields(SearchOptions) if f.name not in OF_THE_RIG]
    options.add_argument("--numbers", nargs="+", default=(*names, *METHODS), metavar="NUMBER",
                         choices=(*names, *METHODS), help="only these")  # fmt: skip
    arguments = options.parse_args()
    seeds = QUICK if arguments.quick else arguments.seeds
    every_one = [*variants(SearchOptions()), *method_variants()]
    chosen = [v for v in every_one if v.name.split()[0] in arguments.numbers]
    changed = chosen[: 4 if arguments.quick else None]

    def measure() -> Iterator[Figure]:
        with ProcessPoolExecutor(len(os.sched_getaffinity(0)), get_context("spawn")) as pool:
            todo = jobs(arguments.plants, [*LAWS], arguments.first_seed, seeds)
            every = [Variant("as they are", SearchOptions()), *changed]
            futures = [[pool.submit(is_right, *job, one) for job in todo] for one in every]
            scores = []
            for one, some in zip(every, futures, strict=True):
                scores.append(100.0 * sum(f.result() for f in some) / len(todo))
                print(f"{one.name}: {scores[-1]:.1f} %", file=sys.stderr)
        yield Figure("score", scores[0], "%", f"right, numbers as they are (of {len(todo)})")
        for one, score in zip(changed, scores[1:], strict=True):
            moved, target = abs(score - scores[0]), Target(most=MOST_POINTS)
            yield Figure(one.name.replace(" ", "_"), moved, "points", one.name, target=target)

    show("Sensitivity to the numbers of the search", arguments, measure)


def variants(options: SearchOptions) -> Iterator[Variant]:
    """Yield the options with one number halved or doubled."""
    for field in fields(options):
        if field.name in OF_THE_RIG:
            continue
        value = getattr(options, field.name)
        for word, factor in (("half", 0.5), ("double", 2.0)):
            other = type(value)(round(factor * value, 12))
            yield Variant(f"{field.name} {word}", replace(options, **{field.name: other}))


def method_variants() -> Iterator[Variant]:
    """Yield one number of the methods halved or doubled."""
    for name in METHODS:
        for word, factor in (("half", 0.5), ("double", 2.0)):
            yield Variant(f"{name} {word}", SearchOptions(), (name, factor))


@contextmanager
def changed_method(method: tuple[str, float] | None) -> Iterator[None]:
    """Multiply a number of a method while the context lasts; whole numbers stay whole."""
    if method is None:
        yield
        return
    module, constant = METHODS[method[0]]
    value = getattr(module, constant)
    setattr(module, constant, type(value)(method[1] * value))
    try:
        yield
    finally:
        setattr(module, constant, value)


def is_right(plant: str, law: str, seed: int, variant: Variant) -> bool:
    """Return whether a trace of a plant says what is right, and nothing else."""
    with threadpool_limits(1), changed_method(variant.method):
        return scored(plant, law, seed, variant.options).good


if __name__ == "__main__":
    main()
