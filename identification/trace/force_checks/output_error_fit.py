"""Fit the model without effects to the outputs themselves: how close a linear model comes to them.

The force balance multiplies the outputs' noise by the plant's dynamics, and knows that noise from
its highest frequencies. A sensor whose noise is larger at low frequencies leaves more force than
that explains, which looks like an effect, and bends the numbers of the model. A free run does not
have its noise in the signals that it is computed from: fitted to the outputs, it is as close to
them as their noise lets it be (Ljung, *System Identification*, 1999, section 4.3).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ....model.declared_model import ModelError
from ...greybox.experiment.experiment_from_log import Experiment
from ...greybox.experiment.intersample_input import Hold
from ...greybox.free_run.free_run_simulation import free_run
from ...greybox.prediction.noise_model import Noise
from ...records.record import IdentificationError
from ...rounding import DIFFERENCE, TINY
from ...value_with_interval import PERCENT
from ..force_balance.force_record import ForceModel, ForceRecord
from ..force_balance.reported_errors import (
    DIVERGED,
    PooledError,
    noise_of_filter,
    reported_error,
    runs_free,
)
from ..records.record_from_log import TraceRecord
from ..search_options import SearchOptions

Array = NDArray[np.float64]


def output_error(
    declared: Mapping[str, float],
    point: ForceModel,
    train: Sequence[TraceRecord],
    records: Sequence[TraceRecord],
    seen: Sequence[ForceRecord],
) -> PooledError | None:
    """Return the errors of the model fitted to the outputs of training records, on the reported
    rows of the whole records; None if a free run tells nothing.

    declared: values of the parameters in the model file. point: the model fitted to the force,
    without new effects. seen: the whole records below the band's limit, whose reported rows count.
    """
    if point.placed or not point.parameters.names:
        return None
    hold = seen[0].band.hold
    missing = np.mean([r.varying(r.missing_force(point)).var(axis=0) for r in seen], axis=0)
    noise = noise_of_filter(np.asarray(missing), seen[0])
    as_declared = point.with_values(np.array([declared[name] for name in point.parameters.names]))
    experiments = [r.experiment for r in train]
    stable = [p for p in (point, as_declared) if all(runs_free(p, e) for e in experiments)]
    if not stable:
        return None
    best = _closest(stable[0], experiments, hold, noise)
    none = np.zeros(len(seen[0].noise_sd))
    errors = [
        reported_error(best, whole, part.rows, (below, none), None)
        for whole, part, below in zip(records, train, seen, strict=True)
    ]
    return PooledError.of(errors)


def as_close(
    fitted: PooledError | None, found: PooledError, effects: int, options: SearchOptions
) -> bool:
    """Return whether a model without effects, fitted to the outputs, comes as close to them as the
    model that was found.

    effects: how many that one has. If it has none, the outputs have to be met to 5 %
    (`law_accuracy`); if its free run diverges, to 1 % (`accuracy`).
    """
    if fitted is None or not np.all(np.isfinite(fitted.error)):
        return False
    if not effects:
        return bool(np.all(fitted.percent <= PERCENT * options.law_accuracy))
    if np.all(np.isfinite(found.error)):
        return bool(np.all(fitted.error <= found.error))
    return bool(np.all(fitted.percent <= PERCENT * options.accuracy))


def _closest(
    begin: ForceModel, experiments: Sequence[Experiment], hold: Hold, noise: Noise
) -> ForceModel:
    """Return the model whose free runs are closest to the outputs, each over its spread.

    begin: the model from whose values the fit starts. noise: from which the state at the begin of
    each run is estimated.
    """
    free = begin.parameters
    spread = np.maximum(np.mean([e.y.std(axis=0) for e in experiments], axis=0), TINY)

    def errors(x: Array) -> Array:
        point = begin.with_values(x * free.scale)
        return np.concatenate([_errors(point, e, hold, noise, spread) for e in experiments])

    fit = least_squares(
        errors,
        np.clip(begin.values, free.low, free.high) / free.scale,
        bounds=(free.low / free.scale, free.high / free.scale),
        diff_step=np.full(len(free.names), DIFFERENCE),
        max_nfev=SearchOptions.steps,
        ftol=SearchOptions.accuracy**2,
    )
    return begin.with_values(fit.x * free.scale)


def _errors(point: ForceModel, e: Experiment, hold: Hold, noise: Noise, spread: Array) -> Array:
    """Return the errors of a free run over the outputs' spread (n,), one row after the other
    (rows * n,)."""
    rows = len(e.y)
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            run = free_run(point.model, e, hold, noise)
        left = (e.y - run.y) / spread
        left[: run.counts_from] = 0.0
    except (IdentificationError, ModelError, np.linalg.LinAlgError):
        left = np.full((rows, len(spread)), DIVERGED)
    return np.clip(np.nan_to_num(left, nan=DIVERGED), -DIVERGED, DIVERGED).reshape(-1)
