"""All arrays that an object of levid holds, for tests of what is read-only."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import BaseModel


def arrays_of(
    value: object, name: str, seen: dict[int, object] | None = None, depth: int = 0
) -> Iterator[tuple[str, Any]]:
    """Yield all arrays in public attributes of objects of levid, and in what these hold.

    `seen` keeps what was looked at: the number of a deleted object may be that of another one.
    """
    seen = {} if seen is None else seen
    if id(value) in seen or depth > 12:
        return
    seen[id(value)] = value
    if isinstance(value, np.ndarray):
        yield name, value
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from arrays_of(inner, f"{name}[{key!r}]", seen, depth + 1)
    elif isinstance(value, Sequence) and not isinstance(value, (str, bytes)):
        for number, inner in enumerate(value):
            yield from arrays_of(inner, f"{name}[{number}]", seen, depth + 1)
    if type(value).__module__.startswith("levid.") and not isinstance(value, BaseModel):
        # What is computed at each access is nobody's cache: only what the numerics hold counts.
        ours = type(value).__module__.startswith("levid.api.")
        held = dir(value) if ours else vars(value) if hasattr(value, "__dict__") else ()
        for attribute in (a for a in held if not a.startswith("_")):
            inner = getattr(value, attribute, None)
            if not callable(inner):
                yield from arrays_of(inner, f"{name}.{attribute}", seen, depth + 1)
