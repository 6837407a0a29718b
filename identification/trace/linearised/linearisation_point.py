"""Evaluate a record at a working point: motion, filter, signals and errors with effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from ....model.declared_model import DeclaredModel
from ....model.effects.base import Placed, Signals, Term
from ....model.effects.combined_effects import together, with_sensor_arms
from ...greybox.experiment.experiment_from_log import Experiment
from ...greybox.experiment.intersample_input import Hold
from ...greybox.free_parameters import FreeParameters
from ...greybox.prediction.discretisation import Motion, input_moments, motion
from ...greybox.prediction.noise_model import Filter, kalman_filter
from ...greybox.prediction.prediction_errors import predict_along, settled
from ...records.record import IdentificationError
from ..records.effect_signals import measured_signals
from ..records.record_from_log import TraceRecord
from ..records.sensor_and_amplifier_noise import Disturbance
from ..search_options import SearchOptions
from .innovations_filter_bank import thinned
from .intersample_moments import force_moments, nonzero_columns

Array = NDArray[np.float64]

_TO_HZ = SearchOptions.at_a_time * SearchOptions.resolved / SearchOptions.block_s
"""Errors are decimated to this rate; the platform's response is below half of it."""
MOST_TRUST = 1.0 / SearchOptions().negligible
_NOISE_REACH = float(SearchOptions.standard_errors * np.log(MOST_TRUST))
_MOST_FILTERS = 2 * SearchOptions.resolved
_SETTLED = SearchOptions.accuracy
"""Passes over a record end where the motion changes by this share of the noise, or by
more than half as much as before. Of a scale error of 8 %, each leaves 8 % of what was left."""


@dataclass(frozen=True)
class WorkingPoint:
    """A model with the effects found so far; `parameters` are its free ones."""

    model: DeclaredModel
    parameters: FreeParameters
    placed: tuple[Placed, ...]
    disturbance: Disturbance
    hold: Hold
    trust: float = MOST_TRUST
    """Factor on the force noise of the filter that computes the trajectory."""
    reference: DeclaredModel | None = None
    """The model of the filters along moving schedules; None: `model`."""

    @property
    def lag_s(self) -> float:
        """Lag of the model's inputs in s."""
        return max(self.model.lag({**self.model.values, **self.model.scheduling}), 0.0)

    @property
    def values(self) -> Array:
        """Values of the free parameters (F,) in SI units."""
        return np.array([self.model.values[name] for name in self.parameters.names])


@dataclass(frozen=True)
class Along:
    """A record with its motion, filter and signals at a working point."""

    record: TraceRecord
    at: Motion
    kalman: Filter
    signals: Signals
    added: Term
    errors: Array
    unknowns: Array
    every: int
    sd: float
    bases: dict[int, Array] = field(default_factory=dict, init=False, repr=False, compare=False)
    """Orthonormal bases (N', .) of the drives' forces that this motion needs, by decimation; each
    is computed when it is first asked for."""


def thinning(Ts_s: float) -> int:
    """Return the decimation factor of the errors."""
    return max(round(1 / (_TO_HZ * Ts_s)), 1)


def along(point: WorkingPoint, record: TraceRecord) -> Along:
    """Evaluate a record at the working point, with constant force and initial state fitted."""
    e = record.experiment
    at = motion(point.model, e, point.hold)
    kalman = filter_of(point, record, at)
    signals, added = filtered(point, record, at)
    corrected, driven = corrected_experiment(point, record, at, added)
    prediction = predict_along(driven, corrected, kalman)
    every = thinning(e.Ts_s)
    return Along(
        record, settled(at, prediction.offset), kalman, signals, added,
        thinned(prediction.errors, every), thinned(prediction.unknowns, every), every,
        point.disturbance.sensor_sd,
    )  # fmt: skip


def filter_of(point: WorkingPoint, record: TraceRecord, at: Motion, trust: float = 1.0) -> Filter:
    """Return the Kalman filter of a record, for `trust` times the force noise.

    Along a moving schedule, the filter of the reference model serves all similar models, because
    computing a filter takes longer than using it; with a correct model, its errors are noise too.
    """
    noise = point.disturbance.noise.scaled(force=trust)
    if at.fixed:
        return kalman_filter(at, noise)
    model = point.model if point.reference is None else point.reference
    values = np.array(list(model.values.values()))
    key = np.concatenate([values, noise.force_density, noise.output_covariance], None).tobytes()
    if key not in record.filters:
        if len(record.filters) >= _MOST_FILTERS:
            record.filters.clear()
        reference = motion(model, record.experiment, point.hold)
        record.filters[key] = kalman_filter(reference, noise)
    return record.filters[key]


def filtered(point: WorkingPoint, record: TraceRecord, at: Motion) -> tuple[Signals, Term]:
    """Return the trajectory of a record, and the sum of the effects found so far along it.

    The first filter lacks the effects and follows the readings closely; the next ones include the
    effects and follow the model as far as `trust` allows.
    """
    added = Term()
    closely = filter_of(point, record, at, MOST_TRUST)
    normal = filter_of(point, record, at, point.trust)
    signals = measured_signals(record, at, record.experiment.y, closely, point.lag_s)
    noise_sd, change = np.sqrt(point.disturbance.noise.output_variance), np.inf
    for _ in range(SearchOptions.steps if point.placed else 0):
        added, before = together(point.placed, signals), signals.q
        corrected, driven = corrected_experiment(point, record, at, added)
        signals = measured_signals(record, driven, corrected.y, normal, point.lag_s)
        last, change = change, np.sqrt(np.mean(((signals.q - before) / noise_sd) ** 2))
        if change < _SETTLED or not change < 0.5 * last:
            break
    if point.placed:
        added = together(point.placed, signals)
    return with_sensor_arms(point.placed, signals), added


def corrected_experiment(
    point: WorkingPoint, record: TraceRecord, at: Motion, added: Term
) -> tuple[Experiment, Motion]:
    """Return the experiment without sensor effects, and the motion with the effects' forces."""
    e = record.experiment
    if added.gap is not None:
        e = replace(e, y=e.y - added.gap @ record.places.decoupling.T)
    order, B, inputs = at.inputs.shape[1], [at.B], [at.inputs]
    if added.held is not None:
        acting = nonzero_columns(added.held)
        held = replace(e, u=added.held[:, acting])
        B.append(at.B[:, :, acting])
        inputs.append(input_moments(point.model, held, point.hold, order))
        e = replace(e, u=e.u + added.held)
    if added.force is not None:
        B.append(at.mobility)
        inputs.append(force_moments(added.force, e.Ts_s, order, point.hold))
    if len(B) > 1:
        at = replace(at, B=np.concatenate(B, axis=2), inputs=np.concatenate(inputs, axis=2))
    return e, at


def with_likely_noise(point: WorkingPoint, records: Sequence[TraceRecord]) -> WorkingPoint:
    """Estimate the force noise by maximum likelihood, for the given model.

    Without still records, the filter's force noise is the whole model error; it decreases as
    effects are found.
    """
    if point.disturbance.measured:
        return point
    noise = point.disturbance.noise
    parts = []
    for record in records:
        at = motion(point.model, record.experiment, point.hold)
        _, added = filtered(point, record, at)
        parts.append(corrected_experiment(point, record, at, added))

    def cost(log_level: float) -> float:
        tried = noise.scaled(force=float(np.exp(log_level)))
        try:
            return sum(predict_along(at, e, kalman_filter(at, tried)).cost for e, at in parts)
        except IdentificationError:
            return np.inf

    levels = np.linspace(-_NOISE_REACH, _NOISE_REACH, SearchOptions.steps)
    best = levels[np.argmin([cost(level) for level in levels])]
    step = levels[1] - levels[0]
    found = minimize_scalar(cost, bounds=(best - step, best + step), method="bounded")
    likely = noise.scaled(force=float(np.exp(found.x)))
    return replace(point, disturbance=replace(point.disturbance, noise=likely))
