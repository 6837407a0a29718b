"""Tell free forms that describe something of their own from those of a law's signal.

A curve over speed describes most of a friction. In the model beside it, the two would share out
what the law describes, and the numbers of neither would have a meaning. So such a curve is no
effect: it says that the law's equation is not exact.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ....model.effects.base import Effect, Placed
from ..force_balance.force_record import ForceModel
from ..force_regression.candidate_fit import flat
from ..force_regression.training_records import Training
from ..search_options import SearchOptions
from .rated_candidate import Rated, confirmed, is_free, rate


def described_laws(form: Placed, point: ForceModel, training: Training) -> list[Placed]:
    """Return the laws of a model of which a free form describes more than half of the force."""
    plain = training.plain
    at = plain.at(point)
    Q, _ = np.linalg.qr(flat(plain.forces(at, form.effect, form.shape)[0]))
    found = []
    for law in point.placed:
        if not is_free(law):
            columns = flat(plain.forces(at, law.effect, law.shape)[0])
            force = columns @ np.array(law.amplitudes)
            if np.sum((Q.T @ force) ** 2) > 0.5 * (force @ force):
                found.append(law)
    return found


def curves_beside_laws(
    point: ForceModel, free_forms: Sequence[Effect], training: Training, options: SearchOptions
) -> dict[str, Rated]:
    """Return for laws of a fitted model, by identity, the best confirmed free form of their signal.

    Laws that no free form surely improves on are not in it.
    """
    known = {p.effect.identity for p in point.placed}
    fresh = [e for e in free_forms if e.identity not in known]
    found = dict[str, Rated]()
    for rated in rate(point, fresh, training, options):
        if confirmed(rated, options):
            for law in described_laws(rated.placed, point, training):
                found.setdefault(law.effect.identity, rated)
    return found
