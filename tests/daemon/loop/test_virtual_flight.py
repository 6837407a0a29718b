"""Test complete flights in virtual time: forces, logs, end."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import yaml

from levid.config.base import ConfigError, parse_text
from levid.config.model import ModelConfig
from levid.config.rig import RigConfig, load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.daemon.control.faults import Fault, FlightFault
from levid.daemon.control.states import State
from levid.daemon.loop.clock import VirtualClock
from levid.daemon.loop.virtual_flight import Flight, FlightResult, RecordingError
from levid.daemon.loop.virtual_session import fly_virtually
from levid.daemon.planning.plan import plan_session
from levid.drivers.base import DriverError
from levid.log.reader import read_log
from levid.model.geometry import decoupling_matrix

RIG_FILE = shipped("rigs/loopback.yaml")
SESSION = """
levid: session
name: short
seed: 3
excitations:
  psi: {input: psi, rms_n_m: 0.1}
  coil: {input: "coil:4", rms_n: 0.2}
steps:
  - levitate: {settle_s: 1.0}
  - move: {beam_m: 0.05, settle_s: 0.5}
  - record: {name: tilt, duration_s: 3, settle_s: 1.0, excite: [psi]}
  - record: {name: coil, duration_s: 2, settle_s: 0.5, excite: [coil, psi]}
  - move: {beam_m: 0.0, settle_s: 0.5}
  - land: {}
"""


def session(text: str = SESSION, **more: object) -> SessionConfig:
    return parse_text(yaml.safe_dump({**yaml.safe_load(text), **more}), SessionConfig, "session")


def fly(
    out: Path, config: SessionConfig | None = None, rig: RigConfig | None = None
) -> FlightResult:
    return fly_virtually(
        rig or load_rig(RIG_FILE), RIG_FILE, config or session(), SESSION.encode(), out
    )


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> FlightResult:
    return fly(tmp_path_factory.mktemp("flight") / "logs")


def test_one_log_a_step_and_one_continuous_time(flown: FlightResult) -> None:
    names = [path.name for path in flown.logs]
    assert names == [
        "00-levitate.mcap", "01-move.mcap", "02-tilt.mcap", "03-coil.mcap", "04-move.mcap",
        "05-land.mcap",
    ]  # fmt: skip
    assert [path.name for path in flown.records] == ["02-tilt.mcap", "03-coil.mcap"]
    cycles = np.concatenate([read_log(path).rows["cycle"] for path in flown.logs])
    np.testing.assert_array_equal(cycles, np.arange(flown.cycles))
    times = np.concatenate([read_log(path).rows["time_s"] for path in flown.logs])
    np.testing.assert_array_equal(times, cycles * 1e-3)


def test_log_says_all_that_identification_needs(flown: FlightResult) -> None:
    log = read_log(flown.records[0])
    assert log.metadata["kind"] == "record"
    assert log.metadata["name"] == "tilt"
    assert log.metadata["session"] == "short"
    assert log.attachments["rig.yaml"] == RIG_FILE.read_bytes()
    assert log.attachments["session.yaml"] == SESSION.encode()
    assert parse_text(log.attachments["model.yaml"], ModelConfig, "log") == load_rig(RIG_FILE).model
    assert set(log.attachments) == {
        "rig.yaml", "model.yaml", "session.yaml", "versions.json", "host.json",
    }  # fmt: skip
    rows = log.rows
    assert rows["lateness_s"].max() == rows["execution_s"].max() == 0.0
    # The command of cycle k acts from k + 1 on; after many lags of 0.3 ms the readback is there,
    # but for the amplifier's noise (1 mN rms, five of them) and what is left of the lag, e^-3.3.
    step = np.abs(np.diff(rows["coil_n"], axis=0)).max()
    lagged = np.abs(rows["coil_readback_n"][2:] - rows["coil_n"][:-2]).max()
    assert lagged < 5e-3 + 0.04 * step


def test_wrench_reaches_the_coils_through_T(flown: FlightResult) -> None:
    rig = load_rig(RIG_FILE)
    T = decoupling_matrix(rig.geometry.coil_x_m, rig.geometry.coil_y_m)
    rows = read_log(flown.records[1]).rows
    tau = np.stack([rows[name] for name in ("tau_psi_n_m", "tau_theta_n_m", "tau_z_n")], axis=1)
    # float32 of the log on forces below 20 N.
    np.testing.assert_allclose(rows["coil_n"], tau @ T + rows["coil_excitation_n"], atol=1e-5)
    played = np.flatnonzero(np.abs(rows["coil_excitation_n"]).max(axis=0))
    np.testing.assert_array_equal(played, [4])


def test_platform_rises_from_the_stops_holds_and_lies_down_again(flown: FlightResult) -> None:
    first, last = read_log(flown.logs[0]).rows, read_log(flown.logs[-1]).rows
    # The stops are at -0.9 mm and sag by some 10 um under the weight.
    assert -0.92e-3 < first["z_m"][0] < -0.9e-3
    assert abs(first["z_m"][-1]) < 2e-6
    assert np.all(np.diff(first["z_ref_m"][first["state"] == State.LEVITATING]) >= 0)
    assert -0.92e-3 < last["z_m"][-1] < -0.9e-3
    assert np.all(last["coil_n"][-1] == 0.0)
    assert last["state"][-1] == State.IDLE


def test_same_seed_gives_the_same_bytes_and_another_does_not(
    flown: FlightResult, tmp_path: Path
) -> None:
    again = fly(tmp_path / "again")
    for ours, theirs in zip(flown.logs, again.logs, strict=True):
        assert ours.read_bytes() == theirs.read_bytes()
    other = fly(tmp_path / "other", session(seed=4))
    assert other.records[0].read_bytes() != flown.records[0].read_bytes()


def test_ten_khz_flies_too(tmp_path: Path) -> None:
    result = fly(tmp_path / "logs", session(rate_hz=10_000))
    rows = read_log(result.records[0]).rows
    assert len(rows) == 40_000
    assert rows["fault"].max() == 0


def test_level_that_saturates_the_coils_is_refused_before_anything_is_written(
    tmp_path: Path,
) -> None:
    config = session(
        excitations={"psi": {"input": "psi", "rms_n_m": 5.0}, "coil": {"input": "z", "rms_n": 1}}
    )
    with pytest.raises(ConfigError, match=r"steps\[2\].record.*would saturate the coils.*20 N"):
        fly(tmp_path / "logs", config)
    assert not (tmp_path / "logs").exists()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_level_that_is_no_number_is_refused(tmp_path: Path) -> None:
    """Squares beyond all numbers make one that no comparison finds too large."""
    band = {"input": "psi", "rms_n_m": 1e308, "band_hz": [1, 100]}
    with pytest.raises(ConfigError, match=r"would saturate the coils.*found .* nan N"):
        fly(
            tmp_path / "logs",
            session(excitations={"psi": band, "coil": {"input": "z", "rms_n": 1}}),
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"move": {"beam_m": 0.2}}, r"steps\[1\].move.beam_m: expected within \+-0.1 m, found 0.2"),
        ({"move": {"beam_m": 0.1, "velocity_m_s": 9.0}}, "velocity_m_s: expected at most 0.5 m/s"),
        (
            {"record": {"name": "x", "duration_s": 2, "excite": ["coil"]}},
            r"expected coil:0 .. coil:8, found coil:9",
        ),
    ],
)
def test_what_the_rig_cannot_do_is_refused(tmp_path: Path, change: dict, message: str) -> None:
    data = yaml.safe_load(SESSION)
    data["steps"][1] = change
    data["excitations"]["coil"]["input"] = "coil:9"
    data["steps"][3]["record"]["excite"] = ["psi"]
    with pytest.raises(ConfigError, match=message):
        fly(tmp_path / "logs", session(yaml.safe_dump(data)))


def test_gains_ten_times_too_high_diverge_into_a_fault_with_zero_force(tmp_path: Path) -> None:
    rig = load_rig(RIG_FILE)
    gains = {
        "psi": {"kp_n_m_rad": 200, "ki_n_m_rad_s": 2000},
        "theta": {"kp_n_m_rad": 200, "ki_n_m_rad_s": 2000},
        "z": {"kp_n_m": 5000, "ki_n_m_s": 30000},
    }
    wild = RigConfig.model_validate({**rig.model_dump(), "control": gains})
    with pytest.raises(FlightFault) as caught:
        fly(tmp_path / "logs", session(), wild)
    assert caught.value.fault is Fault.GAP
    rows = read_log(sorted((tmp_path / "logs").glob("*.mcap"))[-1]).rows
    at = int(np.flatnonzero(rows["fault"])[0])
    assert np.all(rows["coil_n"][at:] == 0.0)
    # What follows a fault is logged too: half a second.
    assert np.all(rows["fault"][at:] == Fault.GAP)
    assert len(rows) - at == 501


def test_driver_that_fails_in_flight_ends_in_a_named_fault(tmp_path: Path) -> None:
    config, rig = session(), load_rig(RIG_FILE)
    with Flight(rig, RIG_FILE.parent, 1000.0, VirtualClock()) as flight:
        calls = 0
        read = flight.devices.sensors.read

        def failing(gap_m: np.ndarray) -> None:
            nonlocal calls
            calls += 1
            if calls > 2500:
                raise DriverError("bus can0: gone")
            read(gap_m)

        flight.devices.sensors.read = failing  # type: ignore[method-assign]
        (tmp_path / "logs").mkdir()
        with pytest.raises(FlightFault, match=r"DRIVER .*bus can0: gone"):
            flight.fly(plan_session(config, rig), tmp_path / "logs", {})


def test_stop_request_skips_to_landing(tmp_path: Path) -> None:
    config, rig = session(), load_rig(RIG_FILE)
    with Flight(rig, RIG_FILE.parent, 1000.0, VirtualClock()) as flight:

        def stop_in_first_record(step: str, done: int, total: int) -> None:
            if step == "tilt":
                flight.loop.stop_requested = True

        (tmp_path / "logs").mkdir()
        result = flight.fly(plan_session(config, rig), tmp_path / "logs", {}, stop_in_first_record)
    assert [p.name for p in result.logs][-2:] == ["02-tilt.mcap", "05-land.mcap"]
    rows = read_log(result.logs[-1]).rows
    assert rows["state"][-1] == State.IDLE
    assert np.all(rows["coil_n"][-1] == 0.0)


@pytest.mark.parametrize("at_cycle", [10, 500, 1500, 3000, 5000])
def test_stop_at_any_time_ends_on_the_stops_without_a_jump(tmp_path: Path, at_cycle: int) -> None:
    config, rig = session(), load_rig(RIG_FILE)
    with Flight(rig, RIG_FILE.parent, 1000.0, VirtualClock()) as flight:
        read = flight.devices.sensors.read

        def reading(gap_m: np.ndarray) -> None:
            # Again and again, while landing too: an operator who presses twice.
            flight.loop.stop_requested |= next(reads) >= at_cycle
            read(gap_m)

        reads = itertools.count()
        flight.devices.sensors.read = reading  # type: ignore[method-assign]
        (tmp_path / "logs").mkdir()
        result = flight.fly(plan_session(config, rig), tmp_path / "logs", {})
    rows = np.concatenate([read_log(path).rows for path in result.logs])
    assert rows["fault"].max() == 0
    assert np.all(rows["coil_n"][-1] == 0.0)
    # The excitation may stop dead (0.14 N a coil at four sigma); the force that carries may not.
    carried = rows["coil_n"] - rows["coil_excitation_n"]
    assert np.abs(np.diff(carried, axis=0)).max() < 1.5


@pytest.mark.parametrize("sim", ["sims/nominal.yaml", "sims/rig.yaml"])
def test_stop_while_the_beam_moves_brakes_it_within_its_limits(tmp_path: Path, sim: str) -> None:
    # The plan ends with the beam at +0.1 m; the stop comes on its way to -0.1 m.
    config = session(
        steps=[
            {"levitate": {"settle_s": 0.5}},
            {"move": {"beam_m": -0.1, "settle_s": 1.0}},
            {"move": {"beam_m": 0.1}},
            {"land": {}},
        ]
    )
    rig = load_rig(RIG_FILE).model_copy(update={"sim": str(shipped(sim))})
    with Flight(rig, RIG_FILE.parent, 1000.0, VirtualClock()) as flight:
        read, reads = flight.devices.sensors.read, itertools.count()

        def reading(gap_m: np.ndarray) -> None:
            flight.loop.stop_requested |= next(reads) >= 3200
            read(gap_m)

        flight.devices.sensors.read = reading  # type: ignore[method-assign]
        (tmp_path / "logs").mkdir()
        result = flight.fly(plan_session(config, rig), tmp_path / "logs", {})
    assert result.stopped
    rows = np.concatenate([read_log(path).rows for path in result.logs])
    speed, pace = rows["beam_ref_m_s"], np.diff(rows["beam_ref_m"]) * 1000.0
    assert np.abs(pace).max() < rig.limits.beam_velocity_m_s
    # Setpoints and their speeds tell the same story: no jump hides between two cycles.
    np.testing.assert_allclose(pace, 0.5 * (speed[1:] + speed[:-1]), atol=2e-3)
    assert speed[-1] == 0.0
    assert rows["fault"].max() == 0


def test_another_session_records_again_after_one_that_could_not(tmp_path: Path) -> None:
    config, rig = session(), load_rig(RIG_FILE)
    bad, good = tmp_path / "bad", tmp_path / "good"
    bad.mkdir()
    good.mkdir()
    (bad / "01-move.mcap").write_bytes(b"mine")
    with Flight(rig, RIG_FILE.parent, 1000.0, VirtualClock()) as flight:
        with pytest.raises(RecordingError):
            flight.fly(plan_session(config, rig), bad, {})
        result = flight.fly(plan_session(config, rig), good, {})
    assert all(read_log(path).complete for path in result.logs)


@pytest.mark.parametrize(
    "move",
    [
        {"beam_m": 0.1, "velocity_m_s": 1e-9},
        {"beam_m": 0.1, "acceleration_m_s2": 1e-320},
    ],
)
def test_move_without_an_end_is_refused(move: dict) -> None:
    config = session(steps=[{"levitate": {}}, {"move": move}, {"land": {}}])
    with pytest.raises(ConfigError, match=r"steps\[1\].move: expected a move of at most 3600 s"):
        plan_session(config, load_rig(RIG_FILE))


def test_rows_before_a_failing_driver_are_in_the_log(tmp_path: Path) -> None:
    config, rig = session(), load_rig(RIG_FILE)
    with Flight(rig, RIG_FILE.parent, 1000.0, VirtualClock()) as flight:
        read, reads = flight.devices.sensors.read, itertools.count()

        def failing(gap_m: np.ndarray) -> None:
            if next(reads) == 1000:
                raise DriverError("bus can0: gone")
            read(gap_m)

        flight.devices.sensors.read = failing  # type: ignore[method-assign]
        (tmp_path / "logs").mkdir()
        with pytest.raises(FlightFault):
            flight.fly(plan_session(config, rig), tmp_path / "logs", {})
    rows = read_log(tmp_path / "logs" / "00-levitate.mcap").rows
    np.testing.assert_array_equal(rows["cycle"][:1000], np.arange(1000))
    assert np.all(np.diff(rows["cycle"].astype(int)) > 0)
    assert rows["fault"][-1] == Fault.DRIVER


def test_waypoint_that_its_record_cannot_hold_is_refused() -> None:
    slow = {"name": "x", "duration_s": 2, "beam": [{"to_m": 0.1, "velocity_m_s": 0.01}]}
    config = session(steps=[{"levitate": {}}, {"record": slow}, {"land": {}}])
    with pytest.raises(ConfigError, match=r"steps\[1\].record.beam\[0\].to_m: expected a move"):
        plan_session(config, load_rig(RIG_FILE))


def test_log_that_cannot_be_written_does_not_end_the_flight(tmp_path: Path) -> None:
    config, rig = session(), load_rig(RIG_FILE)
    out = tmp_path / "logs"
    out.mkdir()
    (out / "02-tilt.mcap").write_bytes(b"mine")
    with (
        Flight(rig, RIG_FILE.parent, 1000.0, VirtualClock()) as flight,
        pytest.raises(RecordingError, match=r"02-tilt\.mcap"),
    ):
        flight.fly(plan_session(config, rig), out, {})
    assert flight.loop.cycle + 1 == plan_session(config, rig).cycles
    assert (out / "02-tilt.mcap").read_bytes() == b"mine"


def test_virtual_time_is_for_loopback_alone(tmp_path: Path) -> None:
    rig = load_rig(RIG_FILE)
    other = rig.model_copy(update={"drives": rig.drives.model_copy(update={"backend": "can"})})
    with pytest.raises(ConfigError, match=r"drives\.backend: expected loopback .*, found can"):
        fly(tmp_path / "logs", rig=other)


def test_beam_trajectory_repeats_and_ends_with_the_record() -> None:
    config = session(
        steps=[
            {"levitate": {}},
            {
                "record": {
                    "name": "sweep",
                    "duration_s": 10,
                    "beam": [{"to_m": 0.05, "dwell_s": 0.5}, {"to_m": -0.05, "dwell_s": 0.5}],
                }
            },
            {"move": {"beam_m": 0.0}},
            {"land": {}},
        ]
    )
    plan = plan_session(config, load_rig(RIG_FILE))
    sweep = plan.steps[1].segments()[-1].beam
    assert sweep.shape == (10_000, 3)
    assert sweep[:, 0].max() == pytest.approx(0.05)
    assert sweep[-1, 1] == sweep[-1, 2] == 0.0
    # No jump anywhere, and none into the next step either.
    assert np.abs(np.diff(sweep[:, 0])).max() < 0.25 * 1e-3 * 1.01
    following = plan.steps[2].segments()[0].beam
    assert abs(following[0, 0] - sweep[-1, 0]) < 1e-6
