"""Test how the sensitivity benchmark changes the numbers of the search."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict, fields

from levid.benchmarks.trace.search_option_sensitivity import (
    EVEN,
    OF_THE_RIG,
    differences,
    variants,
)
from levid.identification.trace.search_options import SearchOptions


def test_each_number_is_halved_and_doubled_by_itself() -> None:
    plain, seen = asdict(SearchOptions()), set()
    for variant in variants(SearchOptions()):
        assert type(variant.value) is type(plain[variant.name])
        factor = 0.5 if variant.label.endswith("half") else 2.0
        # A half of an odd whole number is rounded down, or to an even one.
        assert abs(variant.value - factor * plain[variant.name]) <= 1.0
        assert variant.name not in EVEN or variant.value % 2 == 0
        seen.add(variant.label)
    names = {f.name for f in fields(SearchOptions)} - set(OF_THE_RIG)
    assert seen == {f"{name} {how}" for name in names for how in ("half", "double")}


def test_a_changed_number_reaches_what_follows_from_it() -> None:
    code = (
        "import json\n"
        "from levid.benchmarks.trace.imported_plants_with_search_option import set_default\n"
        "set_default('resolved', 8)\n"
        "from levid.identification.trace.search_options import SearchOptions\n"
        "from levid.identification.trace.force_regression import residual_whitening as w\n"
        "print(json.dumps([SearchOptions().resolved, SearchOptions().fewest_blocks, w.SEGMENTS]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == [8, 16, 8]


def test_only_plants_that_change_are_named() -> None:
    todo = [("drive", "lag", 1), ("drive", "drag", 1), ("pendulum", "none", 2)]
    found = differences(todo, [True, True, False], [True, False, True])
    assert found == ["drive drag 1 wrong", "pendulum none 2 right"]
