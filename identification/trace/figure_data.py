"""Reduce the records of a trace to the data of the report's figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from math import ceil

import numpy as np
from numpy.typing import NDArray

from ...model.effects.base import Placed, Signals
from ..greybox.free_run.free_run_noise_floor import floor_psd
from ..rounding import ROUNDING, TINY
from .linearised.linearisation_point import Along, WorkingPoint
from .records.record_from_log import TraceRecord
from .records.sensor_and_amplifier_noise import Disturbance
from .residual.force_residual import (
    Missing,
    denoised,
    density,
    missing,
    noise_density,
    share,
    standing_out,
)
from .run_trace import Trace
from .search_options import SearchOptions
from .worker_pool import Workers

Array = NDArray[np.float64]

_MOST_SAMPLES = SearchOptions.at_a_time * SearchOptions.resolved**2
"""Of a signal: some for each pixel of a figure."""
_SEEN = SearchOptions.law_accuracy
"""Least size of a plotted part of an effect, over its largest part."""
_MOST_ASPECTS = SearchOptions.resolved


@dataclass(frozen=True)
class PlottedSignal:
    """Samples (K,) of a signal that an effect may depend on."""

    name: str
    unit: str
    values: Array


@dataclass(frozen=True)
class Aspect:
    """One part of an effect in one record, sampled: place, fitted (K,) and measured (K,) values.

    measured: fitted plus the residual of the model with all effects; its mean over the record is
    the fitted one, as a constant force is unknown. Both pass the same filter, which keeps the
    frequencies at which the effect exceeds the residual. block (K,): number of the time block.
    `signals`: signals that the effect may depend on.
    """

    identity: str
    place: str
    unit: str
    fitted: Array
    measured: Array
    block: NDArray[np.int64]
    signals: tuple[PlottedSignal, ...]


@dataclass(frozen=True)
class RecordView:
    """The figure data of one record, before and after the trace.

    time_s (B,): middle of time blocks; before, after (B,): mean squares of the one-step-ahead
    errors and of the readings' non-rigid part, in noise variances. sensor_before, sensor_after
    (S,): RMS of each sensor's non-rigid part over its noise there; NaN if the sensors are not
    redundant. signals (K,) each; force_before, force_after (K, n): residual generalised force,
    filtered to exceed the noise; stands_out_before, stands_out_after (n,): its RMS over that of the
    noise in the same band. floor (F, n): noise floor density of the pose's free-run error.
    """

    name: str
    held: bool
    time_s: Array
    before: Array
    after: Array
    sensor_before: Array
    sensor_after: Array
    block: NDArray[np.int64]
    signals: tuple[PlottedSignal, ...]
    force_before: Array
    force_after: Array
    stands_out_before: Array
    stands_out_after: Array
    aspects: tuple[Aspect, ...]
    floor: Array | None


@dataclass(frozen=True)
class Views:
    """All records in time order, and the units of the generalised forces."""

    records: tuple[RecordView, ...]
    dof: tuple[str, ...]
    force_units: tuple[str, ...]


def views(found: Trace, workers: Workers) -> Views:
    """Return the figure data of all records of a trace."""
    held = {e.name: e.freq_hz for e in found.after}
    seen = workers.map(partial(_view, found.declared, found.found.point, held), found.records)
    places = found.places
    units = tuple(places.force_unit(i) for i in range(len(places.dof)))
    return Views(tuple(sorted(seen, key=lambda v: float(v.time_s[0]))), places.dof, units)


def _view(
    declared: WorkingPoint,
    found: WorkingPoint,
    held: Mapping[str, Array],
    record: TraceRecord,
) -> RecordView:
    before, after = missing(declared, record), missing(found, record)
    s = after.here.signals
    every = _thinning(record)
    block = _blocks(record)[::every]
    signals = tuple(_thinned(_signals(found, s), every))
    force_before, out_before = _standing_out(declared, before)
    force_after, out_after = _standing_out(found, after)
    time_s, squares_before = _block_squares(declared, before)
    _, squares_after = _block_squares(found, after)
    aspects = _aspects(found, after, every, block) if found.placed else ()
    freq_hz = held.get(record.name)
    floor = None
    if freq_hz is not None:
        noise = found.disturbance.noise
        floor = floor_psd(found.model, record.experiment, found.hold, noise, freq_hz)
    return RecordView(
        record.name, record.name in held, time_s, squares_before, squares_after,
        _sensor_rms(declared.disturbance, before), _sensor_rms(found.disturbance, after),
        block, signals, force_before[::every], force_after[::every], out_before, out_after, aspects,
        floor,
    )  # fmt: skip


def _thinning(record: TraceRecord) -> int:
    return ceil(record.rows / _MOST_SAMPLES)


def _blocks(record: TraceRecord) -> NDArray[np.int64]:
    """Return the number of the time block of each row (N,)."""
    return np.floor(record.time_s / SearchOptions.block_s).astype(np.int64)


def _thinned(signals: Iterator[PlottedSignal], every: int) -> Iterator[PlottedSignal]:
    for signal in signals:
        yield PlottedSignal(signal.name, signal.unit, signal.values[::every])


def _signals(point: WorkingPoint, s: Signals) -> Iterator[PlottedSignal]:
    """Yield the signals that a residual may depend on."""
    places = s.places
    for order, values in enumerate((s.q, s.qd, s.qdd)):
        per = ("", "/s", "/s²")[order]
        for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True)):
            yield PlottedSignal(dof + "'" * order, f"{unit}{per}", values[:, i])
    if places.beam:
        yield PlottedSignal("x_b", "m", s.x_b_m)
        yield PlottedSignal("v_b", "m/s", s.v_b_m_s)
        yield PlottedSignal("a_b", "m/s²", s.a_b_m_s2)
        yield PlottedSignal("phi", "rad", s.phi_rad)
        yield PlottedSignal("phi'", "rad/s", s.phi_rad_s)
        yield PlottedSignal("phi''", "rad/s²", s.phi_rad_s2)
    acting = s.acting(s.coil) @ places.coil_shape
    for i, name in enumerate(point.model.inputs):
        yield PlottedSignal(name, places.input_units[i], acting[:, i])
    yield PlottedSignal("time", "s", s.time_s)


def _standing_out(point: WorkingPoint, left: Missing) -> tuple[Array, Array]:
    """Return the residual force (N, n), filtered to exceed the noise, and its RMS over noise."""
    Ts_s = left.here.at.Ts_s
    freq_hz, psd = density(left.force, Ts_s)
    noise = noise_density(point, left.here, freq_hz)
    gain = standing_out(psd, noise, freq_hz)
    force = np.column_stack(
        [denoised(f, g, freq_hz, Ts_s) for f, g in zip(left.force.T, gain.T, strict=True)]
    )
    passed = np.sqrt(np.sum(gain**2 * noise, axis=0))
    out = np.sqrt(np.sum(gain**2 * psd, axis=0)) / np.maximum(passed, TINY)
    return force, np.where(passed > 0, out, 0.0)


def _block_squares(point: WorkingPoint, left: Missing) -> tuple[Array, Array]:
    """Return times and mean squares (B,) of all residuals, over blocks of time."""
    here = left.here
    rows, n = here.errors.shape[:2]
    shape = here.record.places.sensor_shape
    squares = (here.errors.reshape(rows, n) ** 2).sum(axis=1)
    width = n
    if len(shape) > n:
        cut = left.reading[: rows * here.every].reshape(rows, here.every, -1)
        mean = cut.sum(axis=1) / (np.sqrt(here.every) * point.disturbance.sensor_sd)
        squares = squares + (mean**2).sum(axis=1)
        width += len(shape) - n
    time_s = here.record.time_s[: rows * here.every : here.every]
    _, number = np.unique(np.floor(time_s / SearchOptions.block_s), return_inverse=True)
    count = np.bincount(number)
    return np.bincount(number, time_s) / count, np.bincount(number, squares) / (count * width)


def _sensor_rms(disturbance: Disturbance, left: Missing) -> Array:
    """Return the RMS (S,) of the readings' non-rigid part, over that of white sensor noise."""
    shape = left.here.record.places.sensor_shape
    own = 1 - np.einsum("si,is->s", shape, np.linalg.pinv(shape))
    noise = disturbance.sensor_sd * np.sqrt(np.maximum(own, 0.0))
    rms = np.sqrt(np.mean(left.reading**2, axis=0))
    return np.where(own > ROUNDING, rms / np.maximum(noise, TINY), np.nan)


def _aspects(
    point: WorkingPoint, left: Missing, every: int, block: NDArray[np.int64]
) -> tuple[Aspect, ...]:
    found: list[Aspect] = []
    for placed in point.placed:
        parts = sorted(_parts(point, left, placed), key=lambda p: -p.size)
        largest = parts[0].size if parts else 0.0
        for part in parts[:_MOST_ASPECTS]:
            if part.size < _SEEN * largest or part.size <= 0.0:
                continue
            found.append(_sampled(point, left, placed, part, every, block))
    return tuple(found)


@dataclass(frozen=True)
class _Part:
    """A part of an effect along a record: fitted and residual (N,), and its size over the noise."""

    place: str
    unit: str
    fitted: Array
    left: Array
    size: float
    signals: tuple[PlottedSignal, ...]


def _parts(point: WorkingPoint, left: Missing, placed: Placed) -> Iterator[_Part]:
    """Yield the parts of an effect: by coil, DOF, sensors and drives."""
    here = left.here
    own, places, s = share(point, here, placed), here.record.places, here.signals
    where = placed.effect.where
    coils = [places.actuators.index(w) for w in where if w in places.actuators]
    sensors = [int(w.partition(":")[2]) for w in where if w.startswith("sensor:")]
    if own.force is not None and len(coils) == len(where) == 1:
        # The force of one coil acts on all DOF in the ratio of its arms.
        arm = places.coil_shape[coils[0]]
        name = f"coil {coils[0]}" if places.beam else where[0]
        weight = arm / float(arm @ arm)
        driven = (
            PlottedSignal(f"command of {name}", places.coil_unit, s.acting(s.coil)[:, coils[0]]),
            PlottedSignal(f"height at {name}", places.sensor_unit, s.q @ arm),
        )
        yield _part(
            f"force of {name}", places.coil_unit, own.force @ weight,
            left.force @ weight, here, driven,
        )  # fmt: skip
    elif own.force is not None:
        for i, dof in enumerate(places.dof):
            yield _part(
                f"force on {dof}", places.force_unit(i), own.force[:, i], left.force[:, i], here, ()
            )
    if own.reading is not None:
        _, _, directions = np.linalg.svd(own.reading, full_matrices=False)
        direction = directions[0]
        place, scale = "readings, their common pattern", 1.0
        signals: tuple[PlottedSignal, ...] = ()
        if len(sensors) == 1:
            sensor = sensors[0]
            direction = np.zeros(places.sensors)
            direction[sensor] = 1.0
            seen = 1 - float(places.sensor_shape[sensor] @ places.decoupling[:, sensor])
            place, scale = f"reading of sensor {sensor}", 1 / max(seen, ROUNDING)
            height = s.gap(sensor)
            signals = (
                PlottedSignal(f"height at sensor {sensor}", places.sensor_unit, height),
                PlottedSignal(
                    f"speed at sensor {sensor}",
                    f"{places.sensor_unit}/s",
                    s.qd @ places.sensor_shape[sensor],
                ),
            )
        yield _part(
            place, places.sensor_unit, scale * (own.reading @ direction),
            scale * (left.reading @ direction), here, signals,
        )  # fmt: skip
    if own.drive is not None and left.drive is not None:
        yield _part("force of the beam's drives", "N", own.drive, left.drive, here, ())


def _part(
    place: str,
    unit: str,
    fitted: Array,
    left: Array,
    here: Along,
    signals: tuple[PlottedSignal, ...],
) -> _Part:
    Ts_s, mean = here.at.Ts_s, fitted.mean()
    fitted, left = fitted - mean, left - left.mean()
    freq_hz, psd = density(np.column_stack([fitted, left]), Ts_s)
    gain = psd[:, 0] / np.maximum(psd[:, 0] + psd[:, 1], TINY)
    size = float(np.sqrt(np.sum(gain * psd[:, 0]) / max(np.sum(gain * psd[:, 1]), TINY)))
    fitted, left = (denoised(v, gain, freq_hz, Ts_s) for v in (fitted, left))
    # The own signals pass the filter too: a gain stays a straight line over its command.
    own = tuple(
        PlottedSignal(x.name, x.unit, m + denoised(x.values - m, gain, freq_hz, Ts_s))
        for x, m in ((x, float(x.values.mean())) for x in signals)
    )
    return _Part(place, unit, fitted + mean, left, size if np.any(fitted) else 0.0, own)


def _sampled(
    point: WorkingPoint,
    left: Missing,
    placed: Placed,
    part: _Part,
    every: int,
    block: NDArray[np.int64],
) -> Aspect:
    signals = (*part.signals, *_signals(point, left.here.signals))
    return Aspect(
        placed.effect.identity,
        part.place,
        part.unit,
        part.fitted[::every],
        (part.fitted + part.left)[::every],
        block,
        tuple(_thinned(iter(signals), every)),
    )
