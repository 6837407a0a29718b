"""Identify one closed-loop operating point by the subspace method, with the same model checks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .options import Options
from .records.record import Record
from .results import ClosedLoopPoint, SubspacePoint
from .subspace.held_out_simulation import hold_out, settled_row
from .subspace.model_checks import (
    LONGEST_SETTLING_S,
    SETTLED_S,
    STATES_A_DOF,
    plant_doubts,
    predicted_errors,
    settling_time,
)
from .subspace.plant_by_spectra import SpectralPlant, plant_by_spectra
from .subspace.plant_from_loop import closed_loop
from .subspace.response_uncertainty import modes, response_with_errors


def subspace_plant(records: Sequence[Record], options: Options) -> SpectralPlant:
    """Identify the plant of a point's records, without the rows that are held out.

    `options.order`, if given, is the order of the loop: the plant's order is smaller by the
    controller's integrators.

    Raises IdentificationError as plant_by_spectra does.
    """
    controller = records[0].controller
    assert controller is not None
    return plant_by_spectra(
        [r.rows(0, len(r.y) - options.holdout_rows(len(r.y))) for r in records],
        None if options.order is None else options.order - int(np.sum(controller.ki > 0)),
        options.lag_pole(records[0].Ts_s),
        least_order=STATES_A_DOF * len(controller.ki),
    )


def checked(
    found: SpectralPlant, point: ClosedLoopPoint, records: Sequence[Record], options: Options
) -> SubspacePoint:
    """Return the plant with its response at the point's frequencies, and held-out simulations.

    The same rows are held out as for the other methods.
    """
    loop = closed_loop(found.plant.state_space(), point.controller)
    settled_s = settling_time(loop, SETTLED_S, LONGEST_SETTLING_S)
    held = tuple(
        hold_out(r, loop, options.holdout_rows(len(r.y)), settled_row(r, settled_s))
        for r in records
    )
    expected = predicted_errors(records, held, next(iter(point.markov.values())))
    return SubspacePoint(
        found,
        response_with_errors(found.plant, found.covariance, point.freq_hz),
        modes(found.plant.core, found.covariance),
        held,
        plant_doubts(found.plant, loop, held, expected),
    )
