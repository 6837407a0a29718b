"""Test records from logs and operating points: fields, remarks, skipped logs and errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from in_memory_log import cycle_log

from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import experiment_from_log
from levid.identification.identify import identify
from levid.identification.options import Options
from levid.identification.records.from_log import from_log, records_from_logs
from levid.identification.records.record import (
    IdentificationError,
    NotARecordError,
    PiController,
    Record,
    by_position,
    operating_points,
)
from levid.log.reader import Log
from levid.log.signals import cycle_dtype
from levid.model.geometry import decoupling_matrix

COILS_XY_M = 0.12 * np.repeat([1.0, 0.0, -1.0], 3), 0.12 * np.tile([1.0, 0.0, -1.0], 3)
NAMES = ("psi", "theta", "z")
SIGNALS_YAML = b"""levid: signals
rate_hz: 50
columns:
  - {column: 0, name: force, unit: N, role: input}
  - {column: 1, name: position, unit: m, role: output}
"""


def _cycles(n: int = 200) -> np.ndarray:
    rows = np.zeros(n, cycle_dtype(9, 9))
    rows["cycle"] = 5000 + np.arange(n)
    rows["v_theta_n_m"] = np.random.default_rng(0).normal(size=n)
    rows["tau_theta_n_m"] = rows["v_theta_n_m"] + 0.5
    rows["ff_theta_n_m"] = 0.5
    rows["coil_n"] = np.outer(rows["tau_theta_n_m"], decoupling_matrix(*COILS_XY_M)[1])
    rows["theta_rad"] = 1e-4
    rows["beam_m"] = 0.05
    return rows


def _log(rows: np.ndarray, **changes: object) -> Log:
    return cycle_log("03-left-theta.mcap", rows, **changes)


def test_record_has_the_signals_and_controller_of_the_log():
    record = from_log(_log(_cycles()))
    rows = _cycles()
    assert record.name == "left-theta"
    assert record.Ts_s == 1e-3
    np.testing.assert_array_equal(record.v[:, 1], rows["v_theta_n_m"].astype(float))
    # Feed-forward is not part of v - C y; it is subtracted, with float32 rounding.
    assert record.u is not None
    np.testing.assert_allclose(record.u, record.v, atol=1e-6)
    np.testing.assert_array_equal(record.y[:, 1], rows["theta_rad"].astype(float))
    assert record.beam_m == pytest.approx(0.05)
    assert record.controller is not None
    np.testing.assert_array_equal(record.controller.kp, [20.0, 20.0, 500.0])
    np.testing.assert_array_equal(record.controller.ki, [200.0, 200.0, 3000.0])
    assert record.leading_zeros == 2  # the hold, and one cycle of delay
    assert record.remarks == ()


@pytest.mark.parametrize("kind", ["levitate", "move", "land", ""])
def test_other_steps_of_a_session_are_skipped_with_a_reason(kind):
    log = _log(_cycles(), metadata={"kind": kind, "name": "x"})
    with pytest.raises(NotARecordError, match="not a record of the session"):
        from_log(log)
    records, skipped = records_from_logs([_log(_cycles()), log])
    assert len(records) == 1
    assert len(skipped) == 1
    assert "03-left-theta.mcap" in skipped[0]


def test_records_without_excitation_or_with_a_moving_beam_are_skipped():
    still, moving = _cycles(), _cycles()
    still["v_theta_n_m"] = 0.0
    moving["beam_m"] = np.linspace(0.0, 0.05, len(moving))
    with pytest.raises(NotARecordError, match="no wrench excitation"):
        from_log(_log(still))
    with pytest.raises(NotARecordError, match=r"found movement of 50\.0 mm"):
        from_log(_log(moving))


def test_saturation_faults_references_and_truncation_give_remarks():
    rows = _cycles()
    rows["saturated"][5:8] = 2
    rows["fault"][150:] = 3
    rows["z_ref_m"] = 1e-5
    rows["coil_excitation_n"][:, 4] = 0.1
    text = "; ".join(from_log(_log(rows, complete=False, problem="cut off at byte 9000")).remarks)
    for part in ("references", "3 cycles with saturated coils", "50 rows from a fault on"):
        assert part in text
    assert "single coils" in text
    assert "cut off" in text


def test_rows_after_a_fault_are_left_out():
    rows = _cycles()
    rows["fault"][150:] = 3
    rows["theta_rad"][150:] = 1e-2
    assert len(from_log(_log(rows)).y) == 150
    assert from_log(_log(rows)).y.max() == pytest.approx(1e-4)
    rows["fault"][20:] = 3
    with pytest.raises(NotARecordError, match="before a fault, found 20"):
        from_log(_log(rows))


def test_log_with_missing_or_invalid_contents_is_rejected():
    with pytest.raises(IdentificationError, match=r"expected the attachment rig\.yaml"):
        from_log(_log(_cycles(), attachments={}))
    with pytest.raises(IdentificationError, match=r"rig\.yaml"):
        from_log(_log(_cycles(), attachments={"rig.yaml": b"levid: rig\n"}))
    fewer = _cycles()[["cycle", "time_s", "v_psi_n_m"]]
    with pytest.raises(IdentificationError, match="no field v_theta_n_m and 14 more"):
        from_log(_log(fewer))
    with pytest.raises(IdentificationError, match=r"levid import FILE --signals .*log-format\.md"):
        from_log(_log(fewer, metadata={}))
    broken = _cycles()
    broken["theta_rad"][3] = np.nan
    with pytest.raises(IdentificationError, match="theta_rad: expected finite"):
        from_log(_log(broken))


def test_imported_signals_take_their_roles_from_the_attachment():
    rows = np.zeros(
        100, [("cycle", "<u8"), ("time_s", "<f8"), ("force", "<f8"), ("position", "<f8")]
    )
    rows["force"] = np.arange(100)
    log = _log(
        rows,
        metadata={"kind": "import", "name": "bench"},
        rate_hz=50.0,
        log_time_ns=np.arange(100, dtype=np.uint64) * 20_000_000,
        schema_name="levid/msg/Signals",
        attachments={"signals.yaml": SIGNALS_YAML},
    )
    record = from_log(log)
    assert (record.input_names, record.input_units) == (("force",), ("N",))
    assert (record.output_names, record.output_units) == (("position",), ("m",))
    assert record.controller is None
    assert record.leading_zeros == 0  # unknown delay: the output may respond at once
    assert record.Ts_s == 0.02
    assert record.beam_m is None


def foreign_log(times_ns: np.ndarray, **changes: object) -> Log:
    """Return a log of another program with a signals.yaml and without cycle numbers."""
    rows = np.zeros(len(times_ns), [("force", "<f8"), ("position", "<f8")])
    return _log(
        rows,
        metadata={"kind": "record", "name": "bench"},
        rate_hz=50.0,
        log_time_ns=times_ns.astype(np.uint64),
        schema_name="drive/msg/Sample",
        attachments={"signals.yaml": SIGNALS_YAML},
        **changes,
    )


def test_missing_samples_are_an_error_and_late_messages_are_not():
    times_ns = np.arange(2000) * 20_000_000
    lost = np.delete(times_ns, np.s_[700:703])
    with pytest.raises(
        IdentificationError, match=r"missing samples: .* found 0.08 s before row 700"
    ):
        from_log(foreign_log(lost))
    late = times_ns.copy()
    late[700:703] = times_ns[703]  # in a burst, as on a busy machine
    assert len(from_log(foreign_log(late)).y) == 2000
    late = times_ns + np.random.default_rng(0).integers(0, 15_000_000, 2000)  # random delays
    assert len(from_log(foreign_log(np.sort(late))).y) == 2000
    (remark,) = from_log(foreign_log(times_ns, complete=False, problem="cut off")).remarks
    assert "truncated (cut off)" in remark


def _scheduled(**columns: tuple[str, np.ndarray]) -> Log:
    """Return an imported log with columns of role scheduling, as name=(unit, values)."""
    names = ("force", "position", *columns)
    rows = np.zeros(100, [("cycle", "<u8"), *((name, "<f8") for name in names)])
    rows["force"] = np.arange(100)
    more = ""
    for number, (name, (unit, values)) in enumerate(columns.items(), start=2):
        rows[name] = values
        more += f"  - {{column: {number}, name: {name}, unit: {unit}, role: scheduling}}\n"
    return _log(
        rows,
        metadata={"kind": "import", "name": "bench"},
        rate_hz=50.0,
        log_time_ns=np.arange(100, dtype=np.uint64) * 20_000_000,
        attachments={"signals.yaml": SIGNALS_YAML + more.encode()},
    )


def test_imported_position_alone_is_an_operating_point():
    still = 0.2 + 1e-4 * np.sin(np.arange(100))
    assert from_log(_scheduled(slide=("m", still))).beam_m == pytest.approx(0.2, abs=1e-5)
    moving = _scheduled(slide=("m", np.linspace(0.0, 0.05, 100)))
    with pytest.raises(NotARecordError, match=r"slide: .* found movement of 50\.0 mm"):
        from_log(moving)
    warm = _scheduled(warmth=("degC", 20.0 + still))
    with pytest.raises(NotARecordError, match=r"a position in m, found warmth in degC"):
        from_log(warm)
    both = _scheduled(slide=("m", still), speed=("m/s", still))
    with pytest.raises(NotARecordError, match="found slide in m, speed in m/s"):
        from_log(both)


def test_declared_model_accepts_any_scheduling_signal():
    model = ModelConfig.model_validate(
        {
            "levid": "model",
            "name": "spring",
            "dof": [{"name": "x", "unit": "m"}],
            "inputs": [{"name": "force", "unit": "N"}],
            "parameters": {"k": {"value": 100.0, "unit": "N/m"}},
            "scheduling": {"warm": {"unit": "degC", "signal": "warmth", "min": 0, "max": 40}},
            "M": [[1.0]],
            "D": [[1.0]],
            "K": [["k*(1 - warm/100)"]],
        }
    )
    warmth = np.linspace(20.0, 25.0, 100)
    experiment = experiment_from_log(_scheduled(warmth=("degC", warmth)), model)
    np.testing.assert_array_equal(experiment.schedule["warm"], warmth)
    assert experiment.moving


def _record(beam_m: float, axis: int, name: str = "r", rows: int = 100) -> Record:
    v = np.zeros((rows, 3))
    v[:, axis] = np.random.default_rng(axis).normal(size=rows)
    return Record(
        name, 1e-3, v, v, NAMES, ("1",) * 3, NAMES, ("1",) * 3, u=v, beam_m=beam_m,
        controller=PiController(np.ones(3), np.ones(3)), delay_cycles=1, at_rest=True,
    )  # fmt: skip


def test_records_are_grouped_by_beam_position_within_a_millimetre():
    records = [_record(b + 1e-4 * a, a) for b in (0.1, -0.1, 0.0) for a in range(3)]
    points = operating_points(records)
    assert [len(p.records) for p in points] == [3, 3, 3]
    beams = [p.beam_m for p in points if p.beam_m is not None]
    np.testing.assert_allclose(beams, [-0.0999, 0.0001, 0.1001], atol=1e-9)


def test_slowly_drifting_positions_form_groups_within_a_millimetre():
    creeping = [_record(b, 0) for b in np.linspace(0.0, 2.7e-3, 7)]
    beams = [p.beam_m for p in operating_points(creeping)]
    np.testing.assert_allclose(np.array(beams, float), [0.45e-3, 1.8e-3, 2.7e-3], atol=1e-9)
    without_position = [replace(r, beam_m=None) for r in creeping[:2]]
    groups = by_position([creeping[0], *without_position, creeping[6]])
    assert [len(group) for group in groups] == [2, 1, 1]
    assert groups[0] == without_position


def test_input_without_excitation_is_reported_with_its_position():
    records = [_record(0.0, 0, "psi"), _record(0.0, 2, "z")]
    with pytest.raises(IdentificationError, match=r"\+0\.0 mm.*no excitation of theta in 'psi'"):
        identify(records)


def test_records_of_different_rates_or_controllers_are_rejected():
    records = [_record(0.0, a, f"r{a}") for a in range(3)]
    with pytest.raises(IdentificationError, match="one sampling time in s in all records"):
        operating_points([*records[:2], replace(records[2], Ts_s=1e-4)])
    other = PiController(np.ones(3), 2 * np.ones(3))
    with pytest.raises(IdentificationError, match="different gains in 'r0' and 'r2'"):
        operating_points([*records[:2], replace(records[2], controller=other)])
    with_unknown_controller = [replace(_record(0.1, a), controller=None) for a in range(3)]
    with pytest.raises(IdentificationError, match="known controller"):
        identify([*records, *with_unknown_controller])


def test_error_without_records_lists_the_reasons():
    with pytest.raises(IdentificationError, match=r"found none \(a: kind 'move'"):
        identify([], skipped=["a: kind 'move'"])


def test_short_record_is_reported_with_position_and_name():
    records = [_record(0.02, a, f"r{a}") for a in range(3)]
    with pytest.raises(IdentificationError, match=r"beam at \+20\.0 mm: record 'r0': expected at"):
        identify(records, Options(impulse_s=6.0))
