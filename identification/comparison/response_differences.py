"""Compare the frequency responses of two fitted models, with the uncertainty of both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...model.declared_model import DeclaredModel
from ...model.second_order import lagged
from ..greybox.declared_model_from_config import declared_model
from .saved_result import SavedResult

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_FREQUENCIES = 200
_REACH = 10.0
"""Range of frequencies: from the lowest resonance over this to the highest times this."""
_NO_RESONANCE_HZ = (0.1, 100.0)
_STEP = 0.1
"""Half step of the derivatives, in standard errors."""
_DETERMINED = 0.3
"""Largest standard error of a response over its magnitude at which dB and degrees say anything."""
_MATRICES = ("dof", "inputs", "scheduling", "M", "D", "K", "B", "lag_s", "delay_s")
_TO_DB = 20.0 / np.log(10.0)


@dataclass(frozen=True)
class ModelResponse:
    """Response H (F, m, p) from inputs to outputs, and how its logarithm follows the parameters.

    slope (F, m, p, K): derivative of ln H by the fitted parameters, covariance (K, K).
    """

    H: Complex
    slope: Complex
    covariance: Array

    @property
    def deviation(self) -> Array:
        """Standard deviation of the complex entries of H, (F, m, p)."""
        return np.abs(self.H) * np.hypot(self.error_re, self.error_im)

    @property
    def error_re(self) -> Array:
        """Standard error of ln |H|, (F, m, p)."""
        return _error(self.slope.real, self.covariance)

    @property
    def error_im(self) -> Array:
        """Standard error of the phase in rad, (F, m, p)."""
        return _error(self.slope.imag, self.covariance)


@dataclass(frozen=True)
class PathDeviation:
    """Largest deviations of one path, b against a, and their frequencies in Hz.

    decibel, degree: largest magnitude and phase deviation, with sign. in_errors: largest deviation
    of either in combined standard errors. p_value: probability of that by chance at any frequency
    of any path (Scheffe). determined: False if the response is more uncertain than 30 %, so that
    dB and degrees say nothing; they are then those of no frequency (nan).
    """

    output: str
    input: str
    decibel: float
    decibel_at_hz: float
    degree: float
    degree_at_hz: float
    in_errors: float
    in_errors_at_hz: float
    p_value: float
    determined: bool


@dataclass(frozen=True)
class ResponseComparison:
    """Responses of two models at the same scheduling variables, and their deviations.

    schedule: by name. freq_hz (F,). paths: by output, then input.
    """

    schedule: dict[str, float]
    freq_hz: Array
    a: ModelResponse
    b: ModelResponse
    paths: tuple[PathDeviation, ...]


def compare_responses(
    a: SavedResult, b: SavedResult, schedule: Mapping[str, float]
) -> ResponseComparison | str:
    """Return the comparison at scheduling variables, those not given as declared; or why not.

    Responses are continuous, from command to output with lag and delay; effects of the model are
    not in them.
    """
    one, other = (declared_model(r.model) for r in (a, b))
    if (one.dof, one.inputs) != (other.dof, other.inputs):
        return "the models have different inputs or outputs: their responses are not compared"
    variables = set(one.scheduling) & set(other.scheduling)
    at = {name: one.scheduling[name] for name in one.scheduling if name in variables}
    at |= {name: value for name, value in schedule.items() if name in variables}
    freq_hz = _frequencies((one, other), at)
    found = [_response(r, m, at, freq_hz) for r, m in ((a, one), (b, other))]
    return ResponseComparison(
        at,
        freq_hz,
        found[0],
        found[1],
        _deviations(one, freq_hz, found[0], found[1], _dimensions(a, b)),
    )


def _dimensions(a: SavedResult, b: SavedResult) -> int:
    """Return the number of parameter differences that the responses' deviation depends on."""
    alike = all(getattr(a.model, key) == getattr(b.model, key) for key in _MATRICES)
    if alike:
        return max(len(set(a.free) | set(b.free)), 1)
    return max(len(a.free) + len(b.free), 1)


def _frequencies(models: tuple[DeclaredModel, DeclaredModel], at: Mapping[str, float]) -> Array:
    from scipy.linalg import eigvals

    found: list[float] = []
    for model in models:
        m = model.at(at)
        squares = eigvals(m.K, m.M)
        resonances = np.sqrt(np.abs(squares[np.abs(squares) > 0])) / (2 * np.pi)
        found += resonances[np.isfinite(resonances)].tolist()
    known = [f for f in found if f > 1e-6 * max(found)]
    low, high = (min(known) / _REACH, max(known) * _REACH) if known else _NO_RESONANCE_HZ
    return np.unique(np.concatenate([np.geomspace(low, high, _FREQUENCIES), known]))


def _response(
    result: SavedResult, model: DeclaredModel, at: Mapping[str, float], freq_hz: Array
) -> ModelResponse:
    def response(values: Mapping[str, float]) -> Complex:
        point = model.with_values(values).at(at)
        return lagged(point).response(freq_hz, point.delay_s)

    H = response({})
    errors = result.standard_errors
    slopes, used = [], []
    for index, name in enumerate(result.free):
        half = _STEP * errors[name]
        if half <= 0.0:
            continue
        value, bounds = model.values[name], result.model.parameters[name]
        # A lag below its minimum of zero has no response.
        below = value - half if bounds.min is None else max(value - half, bounds.min)
        above = value + half if bounds.max is None else min(value + half, bounds.max)
        with np.errstate(divide="ignore", invalid="ignore"):
            change = response({name: above}) - response({name: below})
            slopes.append(change / (above - below) / H)
        used.append(index)
    slope = np.stack(slopes, axis=-1) if slopes else np.zeros((*H.shape, 0), complex)
    return ModelResponse(H, slope, result.covariance[np.ix_(used, used)])


def _deviations(
    model: DeclaredModel, freq_hz: Array, a: ModelResponse, b: ModelResponse, dimensions: int
) -> tuple[PathDeviation, ...]:
    from scipy.stats import chi2

    found = []
    for i, output in enumerate(model.dof):
        for j, name in enumerate(model.inputs):
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = b.H[:, i, j] / a.H[:, i, j]
                parts = np.array([np.log(np.abs(ratio)), np.angle(ratio)])
            errors = np.hypot(
                [a.error_re[:, i, j], a.error_im[:, i, j]],
                [b.error_re[:, i, j], b.error_im[:, i, j]],
            )
            known = np.isfinite(parts).all(axis=0) & (errors.max(axis=0) < _DETERMINED)
            if not known.any():
                nan = float("nan")
                found.append(PathDeviation(output, name, nan, nan, nan, nan, nan, nan, 1.0, False))
                continue
            f, parts, errors = freq_hz[known], parts[:, known], errors[:, known]
            size = np.abs(parts)
            with np.errstate(divide="ignore", invalid="ignore"):
                z = np.where(errors > 0, size / errors, 0.0).max(axis=0)
            at = [int(np.argmax(x)) for x in (size[0], size[1], z)]
            found.append(
                PathDeviation(
                    output,
                    name,
                    float(_TO_DB * parts[0, at[0]]),
                    float(f[at[0]]),
                    float(np.degrees(parts[1, at[1]])),
                    float(f[at[1]]),
                    float(z[at[2]]),
                    float(f[at[2]]),
                    float(chi2.sf(z[at[2]] ** 2, dimensions)),
                    True,
                )
            )
    return tuple(found)


def _error(slope: Array, covariance: Array) -> Array:
    squares = np.einsum("fijk,kl,fijl->fij", slope, covariance, slope)
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)))
