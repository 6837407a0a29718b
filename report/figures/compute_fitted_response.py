"""Compute the fitted model's frequency response and its uncertainty at scheduling points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...identification.covariance_scaling import correlation
from ...identification.greybox.fit_in_loop import FittedLoop
from ...identification.greybox.fitted_modes import natural_frequencies
from ...identification.greybox.identify_greybox import GreyBox
from ...identification.results import ClosedLoopPoint
from ...identification.subspace.response_uncertainty import SURE_95
from ..plotting.labelled_frequency_responses import CONFIDENCE, Curve, Range
from ..plotting.style import LineStyle, line_of, position_label

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_POINTS = 120
_AROUND = 1.4
"""The denser points reach from the lowest resonance over this factor to the highest times it."""
_BEAM = "beam_m"
_STILL = 1e-3
"""Share of its range within which a scheduling variable counts as constant."""
_DIFFERENCE = 1e-2
"""Half of a central difference, over the standard error."""
_VISIBLE = 0.02
"""Smallest relative band that is drawn: a pixel in a panel of four decades."""


@dataclass(frozen=True)
class Place:
    """A scheduling point: label, variables, and the beam's position if that is one of them."""

    label: str
    schedule: Mapping[str, float]
    beam_m: float | None


def places_of(grey: GreyBox, points: Sequence[ClosedLoopPoint]) -> tuple[Place, ...]:
    """Return the points' beam positions; without any, the records' minimum, mean and maximum.

    There is one place if the model has no scheduling variables or they are constant.
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
    """Return the response at a place with its uncertainty from the parameters' covariance.

    The band is a first-order approximation; fixed parameters count as exact. Paths with an
    invisible band have none.
    """
    freq_hz = _frequencies(grey, shown)
    H = grey.response(place.schedule, freq_hz)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.conj(H) / np.abs(H)
    names, covariance = grey.fit.errors_of
    errors = np.sqrt(np.diag(covariance)).tolist()
    slopes = [
        np.real(along * _slope(grey, place, freq_hz, name, error))
        for name, error in zip(names, errors, strict=True)
    ]
    scaled = correlation(covariance)
    J = np.array(slopes).reshape(len(slopes), *H.shape)
    variance = np.einsum("a...,ab,b...->...", J, scaled, J) if slopes else np.zeros(H.shape)
    # Figures draw CONFIDENCE deviations, which is for complex errors; this error is real.
    deviation = SURE_95 / CONFIDENCE * np.sqrt(np.maximum(variance, 0.0))
    visible = np.any(CONFIDENCE * deviation > _VISIBLE * np.abs(H), axis=0)
    return Curve(
        place.label,
        line,
        freq_hz,
        H,
        np.where(visible, deviation, np.nan) if visible.any() else None,
    )


def _frequencies(grey: GreyBox, shown: Range) -> Array:
    """Return frequencies in Hz, two thirds of them around the resonances."""
    natural = natural_frequencies(grey.fit.model, {})
    natural = natural[(natural > shown.low_hz) & (natural < shown.high_hz)]
    if not len(natural):
        return np.geomspace(shown.low_hz, shown.high_hz, _POINTS)
    low_hz = max(natural.min() / _AROUND, shown.low_hz)
    high_hz = min(natural.max() * _AROUND, shown.high_hz)
    all_over = np.geomspace(shown.low_hz, shown.high_hz, _POINTS // 3)
    return np.union1d(all_over, np.geomspace(low_hz, high_hz, 2 * _POINTS // 3))


def fitted_curves(grey: GreyBox, places: Sequence[Place], shown: Range) -> tuple[Curve, ...]:
    """Return fitted_curve of every place, in the line style of its position."""
    return tuple(fitted_curve(grey, p, line_of(k), shown) for k, p in enumerate(places))


def whole_curves(loop: FittedLoop, places: Sequence[Place], shown: Range) -> tuple[Curve, ...]:
    """Return the response with the modes that the records show, dotted, for each place."""
    point = loop.fit.points[0]
    around = [m.freq_hz * np.geomspace(0.9, 1.1, 60) for m in loop.fit.modes]
    freq_hz = np.union1d(np.geomspace(shown.low_hz, shown.high_hz, _POINTS), np.concatenate(around))
    freq_hz = freq_hz[(freq_hz >= shown.low_hz) & (freq_hz <= shown.high_hz)]
    curves = []
    for k, place in enumerate(places):
        at = replace(point, schedule=dict(place.schedule), freq_hz=freq_hz, records=())
        line = replace(line_of(k), dashes=(1.0, 1.2), width=1.1, zorder=2.8)
        label = "with the modes beside it" if k == 0 else ""
        curves.append(Curve(label, line, freq_hz, loop.fit.plant.response(at)))
    return tuple(curves)


def _slope(grey: GreyBox, place: Place, freq_hz: Array, name: str, error: float) -> Complex:
    """Return the change of the response per standard error of a parameter."""
    if not error > 0:
        return np.zeros((len(freq_hz), *_shape(grey)), complex)
    value, step = grey.fit.values[name], _DIFFERENCE * error
    low, high = (
        _changed(grey, name, x).response(place.schedule, freq_hz)
        for x in (value - step, value + step)
    )
    return np.asarray((high - low) / (2 * _DIFFERENCE))


def _changed(grey: GreyBox, name: str, value: float) -> GreyBox:
    return replace(grey, fit=replace(grey.fit, model=grey.fit.model.with_values({name: value})))


def _spread(grey: GreyBox, name: str) -> list[float]:
    values = [e.schedule[name] for e in grey.fit.records]
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
