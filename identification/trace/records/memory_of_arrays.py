"""Measure the memory that the arrays of an object take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass

import numpy as np


def memory_of_arrays(*objects: object) -> int:
    """Return the memory in bytes of all arrays in dataclasses, mappings, lists and tuples.

    An array that several refer to, or of which they hold views, counts once and whole: that is what
    is freed when the last of them is dropped.
    """
    seen: set[int] = set()
    total, open_ = 0, list(objects)
    while open_:
        one = open_.pop()
        while isinstance(one, np.ndarray) and isinstance(one.base, np.ndarray):
            one = one.base
        if id(one) in seen:
            continue
        seen.add(id(one))
        if isinstance(one, np.ndarray):
            total += one.nbytes
        elif isinstance(one, Mapping):
            open_ += list(one.values())
        elif isinstance(one, list | tuple):
            open_ += one
        elif is_dataclass(one) and not isinstance(one, type):
            open_ += [getattr(one, field.name) for field in fields(one)]
    return total
