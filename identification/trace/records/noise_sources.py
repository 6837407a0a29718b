"""The noise of sensors and amplifiers, told from what an undeclared effect does.

Sensor noise is read where a platform cannot follow, force noise in records in which nothing is
excited, both by medians over frequencies: a line of the mains, a resonance that nobody declared or
a hum of the floor moves a median little.
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
from ...greybox.experiment import Experiment
from ...greybox.noise_floor import powers_of
from ...greybox.noise_model import Noise
from ...records.record import IdentificationError
from .sensor_white_noise import white_noise
from .trace_record import TraceRecord

Array = NDArray[np.float64]

_LEAST_NOISE = 1e-7
"""Of a motion's rms: 23 bits, which no sensor resolves, but rounded arithmetic does."""
_LONGEST_S = 60.0
_BAND_HZ = (0.4, 80.0)
_SEGMENT_S = 5.0
_WIDEST, _MOST_REACHES = 1e3, 4
"""Force noise is looked for within this factor of what the fit took it to be, and where it is not
in between within this factor of that end again."""
_ALIKE = 3.0
"""Factor that the noise of two outputs may be apart by, where all errors are measured by one."""


@dataclass(frozen=True)
class Disturbance:
    """Noise as a filter takes it; standard deviation of a sensor; whether still records told it."""

    noise: Noise
    sensor_sd: float
    measured: bool


def disturbance(
    model: DeclaredModel, records: Sequence[TraceRecord], fallback: Noise
) -> Disturbance:
    """Return the noise of records; `fallback` where no record is still enough to tell its force.

    All actuators are taken to be equally noisy, and all sensors: noise is what they have in common.
    Each is independent of the others; what they add up to in several DOF often is not.
    """
    places = records[0].places
    T = places.decoupling
    still = [r for r in records if r.still and r.experiment.loop is not None]
    sd = float(np.median(sensor_noise(records)))
    output = T @ T.T * sd**2
    if not still:
        # Unknown forces are the fit's own until something better explains them.
        return Disturbance(Noise(fallback.force_density, output), sd, measured=False)
    unit = places.coil_shape.T @ places.coil_shape
    first = float(np.median(fallback.force_psd / np.diag(unit)))
    levels = [_force_level(model, r.experiment, Noise(first * unit, output)) for r in still]
    return Disturbance(Noise(float(np.median(levels)) * first * unit, output), sd, measured=True)


def require_noise(records: Sequence[TraceRecord]) -> None:
    """Raise IdentificationError where readings have no noise that errors could be measured by."""
    sd = float(np.median(sensor_noise(records)))
    spread = max(float(np.std(r.gap, axis=0).max()) for r in records)
    if not sd > _LEAST_NOISE * spread:
        unit = records[0].places.sensor_unit
        raise IdentificationError(
            f"expected readings with the noise of a sensor, which all errors are measured by, "
            f"found {sd:.2g} {unit} on readings that move by {spread:.2g} {unit} rms: give "
            "simulated readings the noise that a sensor has"
        )
    _require_one_scale(records)


def _require_one_scale(records: Sequence[TraceRecord]) -> None:
    """Raise IdentificationError for imported outputs that one noise cannot stand for."""
    places = records[0].places
    if places.sensors > len(places.dof):
        return  # sensors of a kind
    noise = sensor_noise(records)
    if len(set(places.dof_units)) > 1 or noise.max() > _ALIKE * noise.min():
        found = ", ".join(
            f"{sd:.2g} {unit} on {name}"
            for sd, unit, name in zip(noise, places.dof_units, places.dof, strict=True)
        )
        raise IdentificationError(
            "expected outputs in one unit, of about the same noise, since all errors are measured "
            f"by that, found {found}: multiply angles by an arm, or trace the outputs one by one"
        )


def sensor_noise(records: Sequence[TraceRecord]) -> Array:
    """Return the standard deviation (S,) of each sensor's white noise, as most records show it."""
    found = []
    for record in records:
        found.append(white_noise(record.gap[: round(_LONGEST_S / record.experiment.Ts_s)]))
    return np.asarray(np.median(found, axis=0))


def _force_level(model: DeclaredModel, experiment: Experiment, noise: Noise) -> float:
    """Return by what the density of the force noise must be multiplied, from a still record."""
    Ts_s = experiment.Ts_s
    segment = min(round(_SEGMENT_S / Ts_s), len(experiment.y) // 2)
    freq_hz, seen = welch(experiment.y, 1 / Ts_s, nperseg=segment, axis=0)
    band = (freq_hz >= _BAND_HZ[0]) & (freq_hz <= _BAND_HZ[1])
    by_force, by_sensor = _responses(model, experiment, freq_hz[band])
    # A sensor shows its own noise besides.
    shown = by_sensor + np.eye(by_sensor.shape[1])
    force = 2 * powers_of(by_force, noise.force_density)
    sensor = 2 * Ts_s * powers_of(shown, noise.output_covariance)

    # The median of an average of few periodograms lies below their mean.
    halves = 2 * max(round(2 * len(experiment.y) / segment) - 1, 1)
    low = float(chi2.median(halves)) / halves

    def misfit(log_level: float) -> float:
        expected = low * (np.exp(log_level) * force + sensor)
        return float(np.mean(np.abs(np.log(seen[band] / expected))))

    reach, middle = np.log(_WIDEST), 0.0
    for _ in range(_MOST_REACHES):
        coarse = middle + np.linspace(-reach, reach, 57)
        best = int(np.argmin([misfit(level) for level in coarse]))
        start, step = float(coarse[best]), float(coarse[1] - coarse[0])
        if 0 < best < len(coarse) - 1:
            break
        middle = start
    found = minimize_scalar(misfit, bounds=(start - step, start + step), method="bounded")
    return float(np.exp(found.x))


def _responses(
    model: DeclaredModel, experiment: Experiment, freq_hz: Array
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the pose's response (F, n, n) to outer forces and to sensor noise, in the loop."""
    Ts_s = experiment.Ts_s
    at = model.at({name: float(v.mean()) for name, v in experiment.schedule.items()})
    n = len(at.M)
    outer = replace(at, B=np.eye(n), lag_s=0.0, delay_s=0.0)
    P_outer = discretise(outer, Ts_s).response(freq_hz)
    if experiment.loop is None:
        return P_outer, np.zeros((len(freq_hz), n, n), complex)
    delay_s = max(at.delay_s + experiment.delay_cycles * Ts_s, 0.0)
    P = discretise(replace(at, delay_s=delay_s), Ts_s).response(freq_hz)
    C = experiment.loop.controller.response(freq_hz, Ts_s)
    loop_gain = P * C[:, None, :]
    sensitivity = np.linalg.inv(np.eye(n) + loop_gain)
    return sensitivity @ P_outer, -sensitivity @ loop_gain
