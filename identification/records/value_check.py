"""Check that records have values from which a model can be fitted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .record import IdentificationError

Array = NDArray[np.float64]


class HasSignals(Protocol):
    """A record with inputs u (N, p) and outputs y (N, n)."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def u(self) -> Array: ...  # noqa: D102
    @property
    def y(self) -> Array: ...  # noqa: D102


SMALLEST, LARGEST = 1e-60, 1e60
"""Range of the size of a signal in SI units; squares of squares of others exceed the computer's
numbers (1e-308 to 1e308)."""
_ROUNDING = 1e-12
"""Deviation of an output over its size up to which it is rounding of a constant."""


def check_sizes(name: str, inputs: Array, outputs: Array) -> None:
    """Raise IdentificationError for a signal of absurd size in the record `name`."""
    for kind, signals in (("input", inputs), ("output", outputs)):
        for i, size in enumerate(np.abs(signals).max(axis=0, initial=0.0).tolist()):
            if size and not SMALLEST < size < LARGEST:
                raise IdentificationError(
                    f"record '{name}': {kind} {i + 1}: expected values between {SMALLEST:g} and "
                    f"{LARGEST:g} in SI units, found {size:.3g}. Correct unit and scale in the "
                    "signals file, and mask values that stand for none"
                )


def check_values(experiments: Sequence[HasSignals]) -> None:
    """Raise IdentificationError, with record and signal, for values that allow no fit.

    These are signals of absurd size, and outputs that are constant in all records: a sensor that is
    not connected, or a plant at rest.
    """
    for e in experiments:
        check_sizes(e.name, e.u, e.y)
    spreads = [_spread(e.y) for e in experiments]
    still = np.flatnonzero(np.all([spread <= _ROUNDING for spread in spreads], axis=0))
    if len(still):
        names = ", ".join(f"'{e.name}'" for e in experiments[:3])
        raise IdentificationError(
            f"expected outputs that vary, found output {still[0] + 1} constant in {names}: there "
            "is no motion to fit. Check the sensor's connection and the column, or give the output "
            "the role other and remove it from the model"
        )


def _spread(y: Array) -> Array:
    """Return the deviation of each output over its size."""
    size = np.abs(y).max(axis=0, initial=0.0)
    return np.asarray((y / np.where(size > 0.0, size, 1.0)).std(axis=0))
