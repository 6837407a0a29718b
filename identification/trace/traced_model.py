"""The model after a trace: a model file with effects, standard errors and their covariance."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...config.model import EffectParameter, ModelConfig, ModelEffect
from ...model.effects.base import Placed
from .parameter_covariance import parameter_covariance
from .run_trace import Trace

_MAX_ERROR_SHARE = 0.5
"""Largest standard error of an identified parameter, over its uncertainty before."""


def model_after(trace: Trace) -> ModelConfig:
    """Return the refitted model with its effects, values with standard errors."""
    point, config = trace.found.point, trace.config
    free, values = point.parameters, point.values
    sd = trace.found.errors[: len(values)] * free.scale
    known = np.minimum(free.worth, free.prior_sd)
    parameters = dict(config.parameters)
    for name, value, error, before in zip(free.names, values, sd, known, strict=True):
        identified = error < _MAX_ERROR_SHARE * before
        parameters[name] = parameters[name].model_copy(
            update={"value": float(value), "se": float(error) if identified else None}
        )
    return config.model_copy(
        update={"parameters": parameters, "effects": tuple(model_effect(p) for p in point.placed)}
    )


def covariance_after(trace: Trace) -> dict[str, Any]:
    """Return the covariance of the parameters of `model_after`: see parameter_covariance."""
    names = list(trace.found.point.parameters.names)
    return parameter_covariance(model_after(trace), names, trace.found.correlations)


def model_effect(placed: Placed) -> ModelEffect:
    """Return the entry of a model file for an effect."""
    return ModelEffect(
        effect=placed.effect.key, where=placed.effect.where, parameters=effect_parameters(placed)
    )


def effect_parameters(placed: Placed) -> dict[str, EffectParameter]:
    """Return an effect's values, standard errors and units by name, amplitudes first."""
    quantities = (*placed.effect.amplitudes, *placed.effect.shape)
    values = (*placed.amplitudes, *placed.shape)
    errors = placed.standard_errors
    return {
        q.name: EffectParameter(value=value, unit=q.unit, se=_finite(errors.get(q.name)))
        for q, value in zip(quantities, values, strict=True)
    }


def _finite(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None
