"""Every key of every schema, given wrongly, is reported by name, in words, with what was found."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator
from typing import Any

import pytest

from levid.config.backends import OWN, load_part
from levid.config.base import ConfigError, Strict, parse
from levid.config.load_any_kind import KINDS
from levid.log.importing.signals_yaml import SignalsFile

OPTIONS = {
    f"{name} {role}": load_part(part, name)
    for name, backend in OWN.items()
    for role, part in backend.options.items()
}
SCHEMAS: dict[str, type[Strict]] = {**KINDS, "signals": SignalsFile, **OPTIONS}
TEXTS = ("a1", "coil:0", "N", "left", "a")
"""Values that fit the patterns of names, inputs and units."""
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

Path = tuple[str | int, ...]


class Sample:
    """A value for every key that a JSON schema has, and the paths of all values."""

    def __init__(self, kind: type[Strict]) -> None:
        schema = kind.model_json_schema()
        self._definitions = schema.get("$defs", {})
        self.data = self._value(schema, ())

    def _value(self, schema: dict[str, Any], above: tuple[str, ...]) -> Any:  # noqa: PLR0911
        if "$ref" in schema:
            name = schema["$ref"].rpartition("/")[2]
            # A schema that contains itself ends here.
            return {} if above.count(name) else self._value(self._definitions[name], (*above, name))
        for key in ("anyOf", "oneOf", "allOf"):
            if key in schema:
                # A mapping shows the most keys.
                inner = [self._value(each, above) for each in schema[key]]
                return max(inner, key=lambda v: (isinstance(v, (dict, list)), v is not None))
        if "const" in schema or "enum" in schema:
            return schema.get("const", schema.get("enum", [None])[0])
        match schema.get("type"):
            case "object":
                return self._mapping(schema, above)
            case "array" if "prefixItems" in schema:
                return [self._value(each, above) for each in schema["prefixItems"]]
            case "array":
                inner = self._value(schema.get("items", {}), above)
                return [copy.deepcopy(inner) for _ in range(schema.get("minItems", 1))]
            case "string":
                pattern = schema.get("pattern", "")
                return next((text for text in TEXTS if re.match(pattern, text)), "a")
            case "integer" | "number":
                return schema.get("minimum", schema.get("exclusiveMinimum", 0) + 1)
            case "boolean":
                return True
        return None

    def _mapping(self, schema: dict[str, Any], above: tuple[str, ...]) -> dict[str, Any]:
        found = {k: self._value(v, above) for k, v in schema.get("properties", {}).items()}
        more = list(schema.get("patternProperties", {}).values())
        if isinstance(schema.get("additionalProperties"), dict) and not schema.get("properties"):
            more.append(schema["additionalProperties"])
        return found | ({"a": self._value(more[0], above)} if more else {})


def paths(value: object, at: Path = ()) -> Iterator[Path]:
    yield at
    inner = value.items() if isinstance(value, dict) else ()
    for key, each in enumerate(value) if isinstance(value, list) else inner:
        yield from paths(each, (*at, key))


def changed(data: Any, path: Path, value: object) -> Any:
    if not path:
        return value
    result = data.copy()
    result[path[0]] = changed(data[path[0]], path[1:], value)
    return result


def at(data: Any, path: Path) -> Any:
    for key in path:
        data = data[key]
    return data


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
