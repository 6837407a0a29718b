"""Every key of every schema, given wrongly, is reported by name, in words, with what was found."""

from __future__ import annotations

import re

import pytest
from schema_samples import SCHEMAS, Path, Sample, at, changed, paths

from levid.config.base import ConfigError, Strict, parse
from levid.config.load_any_kind import KINDS

WRONG: tuple[object, ...] = (
    *(None, True, "?!", "", "1e3", -1, 0, 1.5, -1e300, 1e300, float("nan"), float("inf"), 10**30),
    *([], [[]], [None], {}, {"zz": 1}, {"a": {"zz": 1}}, [{"zz": 1}], [1.0, "?"]),
)
NEVER: tuple[object, ...] = ([None], {"a": {"zz": 1}})
"""Values that no key takes that is neither a list nor a mapping."""
JARGON = re.compile(
    r"pydantic|NoneType|input_value|validation error|[a-z]+_parsing|[a-z]+_type\b|Input should|"
    r"another value|another form|Value error|Assertion|instance of|Union|Literal|Optional|"
    r"\b(str|int|dict|tuple|float|bool|None|nan|inf|NaN|True|False|subclass|NoneType)\b|"
    r"\^|\\d|\[A-Z|\[a-z|\$$"
)
"""Words of Python, of its libraries and of regular expressions."""

COMPLETE = re.compile(
    r": expected .+[,;] found .|: unknown key; expected .|: required \w+ is missing|not listed$"
)
"""A mistake's line says what was expected and what was found."""


def dotted(path: Path) -> str:
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path).lstrip(".")


def lines_of(data: object, kind: type[Strict]) -> list[str]:
    try:
        parse(data, kind, "FILE")
    except ConfigError as error:
        return str(error).splitlines()
    return []


def check_lines(lines: list[str]) -> None:
    for line in lines:
        assert not JARGON.search(line.partition(", found ")[0]), line
        assert COMPLETE.search(line), line


def test_samples_have_every_key() -> None:
    keys = {key for path in paths(Sample(KINDS["rig"]).data) for key in path}
    assert {"coil_x_m", "kp_n_m_rad", "late_window_s", "data_bitrate", "allow_users"} <= keys
    keys = {key for path in paths(Sample(KINDS["session"]).data) for key in path}
    assert {"band_hz", "check_coils", "push_s", "orthogonal", "periods", "to_rad"} <= keys


@pytest.mark.parametrize("name", SCHEMAS)
def test_wrong_value_is_reported_with_its_key_in_words(name: str) -> None:
    sample = Sample(SCHEMAS[name]).data
    usual = set(lines_of(sample, SCHEMAS[name]))
    for path in paths(sample):
        if not path:
            continue
        for value in WRONG:
            lines = lines_of(changed(sample, path, value), SCHEMAS[name])
            check_lines(lines)
            if value in NEVER and not isinstance(at(sample, path), (dict, list)):
                places = [line.split(": ")[1] for line in set(lines) - usual]
                assert any(place.startswith(dotted(path)) for place in places), (path, value, lines)


@pytest.mark.parametrize("name", SCHEMAS)
def test_unknown_key_is_reported_with_the_known_ones(name: str) -> None:
    sample = Sample(SCHEMAS[name]).data
    for path in paths(sample):
        if not isinstance(at(sample, path), dict):
            continue
        lines = lines_of(changed(sample, path, {**at(sample, path), "zz?": 1}), SCHEMAS[name])
        if lines == lines_of(sample, SCHEMAS[name]):
            continue  # a mapping with keys of the user's own choice
        place = dotted((*path, "zz?"))
        own = [line for line in lines if f"{place}: " in line or "not listed" in line]
        assert own, (place, lines)
        check_lines(lines)


@pytest.mark.parametrize("name", SCHEMAS)
def test_missing_key_is_reported(name: str) -> None:
    sample = Sample(SCHEMAS[name]).data
    for path in paths(sample):
        if not path or isinstance(path[-1], int):
            continue
        outer = {k: v for k, v in at(sample, path[:-1]).items() if k != path[-1]}
        check_lines(lines_of(changed(sample, path[:-1], outer), SCHEMAS[name]))
