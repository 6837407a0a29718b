"""Estimate sensor noise and amplifier noise, robust against undeclared effects.

Sensor noise is estimated at frequencies above the platform's motion, force noise from still
records. Both use medians over frequencies, which a mains line, an undeclared resonance or ground
vibration hardly changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.signal import welch
from scipy.stats import chi2

from ....model.declared_model import DeclaredModel
from ....model.second_order import discretise
from ...greybox.experiment.experiment_from_log import Experiment
from ...greybox.free_run.free_run_noise_floor import powers_of
from ...greybox.prediction.noise_model import Noise
from ...records.record import IdentificationError
from ...rounding import SINGLE_ROUNDING
from ..search_options import SearchOptions
from .record_from_log import TraceRecord
from .sensor_white_noise import white_noise

Array = NDArray[np.float64]

_LONGEST_S = SearchOptions.blocks * SearchOptions.block_s
_LOWEST_HZ, _HIGHEST = 2.0 / SearchOptions.block_s, 0.5 / SearchOptions.resolved
"""Frequencies at which force noise shows: the highest one over the sampling rate."""
_REACH = -SearchOptions.resolved * np.log(SearchOptions().inexact)
"""Search range of the force noise, as a logarithm of the factor on the fit's."""
_ALIKE = SearchOptions.standard_errors
"""Largest ratio of two outputs' noise, since all errors are divided by one noise."""


@dataclass(frozen=True)
class Disturbance:
    """Noise of the filter, standard deviation of a sensor, and whether still records give it."""

    noise: Noise
    sensor_sd: float
    measured: bool


def disturbance(
    model: DeclaredModel, records: Sequence[TraceRecord], fallback: Noise
) -> Disturbance:
    """Estimate the noise of records; without still records, the force noise is `fallback`.

    All actuators have equal, independent noise, and so have all sensors. Their sums in several DOF
    are often correlated.
    """
    places = records[0].places
    T = places.decoupling
    still = [r for r in records if r.still and r.experiment.loop is not None]
    sd = float(np.median(sensor_noise(records)))
    output = T @ T.T * sd**2
    if not still:
        # The fit's force noise includes unknown forces, until effects explain them.
        return Disturbance(Noise(fallback.force_density, output), sd, measured=False)
    unit = places.coil_shape.T @ places.coil_shape
    first = float(np.median(fallback.force_psd / np.diag(unit)))
    levels = [_force_level(model, r.experiment, Noise(first * unit, output)) for r in still]
    return Disturbance(Noise(float(np.median(levels)) * first * unit, output), sd, measured=True)


def require_noise(records: Sequence[TraceRecord]) -> None:
    """Raise IdentificationError for readings without sensor noise, the unit of all errors."""
    sd = float(np.median(sensor_noise(records)))
    spread = max(float(np.std(r.gap, axis=0).max()) for r in records)
    if not sd > SINGLE_ROUNDING * spread:
        unit = records[0].places.sensor_unit
        raise IdentificationError(
            "expected readings with sensor noise, because errors are given in multiples of it; "
            f"found a noise of {sd:.2g} {unit} on readings that vary by {spread:.2g} {unit} RMS; "
            "add noise to simulated readings"
        )
    _require_one_scale(records)


def _require_one_scale(records: Sequence[TraceRecord]) -> None:
    """Raise IdentificationError for imported outputs of different units or noise."""
    places = records[0].places
    if places.beam or places.sensors > len(places.dof):
        return  # sensors of one kind: the rig's read gaps, however many there are
    noise = sensor_noise(records)
    if len(set(places.dof_units)) > 1 or noise.max() > _ALIKE * noise.min():
        found = ", ".join(
            f"{sd:.2g} {unit} on {name}"
            for sd, unit, name in zip(noise, places.dof_units, places.dof, strict=True)
        )
        raise IdentificationError(
            "expected outputs in one unit and with similar noise, because errors are given in "
            f"multiples of the noise; found {found}; multiply angles by a lever arm, or trace the "
            "outputs one by one"
        )


def sensor_noise(records: Sequence[TraceRecord]) -> Array:
    """Return each sensor's white noise standard deviation (S,), the median over the records."""
    found = []
    for record in records:
        found.append(white_noise(record.gap[: round(_LONGEST_S / record.experiment.Ts_s)]))
    return np.asarray(np.median(found, axis=0))


def _force_level(model: DeclaredModel, experiment: Experiment, noise: Noise) -> float:
    """Return the factor on the force noise density that fits a still record."""
    Ts_s = experiment.Ts_s
    segment = min(round(SearchOptions.block_s / Ts_s), len(experiment.y) // 2)
    freq_hz, seen = welch(experiment.y, 1 / Ts_s, nperseg=segment, axis=0)
    band = (freq_hz >= _LOWEST_HZ) & (freq_hz <= _HIGHEST / Ts_s)
    by_force, by_sensor = _responses(model, experiment, freq_hz[band])
    # A reading also contains the sensor's own noise.
    shown = by_sensor + np.eye(by_sensor.shape[1])
    force = 2 * powers_of(by_force, noise.force_density)
    sensor = 2 * Ts_s * powers_of(shown, noise.output_covariance)

    # The median of an average of few periodograms lies below their mean.
    halves = 2 * max(round(2 * len(experiment.y) / segment) - 1, 1)
    low = float(chi2.median(halves)) / halves

    def misfit(log_level: float) -> float:
        expected = low * (np.exp(log_level) * force + sensor)
        return float(np.mean(np.abs(np.log(seen[band] / expected))))

    coarse = np.linspace(-_REACH, _REACH, SearchOptions.at_a_time)
    start = float(coarse[np.argmin([misfit(level) for level in coarse])])
    step = float(coarse[1] - coarse[0])
    found = minimize_scalar(misfit, bounds=(start - step, start + step), method="bounded")
    return float(np.exp(found.x))


def _responses(
    model: DeclaredModel, experiment: Experiment, freq_hz: Array
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the pose's responses (F, n, n) to external force and to sensor noise, in the loop."""
    Ts_s = experiment.Ts_s
    at = model.at({name: float(v.mean()) for name, v in experiment.schedule.items()})
    n = len(at.M)
    outer = replace(at, B=np.eye(n), lag_s=0.0, delay_s=0.0)
    P_outer = discretise(outer, Ts_s).response(freq_hz)
    if experiment.loop is None:
        return P_outer, np.zeros((len(freq_hz), n, n), complex)
    delay_s = max(at.delay_s + experiment.delay_cycles * Ts_s, 0.0)
    P = discretise(replace(at, delay_s=delay_s), Ts_s).response(freq_hz)
    C = experiment.loop.controller.response(freq_hz)
    loop_gain = P @ C
    sensitivity = np.linalg.inv(np.eye(n) + loop_gain)
    return sensitivity @ P_outer, -sensitivity @ loop_gain
