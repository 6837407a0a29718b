"""Count the numbers in the code of the trace: how many decide, and where they stand.

A numeric literal other than 0, 1, -1, 2 and 1/2 counts, wherever it stands. Those in SearchOptions
have a meaning and a derivation there; the others are tolerances and sizes of methods, and of the
search in prediction errors also thresholds.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from levid.benchmarks.harness.benchmark_runner import Figure, Target, run
from levid.identification import trace

TRACE = Path(trace.__file__).parent
OPTIONS = "search_options.py"
PLAIN = {0, 1, 2, 0.5}
MOST = Target(most=15)


def numbers(source: str) -> list[float]:
    """Return the numeric literals of a module that count, in order."""
    found = [node.value for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Constant)]
    return [v for v in found if type(v) in (int, float) and v not in PLAIN]


def main() -> None:
    """Print the counts, by package."""
    run("Numbers in the code of the trace", lambda _quick: measure())


def measure() -> Iterator[Figure]:
    """Yield one figure for each package, for SearchOptions, and for all."""
    counts: dict[str, int] = {}
    for file in sorted(TRACE.rglob("*.py")):
        folder = file.parent.relative_to(TRACE).as_posix()
        key = "SearchOptions" if file.name == OPTIONS else {".": "trace"}.get(folder, folder)
        counts[key] = counts.get(key, 0) + len(numbers(file.read_text()))
    options = counts.pop("SearchOptions")
    yield Figure("search_options", options, "", "in SearchOptions", target=MOST)
    for key, count in counts.items():
        yield Figure(key, count, "", f"  in {key}")
    yield Figure("all", options + sum(counts.values()), "", "in the whole trace", target=MOST)


if __name__ == "__main__":
    main()
