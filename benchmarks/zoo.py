"""The zoo: plants with effects that nobody declared, and whether a trace names them.

Every effect that the simulator knows, alone, so large that the error of the declared model,
refitted, is 5 and 20 times the noise floor (or as large as physics allows); pairs of them; plants
with nothing undeclared; and effects that no table knows. Each is flown by config/sessions/
trace-short.yaml, and its logs are traced without a word of what is in the plant. What counts as
right is said in _zoo_score.py.

Results are kept as they come, one line each, in OUT/results.jsonl; what is there already, of the
same plant, size, seed and code, is not flown again. A plant that cannot be flown, since with this
seed it meets its stops, is flown with effects a fifth smaller, and so on. Rows, lines and figures
are made from what is kept, so that a change of the scoring flies nothing. With --publish what one
code has found, in several runs, is written into zoo-results.jsonl.gz beside this file: as long as
the code is that one, its plants are not flown either, but for --afresh.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from _zoo_cases import CASES, UNLISTED
from _zoo_fly import PARTS, Entries, Found, TooLargeError, fly_and_trace
from _zoo_plan import FIRST_SEED, Plant, plan
from _zoo_pool import run_apart
from _zoo_results import Kept, Result, figures, summary_table, verdicts_table
from _zoo_score import score_plant
from _zoo_sizes import Sizes, sizes_of
from rich.console import Console

PROCESSES = 2
LONGEST_S = 1800.0
"""On a machine that does much else; alone it takes about a minute and a half."""
PUBLISHED = Path(__file__).with_name("zoo-results.jsonl.gz")
DEFAULT = Path(__file__).resolve().parents[1] / "build" / "zoo"


def main() -> None:
    arguments = _parser().parse_args()
    known = {case.name: case for case in CASES + UNLISTED}
    unknown = sorted(set(arguments.only or ()) - set(known) - {"nothing", "pair", "triple"})
    if unknown:
        raise SystemExit(f"error: --only: expected names of zoo-cases.yaml, found {unknown}")
    plants = plan(arguments.quick, arguments.full, arguments.first_seed, bool(arguments.only))
    if arguments.only:
        only = set(arguments.only)
        plants = [p for p in plants if p.kind in only or {c.name for c in p.cases} <= only]
        plants = [p for p in plants if p.cases or p.kind in only]
    if arguments.times:
        plants = [p for p in plants if p.cases and p.times in arguments.times]
    sizes = sizes_of([case for plant in plants for case in plant.cases], PROCESSES, _say)
    kept = Kept(arguments.out, None if arguments.afresh else PUBLISHED)
    _fly_all(plants, sizes, kept, arguments.out / "flights" if arguments.keep_flights else None)
    if arguments.publish:
        _say(f"{PUBLISHED.name}: {kept.publish(PUBLISHED)} results")
    results = kept.of(plants, sizes)
    if arguments.json:
        json.dump({"figures": figures(results)}, sys.stdout)
        sys.stdout.write("\n")
    else:
        console = Console(width=None if sys.stdout.isatty() else 160)
        console.print(verdicts_table(results))
        console.print(summary_table(results))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="The zoo: which effects a trace finds")
    much = parser.add_mutually_exclusive_group()
    much.add_argument("--quick", action="store_true", help="eight named cases")
    much.add_argument(
        "--full",
        action="store_true",
        help="1.5 times the floor too, three seeds, more pairs, all unlisted effects",
    )
    parser.add_argument("--json", action="store_true", help='print {"figures": {NAME: number}}')
    parser.add_argument("--out", type=Path, default=DEFAULT, help="where results are kept")
    parser.add_argument(
        "--first-seed",
        type=int,
        default=FIRST_SEED,
        metavar="N",
        help="of others, none of which were seen",
    )
    parser.add_argument(
        "--afresh", action="store_true", help=f"fly what {PUBLISHED.name} holds, too"
    )
    parser.add_argument(
        "--publish", action="store_true", help=f"write {PUBLISHED.name} from what this code found"
    )
    parser.add_argument(
        "--keep-flights", action="store_true", help="keep logs too, 50 MB a plant, to trace again"
    )
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", help="cases by name, or nothing, pair, triple"
    )
    parser.add_argument(
        "--times", nargs="+", type=float, metavar="N", help="of these sizes only, as 1.5 of --full"
    )
    return parser


def _fly_all(
    plants: Sequence[Plant], sizes: dict[str, Sizes], kept: Kept, flights: Path | None
) -> None:
    """Fly and trace the plants that there is no result of; logs stay in `flights`, if given."""
    missing = [plant for plant in plants if not kept.has(plant, sizes)]
    if len(missing) < len(plants):
        _say(f"{len(plants) - len(missing)} of {len(plants)} plants were flown before by this code")
    begun = [
        _Task(plant, {part: plant.entries(sizes, part) for part in PARTS}, flights)
        for plant in missing
    ]
    for count, done in enumerate(run_apart(_Task.fly, begun, PROCESSES, LONGEST_S), 1):
        part, found = (1.0, None) if done.answer is None else done.answer
        entries = tuple(done.item.plant.entries(sizes, part))
        result = Result(
            done.item.plant, None if found is None else asdict(found), done.failed, entries
        )
        kept.add(result, sizes)
        less = "" if part == 1.0 else f", {part:g} of the size"
        _say(f"{count}/{len(missing)} {_line(result)}{less} ({done.seconds:.0f} s)")


class _Task:
    """A plant to be flown in another process."""

    def __init__(self, plant: Plant, parts: Mapping[float, Entries], flights: Path | None) -> None:
        self.plant, self.parts, self.flights = plant, parts, flights

    def fly(self) -> tuple[float, Found]:
        """Return how much of its size can be flown, and what was found."""
        *larger, smallest = self.parts
        for part in larger:
            with suppress(TooLargeError):
                return part, fly_and_trace(self.parts[part], self.plant.seed, self.flights)
        return smallest, fly_and_trace(self.parts[smallest], self.plant.seed, self.flights)


def _line(result: Result) -> str:
    if result.found is None:
        return f"{result.plant.name}: failed: {result.failed}"
    score = score_plant(result.plant.cases, result.found["summary"], result.found["placed"])
    after = score.after_over_floor
    ending = "" if math.isnan(after) else f", after {after:.2f} x floor"
    verdict = "right" if score.right else "wrong"
    return f"{result.plant.name}: {verdict}: {score.said or 'nothing'}{ending}"


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")


if __name__ == "__main__":
    main()
