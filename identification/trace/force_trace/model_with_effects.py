"""Turn the result of a trace of imported records into a model file with its effects."""

from __future__ import annotations

import math

import numpy as np

from ....config.model import EffectParameter, ModelConfig, ModelEffect
from ....model.effects.base import Effect
from ..force_balance.free_numbers import by_value, numbers_of
from .trace_imported import ForceTrace

_MOST_ERROR_SHARE = 0.5
"""Largest standard error of an identified parameter, over its uncertainty before."""


def model_with_effects(trace: ForceTrace) -> ModelConfig:
    """Return the refitted model with its effects, values with standard errors."""
    point, config = trace.found.point, trace.config
    free, values = point.parameters, point.values
    known = np.minimum(free.worth, free.prior_sd)
    parameters = dict(config.parameters)
    sd = trace.errors[: len(values)]
    for name, value, error, before in zip(free.names, values, sd, known, strict=True):
        identified = error < _MOST_ERROR_SHARE * before
        parameters[name] = parameters[name].model_copy(
            update={"value": float(value), "se": float(error) if identified else None}
        )
    effects = tuple(
        ModelEffect(effect=p.effect.key, where=p.effect.where, parameters=values)
        for p, values in zip(point.placed, effect_parameters(trace), strict=True)
    )
    return config.model_copy(update={"parameters": parameters, "effects": effects})


def declared_effects(trace: ForceTrace) -> list[tuple[Effect, dict[str, EffectParameter]]]:
    """Return the effects that the model declared, with their fitted parameters."""
    new = {r.placed.effect.identity for r in trace.found.rated}
    pairs = zip(trace.found.point.placed, effect_parameters(trace), strict=True)
    return [(p.effect, values) for p, values in pairs if p.effect.identity not in new]


def effect_parameters(trace: ForceTrace) -> list[dict[str, EffectParameter]]:
    """Return the parameters of each effect of the found model, by name, amplitudes first.

    Held values, as the depth of a textbook law, have no standard error.
    """
    at, found = len(trace.found.point.values), []
    for p in trace.found.point.placed:
        errors = by_value(p, trace.errors[at : at + numbers_of(p)], np.inf)
        at += numbers_of(p)
        found.append(
            {
                q.name: EffectParameter(value=value, unit=q.unit, se=_finite(error))
                for q, value, error in zip(p.quantities, p.values, errors.tolist(), strict=True)
            }
        )
    return found


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
