"""Read units and meanings of a log's fields from the comments of its schema."""

from __future__ import annotations

import re
from dataclasses import dataclass

_COMMENT = re.compile(r"\s*\[(?P<unit>[^\[\]]+)\]\s*(?P<meaning>.*)")


@dataclass(frozen=True)
class FieldMeaning:
    """Unit of a field, empty if the schema states none, and what it is, in words."""

    unit: str
    meaning: str


def field_meanings(schema: str) -> dict[str, FieldMeaning]:
    """Return unit and meaning by field of a ros2msg text: `type name  # [unit] meaning`.

    A field without such a comment is left out, as in logs of other programs.
    """
    found = {}
    for line in schema.splitlines():
        if line.startswith("==="):  # definitions of nested types follow
            break
        declared, _, comment = line.partition("#")
        words = declared.split()
        match = _COMMENT.fullmatch(comment.rstrip())
        if len(words) >= 2 and match is not None:
            found[words[1]] = FieldMeaning(match["unit"].strip(), match["meaning"].strip())
    return found
