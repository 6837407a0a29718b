"""Convert a log into an experiment: inputs, outputs, schedule and loop for the declared model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ....config.base import parse_text
from ....config.model import ModelConfig
from ....config.rig import Geometry
from ....config.units import known_unit
from ....log.importing.signals_yaml import Role, SignalsFile
from ....log.reader import Log
from ....model.controller import pi_controller
from ....model.geometry import decoupling_matrix, shape_matrix
from ...covariance_scaling import correlation
from ...records.from_log import (
    EXCITATION,
    FEED_FORWARD,
    POSE,
    REFERENCE,
    array_field,
    columns,
    controller_of,
    imported_record,
    log_remarks,
    require_fields,
    require_finite,
    require_record,
    require_stated_rate,
    rig_of,
)
from ...records.record import IdentificationError, Record
from ...records.resampling import resample
from .control_loop import ControlLoop, imported_loop
from .intersample_input import Hold
from .sensor_readings import SensorReadings

Array = NDArray[np.float64]

_USED = (
    *(*EXCITATION, *FEED_FORWARD, *REFERENCE, *POSE),
    *("time_s", "gap_m", "coil_n", "coil_excitation_n", "beam_m", "beam_m_s", "beam_force_n"),
    *("rotor_rad", "rotor_rad_s"),
)
"""Fields of a rig log that a fit or a trace reads."""
_REQUIRED = (*EXCITATION, *FEED_FORWARD, *REFERENCE, *POSE, "coil_n")
"""Fields that a rig log needs for a fit; the model's scheduling variables are added."""
_COMMANDS: tuple[Role, ...] = ("reference", "excitation")
"""Roles of the signals that drive a loop from outside."""
_STILL = 1e-3
"""A scheduling variable that varies by less than this share of its range counts as constant."""
_SMOOTH = 0.1
"""Largest ratio of a derivative's squared steps to its squares for a motion. White jitter has 3;
motion up to a twentieth of the sampling rate has less than this."""


@dataclass(frozen=True)
class Experiment:
    """Rows of one record: input u (N, p) as commanded, output y (N, n), schedule by name (N,).

    Schedule variables in `rates` are means over the period after a row, others are samples. The
    input acts `delay_cycles` whole periods after its row, in addition to the model's delay.
    `moving`: the schedule (or only a derivative in it) changes during the record. `loop` is None
    without a known controller; `feedback`: the input depends on the outputs. `hold` is the input
    between samples according to the log; None if not stated. `correlations`: noise correlations of
    the inputs (p, p) and outputs (n, n), which follow from independent coils and sensors; None if
    unknown.
    """

    name: str
    Ts_s: float
    u: Array
    y: Array
    schedule: Mapping[str, Array]
    rates: frozenset[str]
    moving: bool
    delay_cycles: int = 0
    loop: ControlLoop | None = None
    feedback: bool = False
    noise_sd: Array | None = None
    """Stated standard deviation (n,) of the outputs' noise, nan where it is not stated."""
    resolution: Array | None = None
    """Stated smallest step (n,) of the outputs, nan where it is not stated."""
    commanded: Array | None = None
    """References and excitations (N, k) of a loop; None without any."""
    remarks: tuple[str, ...] = ()
    contradictions: tuple[str, ...] = ()
    """What the log states otherwise than the model, such as units."""
    hold: Hold | None = None
    correlations: tuple[Array, Array] | None = None
    spans: Mapping[str, float] = field(default_factory=dict)
    """Range of each scheduling variable in the model."""
    by_coil: bool = False
    """Whether coils are excited one by one, and not by the wrench alone."""
    readings: SensorReadings | None = None
    """Readings of the single sensors from which the outputs were computed; None if not logged."""

    @property
    def causes(self) -> Array | None:
        """Recorded signals (N, k) that do not depend on the outputs; None if none of them varies.

        These are the inputs, in a control loop its references and excitations.
        """
        known = self.commanded if self.feedback else self.u
        return known if known is not None and np.any(np.ptp(known, axis=0)) else None

    def rows(self, start: int, stop: int) -> Experiment:
        """Return rows start to stop (exclusive)."""
        cut = slice(start, stop)
        schedule = {name: values[cut] for name, values in self.schedule.items()}
        return replace(
            self,
            u=self.u[cut],
            y=self.y[cut],
            schedule=schedule,
            loop=self.loop and self.loop.rows(cut),
            commanded=None if self.commanded is None else self.commanded[cut],
            readings=self.readings and self.readings.rows(cut),
        )


def experiment_from_log(log: Log, model: ModelConfig) -> Experiment:
    """Convert a log to the experiment for `model`: commanded wrench, pose and schedule.

    Raises:
        NotARecordError: the log is of another session step.
        IdentificationError: the log lacks signals of the model, their number differs from the
            model's, or a value is not finite.
    """
    if log.metadata.get("kind") == "record":
        known = log.rows.dtype.names or ()
        require_finite(log, [name for name in _USED if name in known])
        if "signals.yaml" not in log.attachments and len(log.rows) > 1:
            require_stated_rate(log)
    log, resampling_remarks = resample(log)  # all columns, including the schedule
    base = _imported(log, model) if "signals.yaml" in log.attachments else _flown(log)
    if (base.u.shape[1], base.y.shape[1]) != (len(model.inputs), len(model.dof)):
        raise IdentificationError(
            f"{log.path}: expected the {len(model.inputs)} inputs and {len(model.dof)} outputs of "
            f"model '{model.name}', found {base.u.shape[1]} and {base.y.shape[1]}"
        )
    names = log.rows.dtype.names or ()
    signals = dict.fromkeys(v.signal for v in model.scheduling.values())
    missing = [signal for signal in signals if signal not in names]
    if missing:
        raise IdentificationError(
            f"{log.path}: expected the model's signals, found no {', '.join(missing)}"
        )
    schedule = {
        name: _schedule(log, variable.signal, variable.derivative, base.Ts_s)
        for name, variable in model.scheduling.items()
    }
    spans = {
        name: _span(variable.min, variable.max, variable.value)
        for name, variable in model.scheduling.items()
    }
    moving = any(
        _moves(schedule[name], spans[name], variable.derivative)
        for name, variable in model.scheduling.items()
    )
    rates = frozenset(name for name, variable in model.scheduling.items() if variable.derivative)
    remarks = (*base.remarks, *resampling_remarks)
    return replace(
        base, schedule=schedule, rates=rates, moving=moving, remarks=remarks, spans=spans
    )


def _imported(log: Log, model: ModelConfig) -> Experiment:
    record = imported_record(log)
    signals = parse_text(log.attachments["signals.yaml"], SignalsFile, "signals.yaml")
    # A schema default does not describe the measurement: only a stated value counts.
    stated = "input_hold" in signals.model_fields_set
    outputs = signals.with_role("output")
    loop, remarks = imported_loop(log, signals, record)
    known = [c.name for role in _COMMANDS for c in signals.with_role(role)]
    require_finite(log, known)
    return Experiment(
        record.name,
        record.Ts_s,
        record.v,
        record.y,
        {},
        frozenset(),
        False,
        loop=loop,
        feedback=signals.loop is not None,
        noise_sd=_stated([c.noise_sd for c in outputs]),
        resolution=_stated([c.resolution for c in outputs]),
        commanded=columns(log, known) if known else None,
        remarks=(*record.remarks, *remarks),
        contradictions=_unit_contradictions(record, model),
        hold=signals.input_hold if stated else None,
    )


def _unit_contradictions(record: Record, model: ModelConfig) -> tuple[str, ...]:
    """Return the inputs and outputs whose unit in the signals file is not that of the model."""
    inputs = zip(record.input_names, record.input_units, model.inputs, strict=False)
    outputs = zip(record.output_names, record.output_units, model.dof, strict=False)
    return tuple(
        f"{name} is in {_unit_text(unit)} in its signals file, but {axis.name} in "
        f"{_unit_text(axis.unit)} in model '{model.name}': correct unit and scale in the signals "
        "file, or the unit of the model; else the parameters are wrong"
        for name, unit, axis in (*inputs, *outputs)
        if unit != axis.unit and (known_unit(unit) or unit) != (known_unit(axis.unit) or axis.unit)
    )


def _unit_text(unit: str) -> str:
    return "unit 1 (none)" if unit == "1" else unit


def _stated(values: Sequence[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in values])


def _flown(log: Log) -> Experiment:
    """Return the experiment of a rig log; its input is the wrench of the commanded coil forces."""
    require_record(log)
    require_fields(log, _REQUIRED, "the declared model")
    gains = controller_of(log)
    geometry = rig_of(log).geometry
    S = shape_matrix(geometry.coil_x_m, geometry.coil_y_m)
    T = decoupling_matrix(geometry.sensors_x_m, geometry.sensors_y_m)
    coils = coil_excitation(log, len(S))
    loop = ControlLoop(
        columns(log, EXCITATION) + coils @ S,
        columns(log, REFERENCE),
        columns(log, FEED_FORWARD),
        np.zeros((len(log.rows), len(POSE))),
        pi_controller(gains.kp, gains.ki, 1.0 / log.rate_hz),
    )
    return Experiment(
        log.metadata.get("name") or log.path.stem,
        1.0 / log.rate_hz,
        np.asarray(array_field(log, "coil_n", len(S), "coils") @ S),
        columns(log, POSE),
        {},
        frozenset(),
        False,
        1,  # a force computed in cycle k acts from cycle k + 1 on, on every backend
        loop,
        feedback=True,
        remarks=tuple(log_remarks(log)),
        hold="zoh",
        correlations=(correlation(S.T @ S), correlation(T @ T.T)),
        by_coil=bool(np.any(coils)),
        readings=_readings(log, geometry, S),
    )


def _readings(log: Log, geometry: Geometry, forces: Array) -> SensorReadings | None:
    """Return the gaps of a rig log, None for a log without them."""
    if "gap_m" not in (log.rows.dtype.names or ()):
        return None
    x, y = geometry.sensors_x_m, geometry.sensors_y_m
    return SensorReadings(
        np.ascontiguousarray(log.rows["gap_m"], dtype=np.float32),
        np.stack([x, y], axis=1),
        np.stack([geometry.coil_x_m, geometry.coil_y_m], axis=1),
        shape_matrix(x, y),
        forces,
    )


def coil_excitation(log: Log, coils: int) -> Array:
    """Return the excitation of each coil (N, coils) in N; zeros for a rig log without the field."""
    name = "coil_excitation_n"
    if name not in (log.rows.dtype.names or ()):
        return np.zeros((len(log.rows), coils))
    return array_field(log, name, coils, "coils")


def _schedule(log: Log, signal: str, derivative: bool, Ts_s: float) -> Array:
    values = log.field(signal).astype(float)
    if not derivative:
        return np.asarray(values)
    # The mean over the following period, which is exact for any motion within it.
    return np.append(np.diff(values), 0.0) / Ts_s


def _moves(values: Array, span: float, derivative: bool) -> bool:
    if derivative:
        values = values[:-1]  # no period follows the last row
    if len(values) < 2 or np.ptp(values) <= _STILL * span:
        return False
    # Differences amplify the jitter of a resting beam: only smooth changes count as motion.
    rest = values - values.mean()
    return not derivative or bool(np.sum(np.diff(values) ** 2) < _SMOOTH * np.sum(rest**2))


def _span(low: float | None, high: float | None, value: float) -> float:
    if low is not None and high is not None:
        return high - low
    return max(abs(value), 1.0)
