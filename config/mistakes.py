"""What does not fit a model, as lines for whoever wrote the file."""

from __future__ import annotations

import difflib
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

_Location = tuple[int | str, ...]
_WORDS = {
    "String should match pattern ": "text like ",
    "Keys should be strings": "a key that is text",
}
"""What the validator says in place of what it expected, and what that is."""


def mistakes(error: ValidationError, data: object, model: type[BaseModel], where: str) -> list[str]:
    """Return a line for each mistake in `data`: where, what was expected, and what came."""
    items = error.errors(include_url=False)
    # A file of another kind would be one error a key: that it is another kind says it all.
    of_kind = [item for item in items if item["loc"] == ("levid",)]
    lines = []
    for loc, found in _told_once(of_kind or items, data):
        item = found[0]
        key = _dotted(loc)
        if item["type"] == "extra_forbidden":
            known = _keys_at(model, loc[:-1])
            lines.append(f"{where}: {key}: unknown key{_suggest(str(loc[-1]), known)}")
        elif item["type"] == "missing":
            lines.append(f"{where}: {key}: required key is missing")
        elif item["type"] == "value_error":
            lines.append(f"{where}: {key}: {item['ctx']['error']}")
        else:
            expected = " or ".join(_expected(one) for one in found)
            lines.append(f"{where}: {key}: expected {expected}, found {_short(item['input'])}")
    return lines


def _told_once(
    items: Sequence[ErrorDetails], data: object
) -> list[tuple[_Location, list[ErrorDetails]]]:
    """Return what is wrong at each location, in order; more than one where any of them would do.

    Where a key takes this or that, the validator tells what each of them finds wrong, behind the
    key and its own name of that alternative. A mapping was meant to be the one that is a mapping.
    """
    alternatives: dict[_Location, list[ErrorDetails]] = defaultdict(list)
    for item in items:
        loc = item["loc"]
        depth = _depth(loc, data)
        missing = item["type"] == "missing" and depth == len(loc) - 1
        alternatives[loc if missing else loc[:depth]].append(item)
    told: list[tuple[_Location, list[ErrorDetails]]] = []
    for loc, found in alternatives.items():
        at = len(loc)
        if len({item["loc"][at : at + 1] for item in found if len(item["loc"]) > at}) < 2:
            told += [(item["loc"], [item]) for item in found]
        elif inner := [item for item in found if len(item["loc"]) > at + 1]:
            told += [(loc + item["loc"][at + 1 :], [item]) for item in inner]
        else:
            told.append((loc, found))
    return told


def _depth(loc: _Location, data: Any) -> int:
    """Return how many parts of a location lead into `data`."""
    for depth, part in enumerate(loc):
        inner = _inner(data)
        if part not in inner:
            return depth
        data = inner[part]
    return len(loc)


def _inner(data: object) -> Mapping[int | str, Any]:
    """Return what is in a value, by the parts that a location has for its keys."""
    if isinstance(data, Mapping):
        return {key if isinstance(key, (int, str)) else repr(key): data[key] for key in data}
    return dict(enumerate(data)) if isinstance(data, (list, tuple)) else {}


def _expected(item: ErrorDetails) -> str:
    said = item["msg"].removeprefix("Input should be ")
    for theirs, ours in _WORDS.items():
        said = said.replace(theirs, ours)
    return re.sub(r", (unable to parse|got) .*", "", said)


def _dotted(loc: tuple[int | str, ...]) -> str:
    text = ""
    for part in loc:
        text += f"[{part}]" if isinstance(part, int) else f"{'.' if text else ''}{part}"
    return text or "file"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _suggest(key: str, known: list[str]) -> str:
    if not known:
        return ""
    # The same quantity in another unit (r_mm for r_m) is the likeliest slip: compare without units.
    stem = key.rsplit("_", 1)[0]
    same_quantity = [k for k in known if k.rsplit("_", 1)[0] == stem]
    if same_quantity:
        return f"; expected '{same_quantity[0]}' (the ending of a key is its unit)"
    close = difflib.get_close_matches(key, known, n=1)
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
