"""Give arrays away for reading: a record caches them, and a change would change later results."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

_T = TypeVar("_T", bound=np.generic)


def read_only(values: NDArray[_T]) -> NDArray[_T]:
    """Return an array as a view that cannot be written; `.copy()` of it can."""
    view: NDArray[Any] = np.asarray(values).view()
    view.flags.writeable = False
    return view
