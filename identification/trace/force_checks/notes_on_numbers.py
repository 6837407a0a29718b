"""Say what is to be known of the fitted numbers beside their intervals: limits, textbook forms."""

from __future__ import annotations

from collections.abc import Sequence

from ..force_balance.force_record import ForceModel
from ..force_balance.free_numbers import at_limits


def notes_on_numbers(point: ForceModel, impossible: Sequence[str]) -> tuple[str, ...]:
    """Return notes on the numbers of a fitted model.

    impossible: what of it cannot be, without any effect, as `impossible_matrices` says.
    """
    return (*_at_limits(point), *_held(point), *_impossible(impossible))


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
