"""Read a record for a trace: single sensors and coils, beam and rotor motion, drive force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....config.base import parse_text
from ....config.model import ModelConfig
from ....config.rig import Geometry, RigConfig
from ....log.reader import Log
from ....model.effects.base import Places
from ....model.effects.force_units import force_units
from ....model.geometry import shape_matrix
from ....model.relative_motion import joints
from ...greybox.declared_model_from_config import declared_model
from ...greybox.experiment.experiment_from_log import (
    Experiment,
    coil_excitation,
    experiment_from_log,
)
from ...greybox.prediction.noise_model import Filter
from ...records.from_log import (
    array_field,
    cycles_at_limit,
    require_fields,
    truncation_remarks,
)
from ...records.resampling import resample
from ...rounding import ROUNDING
from ..search_options import SearchOptions
from .sensor_white_noise import white_noise
from .stuck_sensors import stuck_rows

Array = NDArray[np.float64]

_REQUIRED = ("time_s", "gap_m", "beam_m", "beam_m_s")
"""Fields that a rig log needs for a trace, in addition to those for a fit."""
_ROTOR = ("rotor_rad", "rotor_rad_s")
_MOTION = ("position", "speed", "acceleration")
"""Columns of what comes from a drive."""
_WITHOUT = {
    ("coil_excitation_n",): "excitation of single coils is assumed to be zero",
    ("beam_force_n",): "friction and cogging of the beam's drives cannot be found",
    _ROTOR: "the rotor is assumed to rest",
}
"""Fields that a rig log may lack, and what the trace assumes without them."""
_SILENT = ROUNDING
_MOST_PARTS = 2
"""Parts of a record that are kept."""
IMPORTED = "imported"
"""Kind of a record from other data than the rig's."""
SHORTEST_S = 1.0
"""Least duration of a record, or of a held-out part."""
_HELD = SearchOptions.reported
"""Least held-out share of a kind's time; otherwise its longest record is cut too."""


@dataclass(frozen=True)
class TraceRecord:
    """An experiment with the signals of single sensors, coils and drives.

    gap (N, S): as measured; coil, coil_excitation (N, C): commanded; beam and rotor (N, 3):
    position, velocity, acceleration (zeros without them); drive_n (N,): force of the beam's drives;
    time_s (N,): session time. `kind` names what moves; records of one kind are exchangeable.
    stuck (N, S): stuck readings; None without any. `remarks` describe events in the record.
    """

    experiment: Experiment
    places: Places
    time_s: Array
    gap: Array
    coil: Array
    coil_excitation: Array
    beam: Array
    rotor: Array
    drive_n: Array | None
    kind: str
    stuck: NDArray[np.bool_] | None = None
    remarks: tuple[str, ...] = ()
    filters: dict[bytes, Filter] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    """Cached filters along a moving schedule, by noise: computing them is slow."""
    prepared: dict[bytes, Any] = field(default_factory=dict, init=False, repr=False, compare=False)
    """What linearise prepared for its last points, which it is often asked of again."""
    parts: dict[tuple[int, int], TraceRecord] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    """The parts that were asked about last, with what is prepared of them."""

    @property
    def name(self) -> str:
        """Name of the record."""
        return self.experiment.name

    @property
    def still(self) -> bool:
        """Whether the record has neither excitation nor motion."""
        return self.kind == "still"

    @property
    def rows(self) -> int:
        """Number of rows, N."""
        return len(self.time_s)

    def part(self, start: int, stop: int) -> TraceRecord:
        """Return the same as `cut`, and keep the result for the next time."""
        rows = start, stop
        if rows not in self.parts:
            if len(self.parts) >= _MOST_PARTS:
                self.parts.clear()
            self.parts[rows] = self.cut(start, stop)
        return self.parts[rows]

    def cut(self, start: int, stop: int) -> TraceRecord:
        """Return rows start to stop (exclusive)."""
        if (start, stop) == (0, self.rows):
            return self
        rows = slice(start, stop)
        return replace(
            self,
            experiment=self.experiment.rows(start, stop),
            time_s=self.time_s[rows],
            gap=self.gap[rows],
            coil=self.coil[rows],
            coil_excitation=self.coil_excitation[rows],
            beam=self.beam[rows],
            rotor=self.rotor[rows],
            drive_n=None if self.drive_n is None else self.drive_n[rows],
            stuck=None if self.stuck is None else self.stuck[rows],
        )


def trace_record(log: Log, model: ModelConfig) -> TraceRecord:
    """Return the record of a log; raises as experiment_from_log does."""
    experiment = experiment_from_log(log, model)
    remarks = tuple(truncation_remarks(log))
    log, resampling_remarks = resample(log)
    if "signals.yaml" in log.attachments:
        remarks = (*experiment.contradictions, *experiment.remarks)
        time_s = log.field("time_s").astype(float)
        return replace(imported_trace_record(experiment, model), time_s=time_s, remarks=remarks)
    at_limit = cycles_at_limit(log)
    if at_limit:
        remarks += (
            f"{at_limit} of {len(log.rows)} cycles with saturated coils, which the free-run "
            "simulation does not include: the error there counts as the model's",
        )
    names = log.rows.dtype.names or ()
    require_fields(log, _REQUIRED, "a trace")
    for fields, assumed in _WITHOUT.items():
        if missing := [name for name in fields if name not in names]:
            remarks += (f"no field {' and '.join(missing)}: {assumed}",)
    geometry = parse_text(log.attachments["rig.yaml"], RigConfig, "rig.yaml").geometry
    places = rig_places(geometry, model)
    gap = array_field(log, "gap_m", places.sensors, "sensors")
    rotor = np.zeros((len(gap), len(_MOTION)))
    if set(_ROTOR) <= set(names):
        rotor = _motion(log, ("rotor", "rad"), experiment.Ts_s)
    record = TraceRecord(
        experiment,
        places,
        log.field("time_s").astype(float),
        gap,
        array_field(log, "coil_n", places.coils, "coils"),
        coil_excitation(log, places.coils),
        _motion(log, ("beam", "m"), experiment.Ts_s),
        rotor,
        log.field("beam_force_n").astype(float) if "beam_force_n" in names else None,
        "",
        stuck_rows(gap, places.sensor_shape),
        (*remarks, *resampling_remarks),
    )
    return replace(record, kind=_kind(record))


def rig_places(geometry: Geometry, model: ModelConfig) -> Places:
    """Return how a rig's coils and sensors act on the DOF of its model."""
    return Places(
        tuple(q.name for q in model.dof),
        tuple(q.unit for q in model.dof),
        shape_matrix(geometry.coil_x_m, geometry.coil_y_m),
        shape_matrix(geometry.sensors_x_m, geometry.sensors_y_m),
        "N",
        tuple(q.unit for q in model.inputs),
        "m",
        np.stack([geometry.coil_x_m, geometry.coil_y_m], axis=1),
        np.stack([geometry.sensors_x_m, geometry.sensors_y_m], axis=1),
        beam=True,
    )


def imported_places(model: ModelConfig) -> Places:
    """Return the places of imported data: one actuator for each input, one sensor for each DOF."""
    units = tuple(q.unit for q in model.dof)
    forces = force_units(
        model.B,
        [q.unit for q in model.inputs],
        {name: p.unit for name, p in model.parameters.items()},
        model.M,
        units,
    )
    return Places(
        tuple(q.name for q in model.dof),
        units,
        np.eye(len(model.inputs)),
        np.eye(len(model.dof)),
        model.inputs[0].unit,
        tuple(q.unit for q in model.inputs),
        model.dof[0].unit,
        np.zeros((0, 2)),
        np.zeros((0, 2)),
        beam=False,
        input_names=tuple(q.name for q in model.inputs),
        force_units=forces,
        input_motion=_input_motion(model),
        joints=joints(declared_model(model), units, forces),
    )


def _input_motion(model: ModelConfig) -> Array:
    """Return the motion of each input along its force (m, n), 1 at the DOF that it pushes most."""
    pushed = declared_model(model).at().B.T
    most = pushed[np.arange(len(pushed)), np.argmax(np.abs(pushed), axis=1)]
    return np.asarray(pushed / np.where(most == 0.0, 1.0, most)[:, None])


def split(records: Sequence[TraceRecord]) -> tuple[list[TraceRecord], list[TraceRecord]]:
    """Return the training records and the held-out ones, a quarter of every kind or more.

    Of each kind, the second, sixth, ... record is held out. If the held-out time is less than a
    quarter, the longest other record is cut, and its end is held out.
    """
    by_kind: dict[str, list[TraceRecord]] = {}
    for record in records:
        by_kind.setdefault(record.kind, []).append(record)
    every = round(1.0 / _HELD)
    out: set[int] = set()
    cut: set[int] = set()
    for group in by_kind.values():
        whole = [r for i, r in enumerate(group) if i % every == 1]
        out.update(id(r) for r in whole)
        if _seconds(whole) < _HELD * _seconds(group):
            cut.add(id(max((r for r in group if id(r) not in out), key=_length)))
    train: list[TraceRecord] = []
    held: list[TraceRecord] = []
    for record in records:
        at = round((1.0 - _HELD) * record.rows)
        if id(record) in out:
            held.append(record)
        elif id(record) in cut and (record.rows - at) * record.experiment.Ts_s >= SHORTEST_S:
            train.append(record.cut(0, at))
            held.append(record.cut(at, record.rows))
        else:
            train.append(record)
    return train, held


def _length(record: TraceRecord) -> float:
    return record.rows * record.experiment.Ts_s


def _seconds(records: Sequence[TraceRecord]) -> float:
    return sum(_length(r) for r in records)


def imported_trace_record(experiment: Experiment, model: ModelConfig) -> TraceRecord:
    """Return the record of an imported experiment, without a beam."""
    p = experiment.u.shape[1]
    places = imported_places(model)
    N = len(experiment.y)
    no_motion = np.zeros((N, len(_MOTION)))
    return TraceRecord(
        experiment, places, np.asarray(np.arange(N) * experiment.Ts_s), experiment.y, experiment.u,
        np.zeros((N, p)), no_motion, no_motion, None, IMPORTED,
    )  # fmt: skip


def _motion(log: Log, axis: tuple[str, str], Ts_s: float) -> Array:
    """Return position, velocity and its central difference (N, 3) of the beam or the rotor."""
    name, unit = axis
    position = log.field(f"{name}_{unit}").astype(float)
    velocity = log.field(f"{name}_{unit}_s").astype(float)
    return np.stack([position, velocity, np.gradient(velocity, Ts_s)], axis=1)


def _kind(record: TraceRecord) -> str:
    """Return the name of a record's kind: what is excited and what moves."""
    e = record.experiment
    v = e.loop.v if e.loop is not None else e.u
    parts = []
    if np.any(np.abs(record.coil_excitation) > _SILENT):
        parts.append("coils")
    elif np.any(np.abs(v) > _SILENT):
        parts.append("wrench")
    if _moves(record.beam[:, 0]):
        parts.append("beam")
    if _moves(record.rotor[:, 0]):
        parts.append("rotor")
    return "+".join(parts) or "still"


def _moves(position: Array) -> bool:
    """Return whether a position (N,) varies by more than its white noise, or an encoder's step.

    A drive at rest hunts by one step of its encoder, to either side.
    """
    noise = float(white_noise(position[:, None] - position[0])[0])
    changes = np.abs(np.diff(position))
    step = float(np.min(changes, where=changes > 0.0, initial=np.inf))
    chance = 2.0 * SearchOptions.chance(len(position)) * noise
    return bool(np.any(changes) and np.ptp(position) > max(chance, 2.5 * step))
