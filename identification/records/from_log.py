"""Convert logs into records: choose excitation, input and output, and collect remarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from ...config.base import ConfigError, Strict, parse_text
from ...config.rig import RigConfig
from ...log.importing.clipping import clipping_remarks
from ...log.importing.importer import REMARKS
from ...log.importing.signals_yaml import Column, SignalsFile
from ...log.reader import Log
from ...model.geometry import shape_matrix
from .record import (
    BEAM_POSITION_TOLERANCE_M,
    OTHER_STEP,
    IdentificationError,
    NotARecordError,
    PiController,
    Record,
)
from .resampling import resample

S = TypeVar("S", bound=Strict)
Array = NDArray[np.float64]

DOF = ("psi", "theta", "z")
INPUT_UNITS = ("N m", "N m", "N")
OUTPUT_UNITS = ("rad", "rad", "m")
EXCITATION = ("v_psi_n_m", "v_theta_n_m", "v_z_n")
_WRENCH = ("tau_psi_n_m", "tau_theta_n_m", "tau_z_n")
FEED_FORWARD = ("ff_psi_n_m", "ff_theta_n_m", "ff_z_n")
POSE = ("psi_rad", "theta_rad", "z_m")
REFERENCE = ("psi_ref_rad", "theta_ref_rad", "z_ref_m")
_COILS = "coil_n"
_CYCLE = (*EXCITATION, *_WRENCH, *FEED_FORWARD, *POSE, *REFERENCE, "beam_m")


_MIN_ROWS = 50
_MEDIAN_ROWS = 25
"""Window of the median filter that separates missing samples from late messages."""
_RATE_TOLERANCE = 0.01
"""Relative difference allowed between the stated rate and the log times: foreign clocks drift."""


def from_log(log: Log) -> Record:
    """Return the record of a rig log or of an imported log.

    Raises NotARecordError for a log of another session step, without excitation, or without one
    beam position; IdentificationError (with file and field) if data are missing or invalid.
    """
    kind = log.metadata.get("kind")
    if kind == "import" or "signals.yaml" in log.attachments:
        return replace(imported_record(log), beam_m=_position(log))
    if kind is None:
        _require_cycles(log)
    require_record(log)
    return _from_cycles(log)


def require_record(log: Log) -> None:
    """Raise NotARecordError for a rig log of another session step."""
    kind = log.metadata.get("kind")
    if kind != "record":
        raise NotARecordError(f"{log.path.name}: kind '{kind or 'none'}' skipped, {OTHER_STEP}")


def records_from_logs(logs: Sequence[Log]) -> tuple[tuple[Record, ...], tuple[str, ...]]:
    """Return the records of the logs, and a reason for each log that is skipped."""
    records, skipped = [], []
    for log in logs:
        try:
            records.append(from_log(log))
        except NotARecordError as reason:
            skipped.append(str(reason))
    return tuple(records), tuple(skipped)


def _from_cycles(log: Log) -> Record:
    _require_cycles(log)
    log, resampling_remarks = resample(log)
    v = columns(log, EXCITATION)
    beam = log.rows["beam_m"].astype(float)
    if not np.any(v):
        raise NotARecordError(f"{log.path.name}: skipped, it has no wrench excitation")
    _check_one_position(log, "the beam", beam)
    unlimited, sent, input_remarks = _inputs(log)
    return Record(
        name=log.metadata.get("name") or log.path.stem,
        Ts_s=1.0 / log.rate_hz,
        v=v,
        u=sent,
        u_unlimited=unlimited,
        y=columns(log, POSE),
        input_names=DOF,
        input_units=INPUT_UNITS,
        output_names=DOF,
        output_units=OUTPUT_UNITS,
        beam_m=float(beam.mean()),
        controller=controller_of(log),
        delay_cycles=1,  # a force computed in cycle k acts from cycle k + 1 on, on every backend
        at_rest=False,  # the platform may still ring from the record before
        remarks=(*log_remarks(log), *input_remarks, *resampling_remarks),
    )


def _inputs(log: Log) -> tuple[Array, Array, tuple[str, ...]]:
    """Return the wrench before the limits, the wrench sent (both (N, 3)), and remarks.

    Both are without feed-forward. The wrench sent follows from the coil commands after all limits,
    and includes the excitation of single coils.
    """
    feed_forward = columns(log, FEED_FORWARD)
    unlimited = columns(log, _WRENCH) - feed_forward
    if _COILS not in (log.rows.dtype.names or ()):
        remark = f"no field {_COILS}: coil forces are assumed to equal the demand, without limits"
        return unlimited, unlimited, (remark,)
    require_finite(log, [_COILS])
    geometry = rig_of(log).geometry
    S = shape_matrix(geometry.coil_x_m, geometry.coil_y_m)
    coils = array_field(log, _COILS, len(S), "coils")
    return unlimited, coils @ S - feed_forward, ()


def controller_of(log: Log) -> PiController:
    """Return the controller in the log's rig.yaml; raises IdentificationError without one."""
    control = rig_of(log).control
    return PiController(np.array(control.kp), np.array(control.ki))


def rig_of(log: Log) -> RigConfig:
    """Return the log's rig.yaml, parsed; raises IdentificationError if missing or invalid."""
    return attached(log, "rig.yaml", RigConfig)


def log_remarks(log: Log) -> list[str]:
    """Return remarks on events in a rig log that a linear model does not include."""
    found = []
    if np.any(columns(log, REFERENCE)):
        found.append("references are not zero; changes of a reference bias the estimate")
    at_limit = cycles_at_limit(log)
    if at_limit:
        found.append(f"{at_limit} cycles with saturated coils")
    names = log.rows.dtype.names or ()
    if "coil_excitation_n" in names and np.any(log.rows["coil_excitation_n"]):
        found.append("single coils were also excited, which counts as noise here")
    return [*found, *truncation_remarks(log)]


def cycles_at_limit(log: Log) -> int:
    """Count the cycles with a saturated coil."""
    if "saturated" not in (log.rows.dtype.names or ()):
        return 0
    return int(np.count_nonzero(log.rows["saturated"]))


def truncation_remarks(log: Log) -> list[str]:
    """Return a remark if the log is truncated."""
    if log.complete:
        return []
    return [
        f"the log is truncated ({log.problem}); its readable part is used, and `levid salvage` "
        "recovers what follows damage"
    ]


def imported_record(log: Log) -> Record:
    """Return inputs and outputs of an imported log, without its operating point.

    Raises IdentificationError for an invalid signals.yaml or missing columns.
    """
    signals = attached(log, "signals.yaml", SignalsFile)
    inputs, outputs = signals.with_role("input"), signals.with_role("output")
    for role, found in (("input", inputs), ("output", outputs)):
        if not found:
            raise IdentificationError(
                f"{log.path}: signals.yaml: expected a column of role {role}, found none"
            )
    _require(log, [c.name for c in (*inputs, *outputs, *signals.with_role("scheduling"))])
    return Record(
        name=log.metadata.get("name") or log.path.stem,
        Ts_s=1.0 / log.rate_hz,
        v=columns(log, [c.name for c in inputs]),
        y=columns(log, [c.name for c in outputs]),
        input_names=tuple(c.name for c in inputs),
        input_units=tuple(c.unit for c in inputs),
        output_names=tuple(c.name for c in outputs),
        output_units=tuple(c.unit for c in outputs),
        feedback=signals.loop is not None,
        held=signals.input_hold == "zoh",
        remarks=(*truncation_remarks(log), *_import_remarks(log, (*inputs, *outputs))),
    )


def _import_remarks(log: Log, columns: Sequence[Column]) -> list[str]:
    """Return what the import changed, and the columns that seem to be clipped."""
    found = log.metadata.get(REMARKS, "").splitlines()
    for column in columns:
        found += clipping_remarks(
            column.name, column.unit, log.field(column.name), output=column.role == "output"
        )
    return found


def attached(log: Log, name: str, schema: type[S]) -> S:
    """Return an attached YAML file, parsed; raises IdentificationError if missing or invalid."""
    text = log.attachments.get(name)
    if text is None:
        raise IdentificationError(f"{log.path}: expected the attachment {name}, found none")
    try:
        return parse_text(text, schema, f"{log.path}: {name}")
    except ConfigError as error:
        raise IdentificationError(str(error)) from None


def _position(log: Log) -> float | None:
    """Return the mean (m) of an imported log's scheduling column; None without one.

    Raises NotARecordError if the column is not a position in m (records are grouped within 1 mm),
    or if the position moves.
    """
    scheduling = attached(log, "signals.yaml", SignalsFile).with_role("scheduling")
    if not scheduling:
        return None
    if len(scheduling) > 1 or scheduling[0].unit != "m":
        found = ", ".join(f"{c.name} in {c.unit}" for c in scheduling)
        raise NotARecordError(
            f"{log.path.name}: expected one column of role scheduling, a position in m, found "
            f"{found}; give an unused column the role other; other scheduling columns serve only "
            "the fit of a declared model (--model)"
        )
    position = log.rows[scheduling[0].name].astype(float)
    _check_one_position(log, scheduling[0].name, position)
    return float(position.mean())


def _check_one_position(log: Log, what: str, position: Array) -> None:
    if np.ptp(position) > BEAM_POSITION_TOLERANCE_M:
        raise NotARecordError(
            f"{log.path.name}: {what}: expected one position, found movement of "
            f"{1e3 * np.ptp(position):.1f} mm"
        )


def _require_cycles(log: Log) -> None:
    present = log.rows.dtype.names or ()
    missing = [name for name in _CYCLE if name not in present]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise IdentificationError(
            f"{log.path}: expected a rig log, found no field {missing[0]}{more}; import "
            "other data by 'levid import FILE --signals SIGNALS.yaml -o LOG.mcap', where "
            "SIGNALS.yaml names inputs and outputs (docs/log-format.md)"
        )
    _require(log, _CYCLE)


def _require(log: Log, names: Sequence[str]) -> None:
    present = log.rows.dtype.names or ()
    missing = [n for n in names if n not in present]
    if missing:
        raise IdentificationError(
            f"{log.path}: expected the fields {', '.join(names)}; {', '.join(missing)} missing"
        )
    for name in names:
        if log.rows[name].ndim != 1:
            raise IdentificationError(
                f"{log.path}: {name}: expected one value a row, found several"
            )
    require_finite(log, names)
    if len(log.rows) < _MIN_ROWS:
        raise NotARecordError(
            f"{log.path}: expected at least {_MIN_ROWS} rows, found {len(log.rows)}"
        )
    require_stated_rate(log)


def require_stated_rate(log: Log) -> None:
    """Raise IdentificationError if the log times contradict rate_hz, or show missing rows.

    Missing rows are an error only in logs whose rows have no number, and in imported logs.
    """
    time_ns, half = log.log_time_ns.astype(np.int64), len(log.rows) // 2
    time_s = 1e-9 * (time_ns - time_ns[0])
    # The second value serves log times that scatter: their median step is not the period.
    steps_s = (
        np.median(np.diff(time_s)),
        np.median(time_s[-half:] - time_s[:half]) / (len(time_s) - half),
    )
    period_s = min(map(float, steps_s), key=lambda step_s: abs(step_s * log.rate_hz - 1.0))
    if abs(period_s * log.rate_hz - 1.0) > _RATE_TOLERANCE:
        raise IdentificationError(
            f"{log.path}: rate_hz: expected the rate of the log times, one row every "
            f"{steps_s[0]:g} s, found {log.rate_hz:g} Hz"
        )
    if "signals.yaml" in log.attachments or "cycle" not in (log.rows.dtype.names or ()):
        _require_no_missing_samples(log, time_s, period_s)


def _require_no_missing_samples(log: Log, time_s: Array, period_s: float) -> None:
    """Raise IdentificationError if the log times show missing samples.

    A late message delays only itself and the few behind it; a missing sample delays all rows after
    it by the same time.
    """
    delay_s = time_s - period_s * np.arange(len(time_s))
    rows = np.flatnonzero(np.diff(delay_s) > 0.5 * period_s) + 1
    if not len(rows):
        return
    median_s, half = median_filter(delay_s, _MEDIAN_ROWS, mode="nearest"), _MEDIAN_ROWS // 2
    after = median_s[np.minimum(rows + half, len(delay_s) - 1)]
    jump_s = after - median_s[np.maximum(rows - 1 - half, 0)]
    missing = np.flatnonzero(jump_s > 0.5 * period_s)
    if len(missing):
        row, step_s = rows[missing[0]], jump_s[missing[0]] + period_s
        raise IdentificationError(
            f"{log.path}: missing samples: expected a row every {period_s:g} s, found "
            f"{step_s:.3g} s before row {row}; split the log there"
        )


def require_finite(log: Log, names: Sequence[str]) -> None:
    """Raise IdentificationError, with file, field, row and record, for values not finite."""
    for name in names:
        values = log.rows[name].astype(float)
        wrong = np.argwhere(~np.isfinite(values))
        if len(wrong):
            row, *column = wrong[0].tolist()
            rows = len(np.unique(wrong[:, 0]))
            more = f" and in {rows - 1} rows after it" if rows > 1 else ""
            raise IdentificationError(
                f"{log.path}: {name}{column or ''}: expected finite values, found "
                f"{values[tuple(wrong[0])]} in row {row}{more} of record "
                f"'{log.metadata.get('name') or log.path.stem}'"
            )


def require_fields(log: Log, names: Sequence[str], use: str) -> None:
    """Raise IdentificationError, with file, `use` and the missing fields, if a field is missing."""
    present = log.rows.dtype.names or ()
    missing = [name for name in names if name not in present]
    if missing:
        raise IdentificationError(
            f"{log.path}: found no field {', '.join(missing)}, which {use} needs "
            "(docs/log-format.md, 'Logs of other rigs')"
        )


def array_field(log: Log, name: str, length: int, what: str) -> Array:
    """Return a field with one value for each coil or sensor (`what`) of rig.yaml, (N, length)."""
    values = log.rows[name].astype(float)
    if values.shape[1:] != (length,):
        raise IdentificationError(
            f"{log.path}: {name}: expected the {length} {what} of rig.yaml, found "
            f"{' x '.join(map(str, values.shape[1:])) or 'one value a row'}"
        )
    return np.asarray(values)


def columns(log: Log, names: Sequence[str]) -> Array:
    """Return fields of a log as columns (N, fields)."""
    return np.stack([log.rows[n].astype(float) for n in names], axis=1)
