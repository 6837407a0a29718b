"""The fitted model's frequency response at points of its schedule, with what it is held against."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...identification.greybox.identify_greybox import GreyBox
from ...identification.results import ClosedLoopPoint
from ..plotting.curves import CONFIDENCE, Curve, Range
from ..plotting.style import LineStyle, line_of, position_label

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_POINTS = 120
_BEAM = "beam_m"
_STILL = 1e-3
"""A variable that stays within this share of its range counts as still."""
_NUDGE = 1e-2
"""Half of a central difference, as a share of a standard error."""
_SURE_95 = 1.96
_SEEN = 0.02
"""Of a magnitude: a pixel of a panel of some four decades."""


@dataclass(frozen=True)
class Place:
    """A point of the schedule: its name, its variables, the beam's position if one of them is."""

    label: str
    schedule: Mapping[str, float]
    beam_m: float | None


def places_of(grey: GreyBox, points: Sequence[ClosedLoopPoint]) -> tuple[Place, ...]:
    """Return the beam positions of the points; without any, least, mean and most of the records.

    A model without scheduling variables, or one whose records keep them still, has one place.
    """
    sampled = {n: v for n, v in grey.declared.scheduling.items() if not v.derivative}
    name = next((n for n, v in sampled.items() if v.signal == _BEAM), next(iter(sampled), None))
    if name is None:
        return (Place(grey.declared.name, {}, None),)
    is_beam = sampled[name].signal == _BEAM
    beams = sorted(p.beam_m for p in points if p.beam_m is not None)
    values = beams if is_beam and beams else _spread(grey, name)
    if is_beam:
        return tuple(Place(position_label(x, values), {name: x}, x) for x in values)
    unit = sampled[name].unit
    return tuple(Place(f"{name} = {x:.4g} {unit}".strip(), {name: x}, None) for x in values)


def fitted_curve(grey: GreyBox, place: Place, line: LineStyle, shown: Range) -> Curve:
    """Return the response at a place, with what the parameters' errors make of its magnitude.

    The band is of first order in them; parameters that were held count as known. Paths
    where nothing of it would be seen have no band.
    """
    freq_hz = np.geomspace(shown.low_hz, shown.high_hz, _POINTS)
    H = grey.response(place.schedule, freq_hz)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.conj(H) / np.abs(H)
    errors = grey.fit.standard_errors
    slopes = [
        np.real(along * _slope(grey, place, freq_hz, name, error)) for name, error in errors.items()
    ]
    scaled = _correlation(grey.fit.covariance)
    J = np.array(slopes).reshape(len(slopes), *H.shape)
    variance = np.einsum("a...,ab,b...->...", J, scaled, J) if slopes else np.zeros(H.shape)
    # A figure's band is CONFIDENCE deviations wide, as is right for errors in two dimensions.
    deviation = _SURE_95 / CONFIDENCE * np.sqrt(np.maximum(variance, 0.0))
    seen = np.any(CONFIDENCE * deviation > _SEEN * np.abs(H), axis=0)
    return Curve(
        place.label, line, freq_hz, H, np.where(seen, deviation, np.nan) if seen.any() else None
    )


def fitted_curves(grey: GreyBox, places: Sequence[Place], shown: Range) -> tuple[Curve, ...]:
    """Return fitted_curve of every place, in the lines of its position."""
    return tuple(fitted_curve(grey, p, line_of(k), shown) for k, p in enumerate(places))


def _slope(grey: GreyBox, place: Place, freq_hz: Array, name: str, error: float) -> Complex:
    """Return how the response changes with a parameter, a unit being its standard error."""
    if not error > 0:
        return np.zeros((len(freq_hz), *_shape(grey)), complex)
    value, step = grey.fit.values[name], _NUDGE * error
    low, high = (
        _nudged(grey, name, x).response(place.schedule, freq_hz)
        for x in (value - step, value + step)
    )
    return np.asarray((high - low) / (2 * _NUDGE))


def _nudged(grey: GreyBox, name: str, value: float) -> GreyBox:
    return replace(grey, fit=replace(grey.fit, model=grey.fit.model.with_values({name: value})))


def _correlation(covariance: Array) -> Array:
    size = np.sqrt(np.diag(covariance))
    size = np.where(size > 0, size, 1.0)
    return np.asarray(covariance / size[:, None] / size)


def _spread(grey: GreyBox, name: str) -> list[float]:
    values = [e.experiment.schedule[name] for e in grey.fit.predictions]
    values = [v[np.isfinite(v)] for v in values if np.isfinite(v).any()]
    if not values:
        return [grey.declared.scheduling[name].value]
    low, high = min(float(v.min()) for v in values), max(float(v.max()) for v in values)
    mean = float(np.mean([v.mean() for v in values]))
    variable = grey.declared.scheduling[name]
    span = (variable.max or 0.0) - (variable.min or 0.0) or max(abs(mean), 1.0)
    return [low, mean, high] if high - low > _STILL * span else [mean]


def _shape(grey: GreyBox) -> tuple[int, int]:
    return len(grey.declared.dof), len(grey.declared.inputs)
