"""Test how the sensitivity benchmark changes the numbers of the search."""

from __future__ import annotations

from dataclasses import asdict, fields

from levid.benchmarks.trace.search_option_sensitivity import OF_THE_RIG, variants
from levid.identification.trace.search_options import SearchOptions


def test_each_number_is_halved_and_doubled_by_itself() -> None:
    plain, seen = asdict(SearchOptions()), set()
    for name, options in variants(SearchOptions()):
        (changed,) = [key for key, value in asdict(options).items() if value != plain[key]]
        assert name.startswith(changed)
        assert type(getattr(options, changed)) is type(plain[changed])
        seen.add(name)
    names = {f.name for f in fields(SearchOptions)} - set(OF_THE_RIG)
    assert seen == {f"{name} {how}" for name in names for how in ("half", "double")}


def test_ratios_change_in_what_they_exceed_one_by() -> None:
    found = dict(variants(SearchOptions()))
    assert abs(found["much_left half"].much_left - 1.15) < 1e-9
    assert abs(found["much_left double"].much_left - 1.6) < 1e-9
    assert found["most_effects half"].most_effects == 3
