"""Test records that a trace cannot use: they are rejected or left out with a reason."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from effect_test_helpers import rig_places
from in_memory_log import cycle_log
from mass_on_spring_logs import MASS as CONFIG
from mass_on_spring_logs import SIGNALS, imported

from levid.config.base import parse_text
from levid.config.model import ModelConfig, load_model
from levid.config.shipped import shipped
from levid.identification.records.record import IdentificationError
from levid.identification.trace.records.check_common_session_time import (
    overlap,
    require_timeless,
    timeless,
)
from levid.identification.trace.records.read_records import read_records, require_live
from levid.identification.trace.records.record_from_log import TraceRecord, split, trace_record
from levid.identification.trace.records.sensor_and_amplifier_noise import require_noise
from levid.identification.trace.run_trace import Trace, trace
from levid.identification.trace.worker_pool import Alone
from levid.log.reader import read_log
from levid.log.signals import cycle_dtype
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.freeform import freeform_effects
from levid.model.effects.operating_range import Extent

NOISE_M = 2e-7


def settled_response(seed: int, seconds: float, noise_m: float) -> np.ndarray:
    """Return a multisine force and the steady-state position of the mass (N, 2)."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(250 * seconds)) / 250
    omega, phase = 2 * np.pi * rng.uniform(0.5, 15.0, 10), rng.uniform(0, 2 * np.pi, 10)
    wave = np.exp(1j * (omega * t[:, None] + phase))
    force, x = (w.sum(axis=1).real for w in (wave, wave / (800.0 + 12j * omega - 2.0 * omega**2)))
    return np.stack([force, x + rng.normal(0.0, noise_m, len(t))], axis=1)


def logs(folder: Path, tables: Sequence[np.ndarray]) -> list[Path]:
    return [imported(folder, f"made-{i}", table) for i, table in enumerate(tables)]


def traced(paths: Sequence[Path]) -> Trace:
    return trace(paths, CONFIG, all_effects, Alone(CONFIG), lambda *_: None)


def test_too_little_data_are_rejected_with_the_required_length(tmp_path: Path) -> None:
    # Three records of one block each remain for the fit: too few for four-fold cross-validation.
    short = [settled_response(i, 3.0, NOISE_M) for i in range(4)]
    with pytest.raises(IdentificationError, match=r"at least 16 s .* found 9 s in 3 records"):
        traced(logs(tmp_path, short))


def test_unknown_controller_is_refused_where_the_loop_is_simulated(tmp_path: Path) -> None:
    columns = SIGNALS + "loop: {controller: unknown}\n"
    log = imported(tmp_path, "loop", settled_response(1, 60.0, NOISE_M), columns)
    with pytest.raises(IdentificationError, match=r"record 'loop': loop: .* found 'unknown'"):
        traced([log])


def test_records_without_noise_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(IdentificationError, match="expected readings with sensor noise"):
        traced(logs(tmp_path, [settled_response(i, 16.0, 0.0) for i in range(2)]))


def test_record_with_a_frozen_output_is_left_out_with_its_name(tmp_path: Path) -> None:
    tables = [settled_response(i, 4.0, NOISE_M) for i in range(3)]
    tables[1][:, 1] = 1e-4
    paths = logs(tmp_path, tables)
    records, notes = read_records(paths, CONFIG)
    assert [path.name for path in records] == ["made-0.mcap", "made-2.mcap"]
    assert notes == ("made-1.mcap: left out: x_m is frozen at 0.0001 m in every row",)
    with pytest.raises(IdentificationError, match=r"found none: made-1.mcap: left out: x_m"):
        read_records(paths[1:2], CONFIG)


def test_frozen_sensor_of_nine_is_reported_by_its_number(tmp_path: Path) -> None:
    (path,) = logs(tmp_path, [settled_response(0, 4.0, NOISE_M)])
    made = trace_record(read_log(path), CONFIG)
    gap = np.random.default_rng(1).standard_normal((made.rows, 9))
    gap[:, 5] = -2e-4
    places = replace(made.places, sensor_shape=rig_places().sensor_shape)
    with pytest.raises(IdentificationError, match=r"sensor:5 is frozen at -0.0002 m"):
        require_live(replace(made, places=places, gap=gap, kind="coils"), path)


def test_nan_is_reported_with_record_and_row(tmp_path: Path) -> None:
    (path,) = logs(tmp_path, [settled_response(0, 4.0, NOISE_M)])
    log = read_log(path)
    rows = log.rows.copy()
    rows["x_m"][[700, 702]] = np.nan
    with pytest.raises(
        IdentificationError,
        match=r"made-0.mcap: x_m: .* nan in row 700 and in 1 rows after it of record 'made-0'",
    ):
        trace_record(replace(log, rows=rows), CONFIG)


def later(record: TraceRecord, by_s: float) -> TraceRecord:
    return replace(record, time_s=record.time_s + by_s)


def test_overlapping_records_are_reported(tmp_path: Path) -> None:
    made = [
        trace_record(read_log(path), CONFIG)
        for path in logs(tmp_path, [settled_response(i, 4.0, NOISE_M) for i in range(2)])
    ]
    assert overlap(made) == "made-0 0 to 3.996 s and made-1 0 to 3.996 s"
    assert overlap([made[0], later(made[1], 4.0)]) == ""
    assert overlap([later(made[0], 4.0), made[1]]) == ""


def test_effects_that_depend_on_session_time_are_separated() -> None:
    places = rig_places((100.0, 160.0))
    covered = Extent.typical(places)
    kept, timed = timeless(all_effects(places, covered), places, covered)
    # A payload has a time of attachment, a drift grows with time, a tone has a phase.
    others = {e.key for e in timed if not e.key.startswith(("vibration.", "thermal_drift"))}
    assert others == {
        "payload", "force_offset.drift", "sensor_offset.drift", "sensor_offset.warm_up",
    }  # fmt: skip
    assert {"vibration", "thermal_drift"} <= {e.effect_class for e in timed}
    assert len(kept) + len(timed) == len(all_effects(places, covered))
    assert {"rod_stiffness", "friction", "coil_gain"} <= {e.effect_class for e in kept}
    _, timed_forms = timeless(freeform_effects(places, covered), places, covered)
    assert timed_forms

    payload = next(e for e in timed if e.effect_class == "payload")
    placed = [Placed(payload, payload.grid[0], (0.1,))]
    with pytest.raises(
        IdentificationError, match=r"'Payload at .*' depends on session time.*found a and b"
    ):
        require_timeless(placed, places, covered, "a and b")


def test_log_given_twice_or_copied_is_used_once(tmp_path: Path) -> None:
    first, second = logs(tmp_path, [settled_response(i, 4.0, NOISE_M) for i in range(2)])
    copy, link = tmp_path / "copy.mcap", tmp_path / "link.mcap"
    copy.write_bytes(first.read_bytes())
    link.symlink_to(second)
    records, notes = read_records([first, copy, second, link], CONFIG)
    assert list(records) == [first, second]
    assert notes == (
        f"{copy}: the same record as {first}, used once",
        f"{link}: given twice, used once",
    )


def test_record_below_one_second_is_left_out_with_its_name(tmp_path: Path) -> None:
    paths = logs(tmp_path, [settled_response(0, 4.0, NOISE_M), settled_response(1, 0.5, NOISE_M)])
    records, notes = read_records(paths, CONFIG)
    assert list(records) == paths[:1]
    assert notes == ("made-1.mcap: left out: expected at least 1 s, found 0.5 s",)


def test_truncated_log_gives_a_note(tmp_path: Path) -> None:
    (path,) = logs(tmp_path, [settled_response(0, 8.0, NOISE_M)])
    path.write_bytes(path.read_bytes()[:-2000])
    _, (note,) = read_records([path], CONFIG)
    assert note.startswith("made-0: the log is truncated (")


@pytest.mark.parametrize(
    ("seconds", "fitted_s", "held_s"),
    [
        ((16.0, 16.0), [16.0], [16.0]),
        # 2 s are too short for a test: the end of the long record is held out as well.
        ((20.0, 2.0), [15.0], [5.0, 2.0]),
        ((2.0, 20.0), [2.0], [20.0]),
        ((20.0,), [15.0], [5.0]),
        ((2.0,), [2.0], []),
    ],
)
def test_held_out_data_are_a_share_of_the_total_time(
    tmp_path: Path, seconds: tuple[float, ...], fitted_s: list[float], held_s: list[float]
) -> None:
    paths = logs(tmp_path, [settled_response(i, s, NOISE_M) for i, s in enumerate(seconds)])
    records, _ = read_records(paths, CONFIG)
    parts = split(list(records.values()))
    durations_s = [[round(r.rows * r.experiment.Ts_s, 6) for r in part] for part in parts]
    assert durations_s == [fitted_s, held_s]


TWO = """
levid: model
name: two masses
dof: [{name: x_m, unit: m}, {name: phi_rad, unit: UNIT}]
inputs: [{name: f_n, unit: N}, {name: g_n, unit: N}]
input: band_limited
parameters:
  m: {value: 2.0, unit: kg, min: 0.1, max: 20}
M: [[m, 0.0], [0.0, 2.0]]
D: [[12.0, 0.0], [0.0, 12.0]]
K: [[800.0, 0.0], [0.0, 800.0]]
"""


TWO_SIGNALS = """
levid: signals
rate_hz: 250
input_hold: band_limited
columns:
  - {column: 0, name: f_n, unit: N, role: input}
  - {column: 1, name: g_n, unit: N, role: input}
  - {column: 2, name: x_m, unit: m, role: output}
  - {column: 3, name: phi_rad, unit: UNIT, role: output}
"""


@pytest.mark.parametrize(
    ("unit", "noise_ratio", "accepted"), [("m", 1, 1), ("m", 20, 0), ("rad", 1, 0)]
)
def test_outputs_of_different_units_or_noise_are_rejected(
    tmp_path: Path, unit: str, noise_ratio: float, accepted: bool
) -> None:
    one, other = settled_response(0, 4.0, NOISE_M), settled_response(1, 4.0, noise_ratio * NOISE_M)
    rows = np.stack([one[:, 0], other[:, 0], one[:, 1], other[:, 1]], axis=1)
    path = imported(tmp_path, "two", rows, TWO_SIGNALS.replace("UNIT", unit))
    config = parse_text(TWO.replace("UNIT", unit), ModelConfig, "two")
    record = trace_record(read_log(path), config)
    if accepted:
        require_noise([record])
        return
    with pytest.raises(IdentificationError, match=r"in one unit and with similar noise.*x_m"):
        require_noise([record])


def test_a_rig_with_as_many_sensors_as_dof_has_readings_of_one_kind() -> None:
    """Its pose is in rad and m, but its sensors all read m."""
    rng, n = np.random.default_rng(1), 4000
    rows = np.zeros(n, cycle_dtype(3, 3))
    rows["cycle"], rows["time_s"] = np.arange(n), 1e-3 * np.arange(n)
    rows["gap_m"] = rng.normal(0.0, 1e-7, (n, 3))
    rows["coil_n"] = rng.normal(20.0, 0.1, (n, 3))
    text = shipped("rigs/loopback.yaml").read_text()
    x, y = [0.1, -0.05, -0.05], [0.0, 0.0866, -0.0866]
    text = re.sub(r"coil_x_m: .*", f"coil_x_m: {x}", text)
    text = re.sub(r"coil_y_m: .*", f"coil_y_m: {y}", text)
    log = cycle_log("01-still.mcap", rows, attachments={"rig.yaml": text.encode()})
    record = trace_record(log, load_model(shipped("models/rig.yaml")))
    assert record.places.sensors == len(record.places.dof) == 3
    require_noise([record])
