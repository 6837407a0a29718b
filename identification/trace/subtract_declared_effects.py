"""Subtract a model's declared effects from a record, so that only its matrices are fitted.

Effects are evaluated along the measured motion, at the values in the model file. Their contribution
to readings is subtracted. Their contribution to commands and forces becomes part of the known
input, and in closed loop of reference and feed-forward, so that the loop is unchanged.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...config.model import ModelConfig
from ...log.reader import Log
from ...model.effects.base import Term
from ...model.effects.effect_serialization import placed_effects
from ..greybox.declared_model_from_config import declared_model
from ..greybox.experiment.experiment_from_log import Experiment, experiment_from_log
from ..greybox.fit import first_noise
from ..greybox.free_parameters import free_parameters
from ..greybox.prediction.discretisation import motion
from ..records.record import IdentificationError
from ..rounding import ROUNDING
from .linearised.linearisation_point import WorkingPoint, filtered
from .records.record_from_log import trace_record
from .records.sensor_and_amplifier_noise import Disturbance

Array = NDArray[np.float64]


def experiment_of(log: Log, config: ModelConfig) -> Experiment:
    """Return the experiment of a log without the model's effects; raises as trace_record does.

    A force (N, n) is converted to the equivalent command before the model's delay and lag, accurate
    to second order. Effects on the drive force are ignored: the fit does not use it.
    """
    if not config.effects:
        return experiment_from_log(log, config)
    record, model = trace_record(log, config), declared_model(config)
    placed = placed_effects(config.effects, record.places)
    noise = Disturbance(first_noise([record.experiment]), 1.0, measured=False)
    point = WorkingPoint(model, free_parameters(config), placed, noise, config.input)
    _, added = filtered(point, record, motion(model, record.experiment, config.input))
    return _subtracted(record.experiment, point, added, record.places.decoupling)


def _subtracted(e: Experiment, point: WorkingPoint, added: Term, decoupling: Array) -> Experiment:
    held = np.zeros_like(e.u) if added.held is None else added.held
    if added.force is not None:
        held = held + _as_command(e, point, added.force)
    gap = np.zeros_like(e.y) if added.gap is None else added.gap @ decoupling.T
    loop = e.loop and replace(e.loop, feedforward=e.loop.feedforward + held, seen=e.loop.seen + gap)
    return replace(e, y=e.y - gap, u=e.u + held, loop=loop)


def _as_command(e: Experiment, point: WorkingPoint, force: Array) -> Array:
    """Convert a generalised force (N, n) to the equivalent command (N, p)."""
    model = point.model
    B = model.at({name: float(v.mean()) for name, v in e.schedule.items()}).B
    inverse = np.linalg.pinv(B)
    if np.abs(B @ inverse - np.eye(len(B))).max() > ROUNDING:
        raise IdentificationError(
            f"record '{e.name}': expected inputs that act on every DOF (B of full rank), which the "
            "subtraction of effects needs, found a B of lower rank"
        )
    values = {**model.values, **model.scheduling}
    delay_s = e.delay_cycles * e.Ts_s + model.delay(values) + model.lag(values)
    if point.hold == "zoh":
        delay_s += 0.5 * e.Ts_s  # a held command is centred in its period
    rows = np.arange(len(force), dtype=float)
    shifted = [np.interp(rows + delay_s / e.Ts_s, rows, f) for f in force.T]
    return np.asarray(np.stack(shifted, axis=1) @ inverse.T)
