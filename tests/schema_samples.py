"""Sample data of every schema of levid's YAML files, made from the schema itself."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator
from typing import Any

from levid.config.backends import OWN, load_part
from levid.config.base import Strict
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
