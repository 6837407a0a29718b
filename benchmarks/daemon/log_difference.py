"""Find the first difference between logs, as the `mcap` package reads them, not levid's reader."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from functools import cache
from itertools import zip_longest
from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import McapReader, make_reader
from mcap.records import Message, Schema

CDR_HEADER = 4
"""Bytes of a message before its fields."""


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison: `rows` that are equal, and the first difference, empty if none."""

    rows: int
    difference: str = ""


def compare_folders(before: Path, after: Path, ignored: Container[str] = ()) -> Comparison:
    """Compare the logs of two folders, file by file, up to the first difference.

    Fields of the rows whose names are in `ignored` are not compared; either version may lack them.
    """
    names = [sorted(path.name for path in folder.glob("*.mcap")) for folder in (before, after)]
    rows = 0
    for one, other in zip_longest(*names):
        if one != other:
            return Comparison(rows, f"log: {one or 'none'} before, {other or 'none'} after")
        found = compare_logs(before / one, after / other, ignored)
        rows += found.rows
        if found.difference:
            return Comparison(rows, f"{one}: {found.difference}")
    return Comparison(rows)


def compare_logs(before: Path, after: Path, ignored: Container[str] = ()) -> Comparison:
    """Compare two logs: what stands at their head, then each message's bytes, times and number.

    Both are read chunk by chunk, so memory does not grow with the file.
    """
    rows = 0
    with before.open("rb") as one, after.open("rb") as other:
        try:
            readers = [make_reader(file, validate_crcs=True) for file in (one, other)]
            heads = [head(reader, ignored) for reader in readers]
            for what in heads[0] | heads[1]:
                values = [found.get(what, "nothing") for found in heads]
                if values[0] != values[1]:
                    return Comparison(0, f"{what}: {values[0]} before, {values[1]} after")
            messages = (reader.iter_messages(log_time_order=False) for reader in readers)
            for old, new in zip_longest(*messages):
                if old is None or new is None:
                    what = f"{'ends' if old is None else 'goes on'} before"
                    return Comparison(rows, f"row {rows}: the log {what}, not after")
                (schema, _, first), (new_schema, _, second) = old, new
                if ignored or first != second:
                    assert schema is not None  # head() has read the schema of each channel
                    assert new_schema is not None
                    difference = _difference(schema, first, new_schema, second, ignored)
                    if difference:
                        return Comparison(rows, f"row {rows}: {difference}")
                rows += 1
        except McapError as error:
            return Comparison(rows, f"row {rows}: cannot be read: {type(error).__name__} {error}")
    return Comparison(rows)


def head(reader: McapReader, ignored: Container[str] = ()) -> dict[str, str]:
    """Return what a log says about its rows, by where it says so, in the order of the file.

    That is channels, their fields, names of attachments, and metadata. Comments of the schema and
    contents of attachments are left out; so is the record `levid-head`, a checksum of all this.
    """
    summary = reader.get_summary()
    if summary is None:
        return {"summary": "missing, as in a log that was cut off"}
    found: dict[str, str] = {}
    for number, channel in summary.channels.items():
        schema = summary.schemas[channel.schema_id]
        found[f"channel {number}"] = f"{channel.topic} {channel.message_encoding}"
        found[f"schema of channel {number}"] = f"{schema.name} {schema.encoding}"
        kept = [(kind, name) for kind, name in fields(schema.data) if name not in ignored]
        for i, (kind, name) in enumerate(kept):
            found[f"field {i} of channel {number}"] = f"{kind} {name}"
    for i, index in enumerate(summary.attachment_indexes):
        found[f"attachment {i}"] = index.name
    for record in reader.iter_metadata():
        if record.name != "levid-head":
            found |= {f"metadata {record.name}, {key}": v for key, v in record.metadata.items()}
    return found


def fields(definition: bytes) -> list[tuple[str, str]]:
    """Return (type, name) of each field of a ros2msg definition."""
    lines = (line.partition("#")[0].split() for line in definition.decode().splitlines())
    return [(words[0], words[1]) for words in lines if words]


@cache
def row_type(definition: bytes) -> np.dtype[np.void]:
    """Return the layout of a message: its fields packed, little-endian."""
    found = []
    for kind, name in fields(definition):
        base, _, length = kind.removesuffix("]").partition("[")
        shape = (int(length),) if length else ()
        found.append((name, np.dtype(base).newbyteorder("<"), shape))
    return np.dtype(found)


def _difference(
    schema: Schema, before: Message, new_schema: Schema, after: Message, ignored: Container[str]
) -> str:
    """Return the first of times, number and fields that differs, with both values; else empty."""
    for what in ("log_time", "publish_time", "sequence", "channel_id"):
        old, new = getattr(before, what), getattr(after, what)
        if old != new:
            return f"{what}: {old} before, {new} after"
    rows = []
    for layout, message in ((row_type(schema.data), before), (row_type(new_schema.data), after)):
        if len(message.data) != CDR_HEADER + layout.itemsize:
            return f"{len(before.data)} bytes before, {len(after.data)} bytes after"
        rows.append(np.frombuffer(message.data, layout, 1, CDR_HEADER)[0])
    for name in rows[0].dtype.names or ():
        if name in ignored:
            continue
        old, new = (np.atleast_1d(row[name]) for row in rows)
        for i in range(old.size):
            if old[i].tobytes() != new[i].tobytes():  # bytes: NaN equals itself, 0.0 is not -0.0
                where = f"{name}[{i}]" if old.size > 1 else name
                return f"{where}: {old[i]!s} before, {new[i]!s} after"
    heads = [message.data[:CDR_HEADER].hex() for message in (before, after)]
    return "" if heads[0] == heads[1] else f"header {heads[0]} before, {heads[1]} after"
