"""Weigh training records by what no free form of the signals explains of the missing force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...greybox.experiment.intersample_input import Hold
from ...rounding import TINY
from ..force_balance.force_record import ForceModel, ForceRecord, force_records
from ..force_balance.richest_free_form import residual_of_richest
from ..force_regression.candidate_fit import Beside
from ..force_regression.gauss_newton_fit import first_fit
from ..force_regression.held_out_gain import Blocks
from ..force_regression.residual_whitening import Whitening, whitening_of
from ..force_regression.training_records import Training, missing_share
from ..records.record_from_log import TraceRecord
from ..search_options import SearchOptions
from .rated_candidate import Rated
from .scale_of_equations import explained_by_any_form, with_scale, with_told_scales

Array = NDArray[np.float64]


def unweighed(
    start: ForceModel, fitted: tuple[ForceRecord, ...], limit_hz: float, options: SearchOptions
) -> tuple[Training, ForceModel, dict[str, str]]:
    """Return the training records without weights, the model fitted to them, and the DOF for whose
    scale each parameter is held."""
    acting = np.concatenate([r.groups(start) for r in fitted], axis=1)
    flat = np.maximum(np.var(acting, axis=1).max(axis=0), TINY) * np.ones((2, 1))
    plain = Whitening(np.array([0.0, limit_hz]), flat, limit_hz)
    blocks = Blocks.of([r.rows for r in fitted], options.blocks)
    training = Training.unscaled(fitted, plain, blocks)
    start, held_for = with_told_scales(start, training, options.told_from_model)
    training = with_scale(training, training.at(start), options.told_from_model)
    return training, first_fit(training, start), held_for


def weighed(
    training: Training, point: ForceModel, found: Sequence[Rated], options: SearchOptions
) -> tuple[Training, ForceModel]:
    """Return the records weighed by what the richest form leaves of a model, and its fit to them.

    If this fit misses more force, as much as an effect must take, the records and the point stay as
    they are: then the weights follow noise in the motion, or a loop's answer to a random force, or
    something large is missing. found: effects of the point that its file does not declare.
    """
    fitted, limit_hz = training.records, training.whitening.cutoff_hz
    left = residual_of_richest(point, fitted, Beside.of(point, training).plain.own)
    missing = [r.varying(r.missing_force(point)) for r in fitted]
    empty = explained_by_any_form(point, training, options.told_from_model)
    left = [np.where(empty, plain, form) for form, plain in zip(left, missing, strict=True)]
    white = whitening_of(left, [r.band.row_s for r in fitted], limit_hz)
    anew = replace(training, whitening=white)
    new = {r.placed.effect.identity for r in found}
    bare = replace(point, placed=tuple(p for p in point.placed if p.effect.identity not in new))
    anew = with_scale(anew, anew.at(bare), options.told_from_model)
    fit = first_fit(anew, point)
    before, after = (missing_share(training.plain.at(p)) for p in (point, fit))
    if np.any(after**2 > (1.0 + options.least_gain) * before**2):
        return training, point
    return anew, fit


def training_below(
    point: ForceModel,
    train: Sequence[TraceRecord],
    hold: Hold,
    limit_hz: float,
    law_hz: Sequence[float],
    sd: Array,
    options: SearchOptions,
) -> Training:
    """Return the training records below another limit, weighed by the found model's residual."""
    records = force_records(train, hold, limit_hz, law_hz, sd)
    centred = [r.varying(r.missing_force(point)) for r in records]
    white = whitening_of(centred, [r.band.row_s for r in records], limit_hz)
    blocks = Blocks.of([r.rows for r in records], options.blocks)
    training = Training.unscaled(records, white, blocks)
    return with_scale(training, training.at(replace(point, placed=())), options.told_from_model)


def between_turns(
    point: ForceModel, training: Training, options: SearchOptions
) -> tuple[Training, ...]:
    """Return the training records without the turns of DOF with friction.

    Empty if there is no friction, or too few rows are left.
    """
    rubbed = point.rubbed(training.records[0].signals.places)
    if not rubbed:
        return ()
    records = tuple(r.between_turns(rubbed) for r in training.records)
    moving, left = (
        np.sum([r.moves.sum(axis=0) for r in some], axis=0) for some in (training.records, records)
    )
    if np.any(left < options.reported * moving):
        return ()
    return (replace(training, records=records),)
