"""What does not fit a model, as lines for whoever wrote the file."""

from __future__ import annotations

import difflib
import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

_Location = tuple[int | str, ...]
_WORDS = {
    "String should match pattern ": "text like ",
    "String should have ": "text of ",
    "Keys should be strings": "a key that is text",
    "Unable to parse input string as an integer, exceeded maximum size": "fewer digits",
}
"""What the validator says in place of what it expected, and what that is."""
MOST_MISTAKES = 20
"""Most mistakes that are listed for one file; the last line is the number of further ones."""
_MOST_QUOTED = 60
"""Longest quotation of a key or a value in characters."""
_MOST_LINE = 500
"""Longest description of a mistake in characters, without the name of the file."""


def mistakes(error: ValidationError, data: object, model: type[BaseModel], where: str) -> list[str]:
    """Return a line for each mistake in `data`: where, what was expected, and what came.

    At most MOST_MISTAKES are listed, then how many more there are.
    """
    items = error.errors(include_url=False)
    # A file of another kind would be one error a key: that it is another kind says it all.
    of_kind = [item for item in items if item["loc"] == ("levid",)]
    grouped = _by_location(of_kind or items, data)
    lines = []
    for loc, found in grouped[:MOST_MISTAKES]:
        line = shortened(f"{dotted(loc)}: {_described(loc, found, model)}", _MOST_LINE)
        lines.append(f"{where}: {line}")
    if more := len(grouped) - len(lines):
        lines.append(f"{where}: {more} more {'mistake' if more == 1 else 'mistakes'}, not listed")
    return lines


def _described(loc: _Location, found: list[ErrorDetails], model: type[BaseModel]) -> str:
    """Return what was expected at a location and what came."""
    item = found[0]
    match item["type"]:
        case "extra_forbidden":
            return f"unknown key{_suggest(str(loc[-1]), _keys_at(model, loc[:-1]))}"
        case "missing":
            return "required key is missing"
        case "value_error":
            return str(item["ctx"]["error"])
        case "too_long":
            most = item["ctx"]["max_length"]
            return f"expected at most {most} entries, found {len(item['input'])}"
    expected = " or ".join(_expected(one) for one in found[:MOST_MISTAKES])
    return f"expected {expected}, found {quoted(item['input'])}"


def _by_location(
    items: Sequence[ErrorDetails], data: object
) -> list[tuple[_Location, list[ErrorDetails]]]:
    """Return what is wrong at each location, in order; more than one where any of them would do.

    Where a key takes this or that, the validator tells what each of them finds wrong, behind the
    key and its own name of that alternative. A mapping was meant to be the one that is a mapping.
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
            grouped += [(loc + item["loc"][at + 1 :], [item]) for item in inner]
        else:
            grouped.append((loc, found))
    return grouped


_Named = dict[int, dict[str, Any]]
"""Values of keys that are not text, by what a location has for such a key; by id of the mapping."""


def _depth(loc: _Location, data: Any, named: _Named) -> int:
    """Return how many parts of a location lead into `data`; fill in `named` where it is needed."""
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
    said = item["msg"].removeprefix("Input should be ")
    for theirs, ours in _WORDS.items():
        said = said.replace(theirs, ours)
    return re.sub(r", (unable to parse|got) .*", "", said)


def dotted(loc: Sequence[Any]) -> str:
    """Return a location as text, such as steps[2].record.name; `file` for the top level."""
    text = ""
    for part in loc:
        if isinstance(part, int):
            text += f"[{quoted(part)}]"
        else:
            text += f"{'.' if text else ''}{shortened(str(part), _MOST_QUOTED)}"
    return text or "file"


def shortened(text: str, most: int) -> str:
    """Return at most `most` characters of `text`, on one line and without control characters."""
    cut = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text[: most + 1])
    return cut if len(cut) <= most else f"{cut[: most - 3]}..."


def quoted(value: object) -> str:
    """Return the start of `value` as Python writes it, however large the value is."""
    text = ""
    for piece in _pieces(value):
        text += piece
        if len(text) > _MOST_QUOTED:
            break
    return shortened(text, _MOST_QUOTED)


def _pieces(value: object) -> Iterator[str]:
    """Yield the text of a value piece by piece; a piece is not much longer than a quotation."""
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
        # Python refuses to write such a number.
        yield f"an integer of about {int(value.bit_length() * math.log10(2.0)) + 1} digits"
    else:
        yield repr(value)


def _suggest(key: str, known: list[str]) -> str:
    if not known:
        return ""
    # The same quantity in another unit (r_mm for r_m) is the likeliest slip: compare without units.
    stem = key.rsplit("_", 1)[0]
    same_quantity = [k for k in known if k.rsplit("_", 1)[0] == stem]
    if same_quantity:
        return f"; expected '{same_quantity[0]}' (the ending of a key is its unit)"
    close = difflib.get_close_matches(key[:_MOST_QUOTED], known, n=1)
    if close:
        return f"; expected '{close[0]}'"
    return f"; expected one of {', '.join(sorted(known))}"


def _keys_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys known at `loc`, following model fields; empty where that cannot be told."""
    current: Any = model
    for part in loc:
        if isinstance(part, int):
            continue
        field = getattr(current, "model_fields", {}).get(part)
        if field is None:
            continue
        current = _model_in(field.annotation) or current
    return [f.alias or name for name, f in getattr(current, "model_fields", {}).items()]


def _model_in(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        found = _model_in(argument)
        if found is not None:
            return found
    return None
