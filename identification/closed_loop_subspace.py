"""Identify one closed-loop operating point by the subspace method, with the same model checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .closed_loop import LONGEST_SETTLING_S, SETTLED_S
from .options import Options
from .records.record import IdentificationError, Record
from .results import ClosedLoopPoint, SubspacePoint
from .subspace.held_out_simulation import hold_out, settled_row
from .subspace.model_checks import (
    STATES_A_DOF,
    order_doubts,
    plant_doubts,
    predicted_errors,
    settling_time,
)
from .subspace.pbsid import plant_by_subspace
from .subspace.plant_from_loop import closed_loop
from .subspace.response_uncertainty import modes, response_with_errors


def add_subspace_model(
    point: ClosedLoopPoint, records: Sequence[Record], options: Options
) -> ClosedLoopPoint:
    """Add the plant by the subspace method to the point, or a remark why it failed.

    `records` are all records of the point; the same rows are held out as for the other methods. The
    response is at the point's frequencies. `options.order`, if given, is the order of the loop: the
    plant's order is smaller by the controller's integrators.
    """
    try:
        return replace(point, subspace=_identify(point, records, options))
    except IdentificationError as error:
        remarks = (*point.remarks, f"no subspace model: {error}")
        return replace(point, subspace=None, remarks=remarks)


def _identify(point: ClosedLoopPoint, records: Sequence[Record], options: Options) -> SubspacePoint:
    training = [r.rows(0, len(r.y) - options.holdout_rows(len(r.y))) for r in records]
    integrators = int(np.sum(point.controller.ki > 0))
    found = plant_by_subspace(
        training,
        None if options.order is None else options.order - integrators,
        point.plant.lag_pole,
        least_order=STATES_A_DOF * len(point.controller.ki),
    )
    loop = closed_loop(found.plant.state_space(), point.controller)
    settled_s = settling_time(loop, SETTLED_S, LONGEST_SETTLING_S)
    held = tuple(
        hold_out(r, loop, options.holdout_rows(len(r.y)), settled_row(r, settled_s))
        for r in records
    )
    expected = predicted_errors(records, held, next(iter(point.markov.values())))
    return SubspacePoint(
        plant=found.plant,
        order=found.order,
        singular_values=found.singular_values,
        covariance=found.covariance,
        innovation_covariance=found.innovation_covariance,
        past=found.past,
        response=response_with_errors(found.plant, found.covariance, point.freq_hz),
        modes=modes(found.plant.core, found.covariance),
        holdout=held,
        doubts=(
            *(order_doubts(found.order) if options.order is None else ()),
            *plant_doubts(found.plant, loop, held, expected),
        ),
    )
