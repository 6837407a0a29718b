"""Name singular equations as what they are: data or a model that determine too little."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from .record import IdentificationError


@contextmanager
def singular_equations(what: str) -> Iterator[None]:
    """Raise a failure of the linear algebra in the `with` body as an IdentificationError."""
    try:
        yield
    except np.linalg.LinAlgError as error:
        raise IdentificationError(
            f"{what}: its equations are singular ({error}). Check that inputs and outputs vary, "
            "the units, and the model's start values"
        ) from error
