"""Writes the tables of docs/*.md from the code: `python docs/make_reference.py`.

Keys, types, bounds and defaults come from the schemas, states and faults from the daemon's tables;
reference.yaml has what a key means, and its unit. tests/docs/test_reference_tables.py fails when a
page is not what this would write.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

from levid.config.model import ModelConfig
from levid.config.rig import RigConfig, load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.config.sim import SimConfig
from levid.daemon.control.faults import FAULTS
from levid.daemon.control.states import TRANSITIONS, State
from levid.daemon.control.watchdog_times import fall_s, longest_stall, zero_after_s
from levid.log.importing.signals_yaml import SignalsFile
from levid.log.signals import SIGNALS

DOCS = Path(__file__).parent
WORDS = DOCS / "reference.yaml"
SCHEMAS: Mapping[str, type[BaseModel]] = {
    "rig": RigConfig,
    "session": SessionConfig,
    "sim": SimConfig,
    "model": ModelConfig,
    "signals": SignalsFile,
}
# <!-- table: NAME --> ... <!-- end -->: what lies between belongs to this script.
_MARKED = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)

# Patterns of the schemas in words.
_PATTERNS = {
    r"^[A-Za-z0-9][A-Za-z0-9._-]*$": "name",
    r"^[A-Za-z_][A-Za-z0-9_]*$": "identifier",
    r"^[a-z][a-z0-9]*(_[a-z0-9]+)*$": "lower_case name",
    r"^[^\[\],#\s][^\[\],#\r\n\t]*$": "unit",
    r"^coil:\d+$": "`coil:N`",
}
_BOUNDS = {
    "exclusiveMinimum": "> {}",
    "minimum": "≥ {}",
    "exclusiveMaximum": "< {}",
    "maximum": "≤ {}",
    "minItems": "{} or more",
    "maxItems": "at most {}",
}
_BASIC = {"number": "number", "integer": "integer", "string": "text", "boolean": "true or false"}


def main() -> None:
    """Write every table of every page anew."""
    for page in sorted(DOCS.glob("*.md")):
        page.write_text(with_tables(page.read_text(encoding="utf-8")), encoding="utf-8")


def with_tables(text: str) -> str:
    """Return a page with the tables between its marks as the code has them now."""
    return _MARKED.sub(lambda m: f"{m[1]}\n{TABLES[m[2]]()}\n\n{m[3]}", text)


def reference(kind: str) -> str:
    """Return a heading, a paragraph and a table for every mapping of a kind of file."""
    schema = SCHEMAS[kind].model_json_schema()
    words = yaml.safe_load(WORDS.read_text(encoding="utf-8"))[kind]
    parts = []
    for title, name, mapping in _mappings(schema):
        heading = f"### `{kind}`" if title is None else f"#### {title}"
        rows = [
            _row(key, field, key in mapping.get("required", []), words[name][key])
            for key, field in mapping["properties"].items()
        ]
        table = _table(("key", "type", "unit", "default", "meaning"), rows)
        parts += [heading, mapping["description"], table]
    return "\n\n".join(parts)


def mappings_of(kind: str) -> dict[str, set[str]]:
    """Return the keys of every mapping of a kind of file, by the name of its class."""
    schema = SCHEMAS[kind].model_json_schema()
    return {name: set(mapping["properties"]) for _, name, mapping in _mappings(schema)}


def states() -> str:
    """Return the table of the states of the loop."""
    rows = [(f"{state.value}", f"`{state.name}`", state.meaning) for state in State]
    return _table(("code", "state", "meaning"), rows)


def transitions() -> str:
    """Return the table of what may follow each state."""
    rows = [
        (f"`{state.name}`", ", ".join(f"`{to.name}`" for to in sorted(TRANSITIONS[state])))
        for state in State
    ]
    return _table(("from", "to"), rows)


def faults() -> str:
    """Return the table of faults: causes, what to check, and what makes them go away."""
    rows = [
        (
            f"{fault.value}",
            f"`{fault.name}`",
            FAULTS[fault].cause,
            FAULTS[fault].check or "—",
            FAULTS[fault].cleared or "—",
        )
        for fault in sorted(FAULTS)
    ]
    return _table(("code", "fault", "cause", "what to check", "cleared by"), rows)


def watchdogs() -> str:
    """Return the table of detection times of the shipped rigs."""
    rows = []
    for name in ("loopback", "serial", "canfd", "can"):
        rig = load_rig(shipped(f"rigs/{name}.yaml"))
        zero_s, stall_s = zero_after_s(rig), longest_stall(rig) / rig.rate_hz
        rows.append(
            (
                f"`{name}`",
                f"{1e3 / rig.rate_hz:g} ms",
                f"{1e3 * fall_s(rig):.1f} ms",
                "—" if zero_s is None else f"{1e3 * zero_s:g} ms",
                f"{1e3 * stall_s:g} ms",
                f"{rig.service.supervisor_s:g} s, {rig.service.supervisor_gone}",
            )
        )
    head = ("rig", "period", "fall to `gap_m`", "loop lost: zero after", "longest stall")
    return _table((*head, "supervisor silent"), rows)


def log_fields() -> str:
    """Return the table of the fields of a log's rows; C is the number of coils, S of sensors."""
    lengths = {"scalar": "", "coil": "[C]", "sensor": "[S]"}
    rows = [(f"`{s.name}`", f"{s.type}{lengths[s.shape]}", s.unit, s.description) for s in SIGNALS]
    return _table(("field", "type", "unit", "meaning"), rows)


TABLES: Mapping[str, Callable[[], str]] = {
    **{kind: (lambda kind=kind: reference(kind)) for kind in SCHEMAS},
    "states": states,
    "transitions": transitions,
    "faults": faults,
    "watchdogs": watchdogs,
    "log_fields": log_fields,
}


def _mappings(schema: dict[str, Any]) -> Iterator[tuple[str | None, str, dict[str, Any]]]:
    """Yield (where it stands, its class, its schema) of every mapping, the file itself first."""
    places: dict[str, list[str]] = {}
    order: list[str] = []

    def visit(mapping: dict[str, Any], path: str) -> None:
        for key, field in mapping["properties"].items():
            for name, suffix in _references(field):
                places.setdefault(name, []).append(f"`{path}{key}{suffix}`")
                if len(places[name]) == 1:
                    order.append(name)
                    visit(schema["$defs"][name], f"{path}{key}{suffix}.")

    visit(schema, "")
    yield None, schema["title"], schema
    for name in order:
        yield ", ".join(places[name]), name, schema["$defs"][name]


def _references(field: dict[str, Any], suffix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the classes that a key's value is made of, and what follows the key: [] or .NAME."""
    if "$ref" in field:
        yield field["$ref"].rpartition("/")[2], suffix
    for choice in field.get("anyOf", []):
        yield from _references(choice, suffix)
    if isinstance(field.get("items"), dict):
        yield from _references(field["items"], f"{suffix}[]")
    for values in _values_of(field):
        yield from _references(values, f"{suffix}.NAME")


def _row(key: str, field: dict[str, Any], required: bool, words: list[str]) -> tuple[str, ...]:
    unit, meaning = words
    default = "required" if required else _default(field.get("default"))
    return f"`{key}`", _type(field), unit or "—", default, meaning


def _type(field: dict[str, Any]) -> str:
    if "anyOf" in field:
        choices = [_type(choice) for choice in field["anyOf"] if choice.get("type") != "null"]
        return " or ".join(dict.fromkeys(choices))
    if "const" in field or "enum" in field:
        values = field.get("enum", [field.get("const")])
        # YAML's words for what is true or not are small.
        return " or ".join(f"`{str(v).lower() if isinstance(v, bool) else v}`" for v in values)
    if "$ref" in field or any(_values_of(field)):
        return "mapping" if "$ref" in field else "mappings by name"
    if "pattern" in field:
        return _PATTERNS.get(field["pattern"], field["pattern"].replace("|", r"\|"))
    if field.get("type") == "array":
        return _list(field)
    return f"{_BASIC[field['type']]}{_bounds(field)}"


def _list(field: dict[str, Any]) -> str:
    if "prefixItems" in field:
        return f"[{', '.join(_type(item) for item in field['prefixItems'])}]"
    inner = re.sub(r"\b(mapping|number|name|list)\b", r"\1s", _type(field["items"]))
    return f"list of {inner}{_bounds(field, ', ')}"


def _values_of(field: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the schema of the values of a mapping by name."""
    if isinstance(field.get("additionalProperties"), dict):
        yield field["additionalProperties"]
    yield from field.get("patternProperties", {}).values()


def _bounds(field: dict[str, Any], before: str = " ") -> str:
    # 2**63 is what fits into a random generator's seed: as good as no bound.
    said = [
        text.format(_plain(field[key]))
        for key, text in _BOUNDS.items()
        if key in field and field[key] != 2**63
    ]
    return f"{before}{' and '.join(said)}" if said else ""


def _plain(value: object) -> object:
    """Return a whole float as the integer that one would write."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _default(value: object) -> str:
    if value is None or value in ({}, [], ""):
        return "—"
    if isinstance(value, dict):
        return "as below"
    return f"`{str(value).lower() if isinstance(value, bool) else _plain(value)}`"


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    main()
