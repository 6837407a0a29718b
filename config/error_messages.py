"""Convert validation errors of a YAML file to messages: where, what is expected, what is found."""

from __future__ import annotations

import difflib
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from .escaping import one_line

_Location = tuple[int | str, ...]
_EXPECTED = {
    "int_type": "an integer",
    "int_parsing": "an integer",
    "int_from_float": "an integer",
    "int_parsing_size": "an integer of fewer digits",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "string_type": "text",
    "tuple_type": "a list",
    "dict_type": "a mapping (key: value)",
    "model_type": "a mapping (key: value)",
    "model_attributes_type": "a mapping (key: value)",
    "invalid_key": "a key that is text",
    "greater_than": "a number greater than {gt:.12g}",
    "greater_than_equal": "a number of at least {ge:.12g}",
    "less_than": "a number less than {lt}",
    "less_than_equal": "a number of at most {le:.12g}",
    "string_too_short": "text that is not empty",
    "string_too_long": "text of at most {max_length} characters",
    "string_pattern_mismatch": "{form}",
    "literal_error": "{expected}",
}
"""Text for each kind of error, with the values that pydantic gives for it."""
_FORMS = {
    r"^[A-Za-z0-9][A-Za-z0-9._-]*$": "letters, digits, '.', '_' and '-', a letter or digit first",
    r"^[A-Za-z_][A-Za-z0-9_]*$": "letters, digits and '_', no digit first",
    r"^[a-z][a-z0-9]*(_[a-z0-9]+)*$": "lower-case words of letters and digits, joined by '_'",
    r"^[^\[\],#\s][^\[\],#\r\n\t]*$": "a unit without brackets, ',' and '#'",
    r"^coil:\d+$": "'coil:N' with the number N of the coil",
}
"""Text for each pattern in the schemas."""
MOST_MISTAKES = 20
"""Most mistakes that are listed for one file; the last line counts the rest."""
_WHOLE_FILE = "file"
"""Location of a mistake that belongs to no key."""
_MOST_QUOTED = 60
"""Longest quotation of a key or a value in characters."""
_MOST_LINE = 500
"""Longest description of a mistake in characters, without the name of the file."""


def mistakes(error: ValidationError, data: object, model: type[BaseModel], where: str) -> list[str]:
    """Return a line for each mistake in `data`: where, what is expected, and what is found.

    At most MOST_MISTAKES are listed; the last line counts the rest.
    """
    items = [item for item in error.errors(include_url=False) if not _follows(item)]
    # A file of another kind has a mistake in every key: report the wrong kind only.
    wrong_kind = [item for item in items if item["loc"] == ("levid",)]
    grouped = _by_location(wrong_kind or items, data)
    lines = []
    for loc, found in grouped[:MOST_MISTAKES]:
        place = dotted(loc[:-1] if loc[-1:] == ("[key]",) else loc)
        if found[0]["type"] == "value_error":
            problem = str(found[0]["ctx"]["error"])
            place, problem = _with_key(place, problem, _keys_at(model, loc))
        else:
            problem = _described(loc, found, model)
        line = shortened(f"{place}: {problem}", _MOST_LINE)
        lines.append(f"{where}: {line}")
    if more := len(grouped) - len(lines):
        lines.append(f"{where}: {more} more {'mistake' if more == 1 else 'mistakes'}, not listed")
    return lines


def _with_key(place: str, problem: str, keys: Sequence[str]) -> tuple[str, str]:
    """Move a key with which a problem begins to the place: rows, "of: expected" to rows.of."""
    head, colon, rest = problem.partition(": ")
    first = head.replace("[", ".").partition(".")[0]
    if not colon or " " in head or first not in keys:
        return place, problem
    return head if place == _WHOLE_FILE else f"{place}.{head}", rest


def _follows(item: ErrorDetails) -> bool:
    """Return whether a list is only too short because entries with mistakes do not count."""
    return item["type"] == "too_short" and len(item["input"]) >= item["ctx"]["min_length"]


def _described(loc: _Location, found: list[ErrorDetails], model: type[BaseModel]) -> str:
    """Return what is expected at a location and what is found."""
    item = found[0]
    match item["type"]:
        case "extra_forbidden":
            return f"unknown key{_suggest(str(loc[-1]), _keys_at(model, loc[:-1]))}"
        case "missing":
            return "required key is missing"
        case "too_long":
            most = item["ctx"]["max_length"]
            return f"expected at most {most} entries, found {len(item['input'])}"
        case "too_short":
            least = item["ctx"]["min_length"]
            entries = "entry" if least == 1 else "entries"
            return f"expected at least {least} {entries}, found {len(item['input'])}"
    key = "a key of " if loc[-1:] == ("[key]",) else ""
    expected = " or ".join(_expected(alternative) for alternative in found[:MOST_MISTAKES])
    return f"expected {key}{expected}, found {quoted(item['input'])}"


def _by_location(
    items: Sequence[ErrorDetails], data: object
) -> list[tuple[_Location, list[ErrorDetails]]]:
    """Return the errors at each location, in order; several are alternatives.

    If a key accepts several types, pydantic reports an error for each type; its location is the
    key followed by pydantic's name of the type. For a value that is a mapping, only the errors of
    the type that is a mapping are kept.
    """
    alternatives: dict[_Location, list[ErrorDetails]] = defaultdict(list)
    named: _Named = {}
    for item in items:
        loc = item["loc"]
        depth = _depth(loc, data, named)
        missing = item["type"] == "missing" and depth == len(loc) - 1
        alternatives[loc if missing else loc[:depth]].append(item)
    grouped: list[tuple[_Location, list[ErrorDetails]]] = []
    for loc, found in alternatives.items():
        at = len(loc)
        if len({item["loc"][at : at + 1] for item in found if len(item["loc"]) > at}) < 2:
            grouped += [(item["loc"], [item]) for item in found]
        elif inner := [item for item in found if len(item["loc"]) > at + 1]:
            for item in inner:
                item["loc"] = loc + item["loc"][at + 1 :]
            grouped += _by_location(inner, data)  # a key of the mapping may accept several types
        else:
            grouped.append((loc, found))
    return grouped


_Named = dict[int, dict[str, Any]]
"""By id of a mapping: its values by the text that a location has for a key that is not text."""


def _depth(loc: _Location, data: Any, named: _Named) -> int:
    """Return how many parts of a location exist in `data`; `named` caches non-text keys."""
    for depth, part in enumerate(loc):
        if isinstance(data, Mapping):
            if part in data:
                data = data[part]
                continue
            if id(data) not in named:
                named[id(data)] = {repr(key): data[key] for key in data if not isinstance(key, str)}
            if part not in named[id(data)]:
                return depth
            data = named[id(data)][str(part)]
        elif isinstance(data, (list, tuple)) and isinstance(part, int) and part < len(data):
            data = data[part]
        else:
            return depth
    return len(loc)


def _expected(item: ErrorDetails) -> str:
    values: dict[str, Any] = dict(item.get("ctx", {}))
    match item["type"]:
        case "string_pattern_mismatch":
            values = {"form": _FORMS.get(values["pattern"], "text of another form")}
        case "literal_error":
            values["expected"] = (
                values["expected"].replace("False", "false").replace("True", "true")
            )
    text = _EXPECTED.get(item["type"], "another value")
    return text.format(**values)


def dotted(loc: Sequence[Any]) -> str:
    """Return a location as text, such as steps[2].record.name; `file` for the top level."""
    text = ""
    for part in loc:
        if isinstance(part, int):
            text += f"[{quoted(part)}]"
        else:
            text += f"{'.' if text else ''}{shortened(str(part), _MOST_QUOTED)}"
    return text or _WHOLE_FILE


def shortened(text: str, most: int) -> str:
    """Return at most `most` characters of `text`, on one line and without control characters."""
    cut = one_line(text[: most + 1])
    return cut if len(cut) <= most else f"{cut[: most - 3]}..."


def quoted(value: object) -> str:
    """Return the start of `value` as text; the time does not depend on the size of `value`."""
    text = ""
    for piece in _pieces(value):
        text += piece
        if len(text) > _MOST_QUOTED:
            break
    return shortened(text, _MOST_QUOTED)


def _pieces(value: object) -> Iterator[str]:
    """Yield the text of a value in pieces of about the length of a quotation."""
    if isinstance(value, Mapping):
        for number, (key, inner) in enumerate(value.items()):
            yield ", " if number else "{"
            yield from _pieces(key)
            yield ": "
            yield from _pieces(inner)
        yield "}" if value else "{}"
    elif isinstance(value, (list, tuple)):
        for number, inner in enumerate(value):
            yield ", " if number else "["
            yield from _pieces(inner)
        yield "]" if value else "[]"
    elif isinstance(value, (str, bytes)):
        yield repr(value[: _MOST_QUOTED + 1])
    elif isinstance(value, int) and value.bit_length() > 8 * _MOST_QUOTED:
        # Python raises an error for the text of such a number.
        yield f"an integer of about {int(value.bit_length() * math.log10(2.0)) + 1} digits"
    elif value is None or isinstance(value, bool):
        yield "null" if value is None else str(value).lower()
    else:
        yield repr(value)


def _suggest(key: str, known: list[str]) -> str:
    if not known:
        return ""
    # The most likely mistake is the same quantity in another unit (r_mm for r_m).
    stem = key.rsplit("_", 1)[0]
    same_quantity = [k for k in known if k.rsplit("_", 1)[0] == stem]
    if same_quantity:
        return f"; expected '{same_quantity[0]}' (a key ends in its unit)"
    close = difflib.get_close_matches(key[:_MOST_QUOTED], known, n=1)
    if close:
        return f"; expected '{close[0]}'"
    if len(known) == 1:
        return f"; expected '{known[0]}'"
    return f"; expected one of {', '.join(sorted(known))}"


def _keys_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys that the schema has at `loc`; empty if `loc` is not in the schema."""
    current: Any = model
    for part in loc:
        if isinstance(part, int):
            continue
        field = getattr(current, "model_fields", {}).get(part)
        if field is not None:
            current = _model_in(field.annotation) or current
        elif hasattr(current, "extra_schema"):  # a section that is not a field
            current = current.extra_schema(part) or current
    return [f.alias or name for name, f in getattr(current, "model_fields", {}).items()]


def _model_in(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        found = _model_in(argument)
        if found is not None:
            return found
    return None
