"""Records from logs: which fields are excitation, input and output, and what happened meanwhile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from ...config.base import ConfigError, parse_text
from ...config.model import ModelConfig, load_model
from ...config.rig import RigConfig
from ...config.shipped import shipped
from ...log.reader import Log
from ...log.signals_file import SignalsFile
from ...model.geometry import shape_matrix
from .record import SAME_BEAM_M, IdentificationError, NotARecordError, PiController, Record
from .resampling import without_gaps

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


_SHORTEST_ROWS = 50
_AROUND = 25
"""Rows of each side of a step in the log times that say whether it stays."""
_SAME_RATE = 0.01
"""Share by which the rate of a log may differ from its log times: clocks of others drift."""


def from_log(log: Log) -> Record:
    """Return the record that a log holds: of the rig's cycles, or of imported signals.

    Raises NotARecordError for a log that belongs to another step of a session, excites nothing or
    has no operating point, IdentificationError (with file and field) for one that lacks what
    identification needs.
    """
    kind = log.metadata.get("kind")
    if kind == "import" or "signals.yaml" in log.attachments:
        return replace(imported_record(log), beam_m=_position(log))
    if kind is None:
        _require_cycles(log)
    if kind != "record":
        raise NotARecordError(
            f"{log.path.name}: kind '{kind or 'none'}', only records are identified"
        )
    return _from_cycles(log)


def records_from_logs(logs: Sequence[Log]) -> tuple[tuple[Record, ...], tuple[str, ...]]:
    """Return the records among the logs, and a reason for each log that is none."""
    records, skipped = [], []
    for log in logs:
        try:
            records.append(from_log(log))
        except NotARecordError as reason:
            skipped.append(str(reason))
    return tuple(records), tuple(skipped)


def _from_cycles(log: Log) -> Record:
    _require_cycles(log)
    log, gaps = without_gaps(log)
    v = columns(log, EXCITATION)
    beam = log.rows["beam_m"].astype(float)
    if not np.any(v):
        raise NotARecordError(f"{log.path.name}: no wrench excitation in it")
    _check_still(log, "the beam", beam)
    asked, sent, told = _inputs(log)
    return Record(
        name=log.metadata.get("name") or log.path.stem,
        Ts_s=1.0 / log.rate_hz,
        v=v,
        u=sent,
        asked=asked,
        y=columns(log, POSE),
        input_names=DOF,
        input_units=INPUT_UNITS,
        output_names=DOF,
        output_units=OUTPUT_UNITS,
        beam_m=float(beam.mean()),
        controller=controller_of(log),
        delay_cycles=1,  # a force computed in cycle k acts from cycle k + 1 on, on every backend
        at_rest=False,  # the platform may still ring from the record before
        remarks=(*remarks_of(log), *told, *gaps),
    )


def _inputs(log: Log) -> tuple[Array, Array, tuple[str, ...]]:
    """Return the wrench that was asked for and the one sent (N, 3), less feed-forward; remarks.

    Sent is what the coils were told behind all limits, with what excites single coils.
    """
    feed_forward = columns(log, FEED_FORWARD)
    asked = columns(log, _WRENCH) - feed_forward
    if _COILS not in (log.rows.dtype.names or ()):
        remark = f"without {_COILS}: coils are taken to have got what was asked for, at no limit"
        return asked, asked, (remark,)
    require_finite(log, [_COILS])
    coils, geometry = log.field(_COILS).astype(float), rig_of(log).geometry
    S = shape_matrix(geometry.coil_x_m, geometry.coil_y_m)
    if coils.shape[1:] != (len(S),):
        raise IdentificationError(
            f"{log.path}: {_COILS}: expected the {len(S)} coils of rig.yaml, found "
            f"{' x '.join(map(str, coils.shape[1:])) or 'one value a row'}"
        )
    return asked, coils @ S - feed_forward, ()


def controller_of(log: Log) -> PiController:
    """Return the controller that rig.yaml at the head of the log names; IdentificationError."""
    control = rig_of(log).control
    return PiController(np.array(control.kp), np.array(control.ki))


def rig_of(log: Log) -> RigConfig:
    """Return the rig.yaml at the head of the log; raises IdentificationError without one."""
    text = log.attachments.get("rig.yaml")
    if text is None:
        raise IdentificationError(f"{log.path}: expected the attachment rig.yaml, found none")
    try:
        return parse_text(text, RigConfig, f"{log.path}: rig.yaml")
    except ConfigError as error:
        raise IdentificationError(str(error)) from None


def rig_model(log: Log) -> ModelConfig | None:
    """Return the declared model of the rig that flew the log; None for a log that no rig flew.

    It is the attachment model.yaml; the shipped models/rig.yaml for a rig that names no model.
    Raises IdentificationError for an attachment that is not a model.
    """
    if "rig.yaml" not in log.attachments:
        return None
    text = log.attachments.get("model.yaml")
    try:
        if text is None:
            return load_model(shipped("models/rig.yaml"))
        return parse_text(text, ModelConfig, f"{log.path}: model.yaml")
    except ConfigError as error:
        raise IdentificationError(str(error)) from None


def remarks_of(log: Log) -> list[str]:
    """Return in words what happened in a log of the rig that a linear model does not know of."""
    found = []
    if np.any(columns(log, REFERENCE)):
        found.append("references are not zero; only their constant part does no harm")
    at_limit = cycles_at_limit(log)
    if at_limit:
        found.append(f"{at_limit} cycles with coils at a limit")
    names = log.rows.dtype.names or ()
    if "coil_excitation_n" in names and np.any(log.rows["coil_excitation_n"]):
        found.append("coils were excited one by one besides, which counts as noise here")
    return [*found, *cut_off(log)]


def cycles_at_limit(log: Log) -> int:
    """Return in how many cycles a coil was at a limit."""
    if "saturated" not in (log.rows.dtype.names or ()):
        return 0
    return int(np.count_nonzero(log.rows["saturated"]))


def cut_off(log: Log) -> list[str]:
    """Return in words that a log has no end; nothing if it has one."""
    if log.complete:
        return []
    return [f"the log is not complete ({log.problem}); what is left of it is used"]


def imported_record(log: Log) -> Record:
    """Return the inputs and outputs of an imported log, without its operating point.

    Raises IdentificationError for a signals.yaml or columns that do not do.
    """
    signals = _signals(log)
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
        remarks=tuple(cut_off(log)),
    )


def _signals(log: Log) -> SignalsFile:
    text = log.attachments.get("signals.yaml")
    if text is None:
        raise IdentificationError(f"{log.path}: expected the attachment signals.yaml, found none")
    try:
        return parse_text(text, SignalsFile, f"{log.path}: signals.yaml")
    except ConfigError as error:
        raise IdentificationError(str(error)) from None


def _position(log: Log) -> float | None:
    """Return the mean (m) of the scheduling column of an imported log, None without one.

    Raises NotARecordError for columns that are no position (grouped within 1 mm as one, and named
    so, a temperature would only mislead) and for one that moves.
    """
    scheduling = _signals(log).with_role("scheduling")
    if not scheduling:
        return None
    if len(scheduling) > 1 or scheduling[0].unit != "m":
        found = ", ".join(f"{c.name} in {c.unit}" for c in scheduling)
        raise NotARecordError(
            f"{log.path.name}: expected one column of role scheduling, a position in m, that tells "
            f"the operating point, found {found}; only the fit of a declared model (--model) takes "
            "others, and a column that plays no part has the role other"
        )
    position = log.rows[scheduling[0].name].astype(float)
    _check_still(log, scheduling[0].name, position)
    return float(position.mean())


def _check_still(log: Log, what: str, position: Array) -> None:
    if np.ptp(position) > SAME_BEAM_M:
        raise NotARecordError(
            f"{log.path.name}: {what} moves by {1e3 * np.ptp(position):.1f} mm; a response is "
            "identified at one position"
        )


def _require_cycles(log: Log) -> None:
    present = log.rows.dtype.names or ()
    missing = [name for name in _CYCLE if name not in present]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise IdentificationError(
            f"{log.path}: no log of the rig, it lacks {missing[0]}{more} of its fields; bring "
            "other data in by 'levid import FILE --signals SIGNALS.yaml -o LOG.mcap', which says "
            "what is input and output (docs/log-format.md)"
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
    if len(log.rows) < _SHORTEST_ROWS:
        raise NotARecordError(
            f"{log.path}: expected at least {_SHORTEST_ROWS} rows, found {len(log.rows)}"
        )
    time_ns, half = log.log_time_ns.astype(np.int64), len(log.rows) // 2
    time_s = 1e-9 * (time_ns - time_ns[0])
    # The second is that of times that scatter: the usual step of those, sorted, is none.
    steps_s = (
        np.median(np.diff(time_s)),
        np.median(time_s[-half:] - time_s[:half]) / (len(time_s) - half),
    )
    period_s = min(map(float, steps_s), key=lambda step_s: abs(step_s * log.rate_hz - 1.0))
    if abs(period_s * log.rate_hz - 1.0) > _SAME_RATE:
        raise IdentificationError(
            f"{log.path}: rate_hz: expected what the log times say, a row every {steps_s[0]:g} s, "
            f"found {log.rate_hz:g} Hz"
        )
    if "signals.yaml" in log.attachments or "cycle" not in present:
        _require_even(log, time_s, period_s)


def _require_even(log: Log, time_s: Array, period_s: float) -> None:
    """Raise IdentificationError where samples are missing, by the log times: nothing else tells.

    A message that came late, and those behind it in a bunch, is none that is missing: after one
    that is, all are late by as much.
    """
    late = time_s - period_s * np.arange(len(time_s))
    rows = np.flatnonzero(np.diff(late) > 0.5 * period_s) + 1
    if not len(rows):
        return
    usual, half = median_filter(late, _AROUND, mode="nearest"), _AROUND // 2
    after = usual[np.minimum(rows + half, len(late) - 1)]
    stays_s = after - usual[np.maximum(rows - 1 - half, 0)]
    lost = np.flatnonzero(stays_s > 0.5 * period_s)
    if len(lost):
        row, gap_s = rows[lost[0]], stays_s[lost[0]] + period_s
        raise IdentificationError(
            f"{log.path}: expected a row every {period_s:g} s, found {gap_s:.3g} s before row "
            f"{row}: samples are missing, which nothing fills in; cut the log there"
        )


def require_finite(log: Log, names: Sequence[str]) -> None:
    """Raise IdentificationError for values that are none, with file, field, row and record."""
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


def columns(log: Log, names: Sequence[str]) -> Array:
    """Return fields of a log side by side (N, fields)."""
    return np.stack([log.rows[n].astype(float) for n in names], axis=1)
