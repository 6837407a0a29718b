"""Check whether columns of the records are exchanged or have another sign than the model says.

Two sensors or actuators whose plugs are exchanged leave equations that miss most of their force.
Couplings of all kinds explain a part of it, one after the other, and none of them is there: one
model without any effect explains all of it, with the columns as they are connected.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ...value_with_interval import PERCENT, in_full
from ..records.record_from_log import TraceRecord
from ..search_options import SearchOptions

Array = NDArray[np.float64]

_MOST_NAMED = 2
"""Most explanations that are named if several are as good."""
_FEWEST_RECORDS = 3
"""Records from which most of them tell what the sign is."""


@dataclass(frozen=True)
class Exchange:
    """Columns that the records may have in another order, with another sign or in another unit.

    words: "x and y are exchanged". before, after (n,): missing force over the acting one that the
    model without found effects leaves of the columns as they are, and then.
    """

    words: str
    before: Array
    after: Array

    @property
    def sentence(self) -> str:
        """The finding and what it rests on, as a clause."""
        before, after = (in_full(PERCENT * float(x.max())) for x in (self.before, self.after))
        return (
            f"it looks as if {self.words}: without any effect, the model then misses {after} % of "
            f"the force, and {before} % with the columns as they are"
        )


def explaining_exchange(
    records: Sequence[TraceRecord],
    sd: Array,
    missing: Callable[[Sequence[TraceRecord], Array], Array],
    declared: Array,
    found: Array,
    options: SearchOptions,
) -> Exchange | None:
    """Return what columns have to be for a model without effects to explain as much as with those
    found; None if there is nothing of the kind, or not much is missing.

    sd (n,): noise of the outputs. missing: returns the missing force (n,), over the acting one, of
    the declared model fitted to records with noise (n,). declared, found (n,): the same of the
    records as they are, without and with the effects found.
    """
    misses = float(declared.max()) ** 2
    if misses <= options.least_gain:  # exchanged columns leave most of a force unexplained
        return None
    every = [
        Exchange(words, declared, missing(changed, sd[order]))
        for words, changed, order in _exchanged(records)
    ]
    least = min(float(e.after.max()) for e in every)
    alike = [e for e in every if float(e.after.max()) < least + options.least_force]
    if not alike or not explains(alike[0].after, declared, found, options):
        return None
    # A record has the signs of an input and an output in one product: both are named.
    return replace(alike[0], words=", or ".join(e.words for e in alike[:_MOST_NAMED]))


def explains(left: Array, declared: Array, found: Array, options: SearchOptions) -> bool:
    """Return whether a model explains nearly all that the declared one misses, and as much as one
    with effects: left, declared, found (n,) are the missing forces over the acting one.

    A model may miss far more than the acting force; a model of zeros would miss all of it.
    """
    most, misses = float(left.max()), min(float(declared.max()), 1.0) ** 2
    return most**2 < options.least_gain * misses and most - float(found.max()) < options.least_force


def _exchanged(
    records: Sequence[TraceRecord],
) -> Iterator[tuple[str, list[TraceRecord], NDArray[np.intp]]]:
    """Yield in words each exchange of two columns of one unit and each other sign, the records with
    it, and which output is in the place of each."""
    places, n = records[0].places, len(records[0].places.dof)
    for order, sign, words in _orders(places.dof, places.dof_units):
        yield words, [_with_outputs(r, order, sign) for r in records], order
    units = [places.command_unit(c) for c in range(places.coils)]
    for order, sign, words in _orders(places.actuators, units):
        yield words, [_with_inputs(r, order, sign) for r in records], np.arange(n)
    if len(records) >= _FEWEST_RECORDS:  # else most of them do not tell what is right
        for k, one in enumerate(records):
            for order, sign, words in _signs(places.dof):
                changed = [*records[:k], _with_outputs(one, order, sign), *records[k + 1 :]]
                yield f"{words} in record '{one.name}'", changed, order


def _orders(
    names: Sequence[str], units: Sequence[str]
) -> Iterator[tuple[NDArray[np.intp], Array, str]]:
    """Yield the order of columns, their signs, and what that means."""
    own, plus = np.arange(len(names)), np.ones(len(names))
    for i, j in combinations(range(len(names)), 2):
        if units[i] == units[j]:
            order = own.copy()
            order[[i, j]] = j, i
            yield order, plus, f"{names[i]} and {names[j]} are exchanged"
    yield from _signs(names)


def _signs(names: Sequence[str]) -> Iterator[tuple[NDArray[np.intp], Array, str]]:
    own = np.arange(len(names))
    for i, name in enumerate(names):
        yield own, np.where(own == i, -1.0, 1.0), f"{name} has the other sign"


def _with_outputs(record: TraceRecord, order: NDArray[np.intp], sign: Array) -> TraceRecord:
    e = record.experiment
    sd, step = (None if x is None else x[order] for x in (e.noise_sd, e.resolution))
    changed = replace(e, y=e.y[:, order] * sign, noise_sd=sd, resolution=step)
    return replace(record, experiment=changed)


def _with_inputs(record: TraceRecord, order: NDArray[np.intp], sign: Array) -> TraceRecord:
    u = record.experiment.u[:, order] * sign
    return replace(record, experiment=replace(record.experiment, u=u), coil=u)
