"""Give arrays away for reading: who holds them caches them, and a change would change results."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

_T = TypeVar("_T", bound=np.generic)
_V = TypeVar("_V")


def read_only(values: NDArray[_T]) -> NDArray[_T]:
    """Return an array as a view that cannot be written; `.copy()` of it can."""
    view: NDArray[Any] = np.asarray(values).view()
    view.flags.writeable = False
    return view


def with_read_only_arrays(value: _V) -> _V:
    """Return an object of levid, or a container of such, whose arrays are all read-only views.

    The object itself keeps its arrays: computations of it go on with these.
    """
    shared: dict[int, Any] = {}
    found: _V = _copied(value, shared)
    return found


def _copied(value: Any, shared: dict[int, Any]) -> Any:
    if id(value) in shared:
        return shared[id(value)]
    if isinstance(value, np.ndarray):
        found: Any = read_only(value)
    elif isinstance(value, tuple):
        parts = [_copied(part, shared) for part in value]
        found = type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    elif isinstance(value, list):
        found = [_copied(part, shared) for part in value]
    elif isinstance(value, (dict, MappingProxyType)):
        plain: Mapping[Any, Any] = {key: _copied(part, shared) for key, part in value.items()}
        found = MappingProxyType(plain) if isinstance(value, MappingProxyType) else plain
    elif _holds_results(value):
        found = copy.copy(value)
        shared[id(value)] = found
        for name, part in vars(value).items():
            object.__setattr__(found, name, _copied(part, shared))  # most are frozen
    else:
        return value
    shared[id(value)] = found
    return found


def _holds_results(value: object) -> bool:
    ours = type(value).__module__.startswith("levid.") and hasattr(value, "__dict__")
    return ours and not isinstance(value, (BaseModel, Enum, type)) and not callable(value)
