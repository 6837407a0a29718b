"""Write notes on fitted numbers: limits of their ranges, terms that vanish, textbook forms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..force_balance.force_record import ForceModel
from ..force_balance.free_numbers import at_limits
from ..search_options import SearchOptions

Array = NDArray[np.float64]


def notes_on_numbers(
    point: ForceModel, errors: Array, impossible: Sequence[str], options: SearchOptions
) -> tuple[str, ...]:
    """Return notes on the numbers of a fitted model.

    errors: standard errors of all numbers, the parameters first. impossible: what is physically
    impossible in a model without effects, as `impossible_matrices` says.
    """
    vanished = _vanished(point, errors, options)
    return (*_at_limits(point), *vanished, *_held(point), *_impossible(impossible))


def _vanished(point: ForceModel, errors: Array, options: SearchOptions) -> tuple[str, ...]:
    """Return a note on the parameters that are next to nothing of their declared values."""
    free, most = point.parameters, options.standard_errors
    gone = [
        f"{name} (declared {declared:.4g})"
        for name, value, error, declared in zip(
            free.names, point.values, errors, free.prior_mean, strict=False
        )
        if abs(value) + most * error < options.alike * abs(declared)
    ]
    if not gone:
        return ()
    if len(gone) == len(free.names) > 1:
        return ("all parameters are far below their declared values: check the units of columns",)
    verb, own = ("is", "it stands") if len(gone) == 1 else ("are", "they stand")
    taken = "; an effect that was found may take the place" if point.placed else ""
    return (
        f"{', '.join(gone)} {verb} next to nothing: check where {own} in M, D, K and B, and with "
        f"which signs{taken}",
    )


def _at_limits(point: ForceModel) -> tuple[str, ...]:
    """Return a note for each free parameter that the fit left at a limit of its range."""
    other = "a law that was found has taken its part, or " if point.placed else ""
    return tuple(
        f"{name} is at the {word} limit of its range in the model file, {limit:.4g}: widen the "
        f"range if it may be beyond; if not, {other}the model lacks something"
        for name, word, limit in at_limits(point)
    )


def _impossible(what: Sequence[str]) -> tuple[str, ...]:
    """Return a note on what of a model without found effects cannot be."""
    if not what:
        return ()
    return (
        f"{' and '.join(what)}, though declared positive: check the signs of the columns; if they "
        "are right, the model lacks something",
    )


def _held(point: ForceModel) -> tuple[str, ...]:
    """Return a note for each law that is held to its textbook form, or to the end of its range."""
    found = []
    for p in point.placed:
        if p.plain and p.effect.equal_numbers is not None:
            one = f"{' and '.join(p.effect.equal_numbers)} are one number"
            what = f"{one}, as in its textbook law; the records agree"
        elif p.plain and p.effect.whole:
            what = "its depth is 1, as in its textbook law; the records agree"
        elif p.plain:
            ends = ", ".join(q.name for q in p.effect.shape if q.ends)
            what = f"{ends} is held at the end of its range; the records see nothing beyond"
        else:
            continue
        found.append(f"{p.effect.name}: {what}")
    return tuple(found)
