"""The zoo: plants with effects that nobody declared, and whether a trace names them.

Every effect that the simulator knows, alone, so large that the error of the declared model,
refitted, is 5 and 20 times the noise floor (or as large as physics allows); pairs of them; plants
with nothing undeclared; and effects that no table knows. Each is flown by config/sessions/
trace-short.yaml, and its logs are traced without a word of what is in the plant. What counts as
right is said in zoo_score.py.

Results are kept as they come, one line each, in OUT/results.jsonl; what is there already, of the
same plant, size, seed and code, is not flown again. A plant that cannot be flown, since with this
seed it meets its stops, is flown with effects of 0.8 times the size, then of 0.64, and so on down
to a quarter. Rows, lines and figures are made from what is kept, so that a change of the scoring
flies nothing; --show prints them. With --publish what one code has found, in several runs, is
written into zoo-results.jsonl.gz beside this file: as long as the code is that one, its plants are
not flown either, but for --afresh.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict
from pathlib import Path

from rich.table import Table

from levid.benchmarks.harness.table import Figure, parser, show
from levid.benchmarks.trace.zoo_cases import CASES, UNLISTED
from levid.benchmarks.trace.zoo_fly import (
    PARTS,
    Entries,
    Found,
    TooLargeError,
    flies_empty,
    fly_and_trace,
)
from levid.benchmarks.trace.zoo_plan import FIRST_SEED, Plant, plan
from levid.benchmarks.trace.zoo_pool import run_apart
from levid.benchmarks.trace.zoo_results import Kept, Result
from levid.benchmarks.trace.zoo_sizes import (
    Sizes,
    known_floor_m,
    known_sizes,
    noise_floor_m,
    sizes_of,
)
from levid.benchmarks.trace.zoo_tables import score_of, summary_table, told, verdicts_table

PROCESSES = 2
LONGEST_S = 1800.0
"""On a machine that does much else; alone it takes about a minute and a half."""
DRAWS, OTHER_DRAW = 3, 500
"""So often a seed is drawn, and so far from the last one, if a plant that holds nothing meets its
stops with it."""
PUBLISHED = Path(__file__).with_name("zoo-results.jsonl.gz")
_THIS = "this"
DEFAULT = Path(__file__).resolve().parents[2] / "build" / "zoo"


def main() -> None:
    options = _options()
    arguments = options.parse_args()
    if arguments.quick and arguments.full:
        options.error("expected --quick or --full, found both")
    zoo = _Kept(arguments) if arguments.show else _Flown(arguments)
    show("The zoo against its targets", arguments, zoo.measure, zoo.tables)


class _Flown:
    """The plants of a plan, flown as far as there is no result of them."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._arguments, self._results = arguments, list[Result]()
        self._plants = _plants(arguments)

    def measure(self) -> Iterator[Figure]:
        """Fly, and yield the figures, after an interrupt too: of what there is by then."""
        plants, out = self._plants, self._arguments.out
        sizes = sizes_of([case for plant in plants for case in plant.cases], PROCESSES, _say)
        floor_m = noise_floor_m(_say)
        kept = Kept(out, None if self._arguments.afresh else PUBLISHED)
        try:
            flights = out / "flights" if self._arguments.keep_flights else None
            _fly_all(plants, sizes, kept, floor_m, flights)
        finally:
            _publish(kept, self._arguments)
            self._results = [r for r in kept.of(plants, sizes, floor_m) if r.flown]
            yield from told(self._results, len(plants) if self._default else None)

    def tables(self) -> list[Table]:
        """Return what was found of each plant, and what it comes to."""
        return [verdicts_table(self._results), summary_table(self._results)]

    @property
    def _default(self) -> bool:
        a = self._arguments
        return not (a.quick or a.full or a.only or a.times)


class _Kept:
    """The results that there are of one version of the code."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        kept = Kept(arguments.out, PUBLISHED)
        code = kept.version if arguments.show == _THIS else arguments.show
        if code not in kept.codes:
            others = ", ".join(f"{count} of {other}" for other, count in kept.codes.items())
            raise SystemExit(f"error: no result of code {code} is kept; there are: {others or 0}")
        if arguments.publish and code != kept.version:
            raise SystemExit(f"error: --publish is for results of this code, {kept.version}")
        _publish(kept, arguments)
        results = kept.all(code, known_sizes(), known_floor_m())
        chosen = _chosen([result.plant for result in results], arguments)
        self._results = [result for result in results if result.plant in chosen]

    def measure(self) -> list[Figure]:
        """Return the figures."""
        return told(self._results, None)

    def tables(self) -> list[Table]:
        """Return what was found of each plant, and what it comes to."""
        return [verdicts_table(self._results), summary_table(self._results)]


def _publish(kept: Kept, arguments: argparse.Namespace) -> None:
    if arguments.publish:
        _say(f"{PUBLISHED.name}: {kept.publish(PUBLISHED)} results")


def _plants(arguments: argparse.Namespace) -> list[Plant]:
    """Return what is to be flown; raises SystemExit where that is nothing."""
    plants = plan(arguments.quick, arguments.full, arguments.first_seed, bool(arguments.only))
    plants = _chosen(plants, arguments)
    if not plants:
        times = " ".join(f"{times:g}" for times in arguments.times or ())
        more = "" if arguments.full else "; add --full, which has 1.5 and more plants"
        raise SystemExit(f"error: this plan has no such plant of --times {times}{more}")
    return plants


def _chosen(plants: Sequence[Plant], arguments: argparse.Namespace) -> list[Plant]:
    """Return the plants that --only and --times leave."""
    known = {case.name: case for case in CASES + UNLISTED}
    unknown = sorted(set(arguments.only or ()) - set(known) - {"nothing", "pair", "triple"})
    if unknown:
        raise SystemExit(f"error: --only: expected names of zoo-cases.yaml, found {unknown}")
    if arguments.only:
        only = set(arguments.only)
        plants = [p for p in plants if p.kind in only or {c.name for c in p.cases} <= only]
        plants = [p for p in plants if p.cases or p.kind in only]
    if arguments.times:
        plants = [p for p in plants if p.cases and p.times in arguments.times]
    return list(plants)


def _options() -> argparse.ArgumentParser:
    options = parser("The zoo: which effects a trace finds; --quick: eight named cases")
    options.add_argument(
        "--full",
        action="store_true",
        help="1.5 times the floor too, three seeds, more pairs, all unlisted effects",
    )
    options.add_argument("--out", type=Path, default=DEFAULT, help="where results are kept")
    options.add_argument(
        "--show",
        nargs="?",
        const=_THIS,
        metavar="CODE",
        help="fly nothing: print what is kept, of this code or of another version of it",
    )
    options.add_argument(
        "--first-seed",
        type=int,
        default=FIRST_SEED,
        metavar="N",
        help="draw noise, excitation and pairs by other seeds, from this one on",
    )
    options.add_argument(
        "--afresh", action="store_true", help=f"fly what {PUBLISHED.name} holds, too"
    )
    options.add_argument(
        "--publish", action="store_true", help=f"add what this code found to {PUBLISHED.name}"
    )
    options.add_argument(
        "--keep-flights", action="store_true", help="keep logs too, 50 MB a plant, to trace again"
    )
    options.add_argument(
        "--only", nargs="+", metavar="NAME", help="cases by name, or nothing, pair, triple"
    )
    options.add_argument(
        "--times", nargs="+", type=float, metavar="N", help="of these sizes only, as 1.5 of --full"
    )
    return options


def _fly_all(
    plants: Sequence[Plant],
    sizes: dict[str, Sizes],
    kept: Kept,
    floor_m: float | None,
    flights: Path | None,
) -> None:
    """Fly and trace the plants that there is no result of; logs stay in `flights`, if given."""
    missing = [plant for plant in plants if not kept.has(plant, sizes)]
    if len(missing) < len(plants):
        _say(f"{len(plants) - len(missing)} of {len(plants)} plants were flown before by this code")
    begun = [
        _Task(plant, {part: plant.entries(sizes, part) for part in PARTS}, flights)
        for plant in missing
    ]
    # Whatever ends this ends the processes that fly.
    with closing(run_apart(_Task.fly, begun, PROCESSES, LONGEST_S)) as flown:
        for count, done in enumerate(flown, 1):
            own = done.item.plant.seed
            part, seed, found = (1.0, own, None) if done.answer is None else done.answer
            result = Result(
                done.item.plant,
                None if found is None else asdict(found),
                done.failed,
                tuple(done.item.plant.entries(sizes, part)),
                part < 1.0,
                done.seconds,
                floor_m,
                seed,
            )
            kept.add(result, sizes)
            less = f", {part:g} of the size" if result.less else ""
            drawn = f", drawn anew with seed {seed}" if seed != own else ""
            _say(f"{count}/{len(missing)} {_line(result)}{less}{drawn} ({done.seconds:.0f} s)")


class _Task:
    """A plant to be flown in another process."""

    def __init__(self, plant: Plant, parts: Mapping[float, Entries], flights: Path | None) -> None:
        self.plant, self.parts, self.flights = plant, parts, flights

    def fly(self) -> tuple[float, int, Found]:
        """Return how much of its size can be flown, with which seed, and what was found."""
        own = self.plant.seed
        try:
            return 1.0, own, self._with(1.0, own)
        except TooLargeError as error:
            too_large = error
        # What the seed draws may by itself leave the range to fly in, about once in 150 plants.
        draws = range(own, own + DRAWS * OTHER_DRAW, OTHER_DRAW)
        seed = next((seed for seed in draws if flies_empty(seed)), own)
        for part in self.parts:
            if (part, seed) != (1.0, own):
                with suppress(TooLargeError):
                    return part, seed, self._with(part, seed)
        raise too_large

    def _with(self, part: float, seed: int) -> Found:
        return fly_and_trace(self.parts[part], seed, self.flights)


def _line(result: Result) -> str:
    if result.found is None:
        return f"{result.plant.name}: failed: {result.failed}"
    score = score_of(result)
    after = score.after_over_floor
    ending = "" if math.isnan(after) else f", after {after:.2f} x floor"
    verdict = "right" if score.right else "wrong"
    return f"{result.plant.name}: {verdict}: {score.said or 'nothing'}{ending}"


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")


if __name__ == "__main__":
    main()
