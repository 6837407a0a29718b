"""Test how the sensitivity benchmark changes the numbers of the search."""

from __future__ import annotations

from dataclasses import asdict, fields

from levid.benchmarks.trace.search_option_sensitivity import (
    METHODS,
    OF_THE_RIG,
    changed_method,
    method_variants,
    variants,
)
from levid.identification.trace.search_options import SearchOptions


def test_each_number_is_halved_and_doubled_by_itself() -> None:
    plain, seen = asdict(SearchOptions()), set()
    for variant in variants(SearchOptions()):
        name, options = variant.name, variant.options
        (changed,) = [key for key, value in asdict(options).items() if value != plain[key]]
        assert name.startswith(changed)
        assert type(getattr(options, changed)) is type(plain[changed])
        seen.add(name)
    names = {f.name for f in fields(SearchOptions)} - set(OF_THE_RIG)
    assert seen == {f"{name} {how}" for name in names for how in ("half", "double")}


def test_what_follows_from_a_number_changes_with_it() -> None:
    found = {v.name: v.options for v in variants(SearchOptions())}
    assert abs(found["least_gain half"].much_left - 1.15) < 1e-9
    assert abs(found["least_gain double"].much_left - 1.6) < 1e-9
    assert found["most_effects half"].most_effects == 3


def test_numbers_of_methods_change_for_as_long_as_asked() -> None:
    for variant in method_variants():
        assert variant.method is not None
        module, constant = METHODS[variant.method[0]]
        plain = getattr(module, constant)
        with changed_method(variant.method):
            changed = getattr(module, constant)
            assert type(changed) is type(plain)
            # A half of an odd whole number is rounded down.
            assert abs(changed - variant.method[1] * plain) <= 0.5
        assert getattr(module, constant) == plain
