"""Score imported plants with another default of one number of the search, before anything reads it.

Modules compute constants from the numbers of SearchOptions when they are imported, and methods that
no options reach use its defaults. So a number is changed first, in a process of its own, and all
else is imported after that. It prints, as JSON, whether the trace of each plant is right.
"""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser
from dataclasses import fields

from levid.identification.trace.search_options import SearchOptions


def main() -> None:
    """Read numbers by name and plants from standard input as JSON; print whether each is right."""
    about = "run by search_option_sensitivity.py; reads JSON with `numbers` and `jobs`"
    ArgumentParser(description=about).parse_args()
    asked = json.load(sys.stdin)
    for name, value in asked["numbers"].items():
        set_default(name, value)
    print(json.dumps([is_right(*job) for job in asked["jobs"]]))


def set_default(name: str, value: float) -> None:
    """Change the default of a number of SearchOptions for this process."""
    names = [f.name for f in fields(SearchOptions)]
    known = dict(zip(names, SearchOptions.__init__.__defaults__ or (), strict=True))
    if name not in known:
        raise ValueError(f"a number of SearchOptions was expected, {', '.join(known)}; got {name}")
    known[name] = type(known[name])(value)
    SearchOptions.__init__.__defaults__ = tuple(known.values())
    setattr(SearchOptions, name, known[name])


def is_right(plant: str, law: str, seed: int) -> bool:
    """Return whether a trace of a plant says what is right, and nothing else."""
    from threadpoolctl import threadpool_limits

    from levid.benchmarks.trace.imported_plants import scored

    with threadpool_limits(1):
        return scored(plant, law, seed).good


if __name__ == "__main__":
    main()
