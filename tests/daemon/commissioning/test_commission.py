"""Test commissioning on the simulator: wrong rigs are corrected and fly, forces stay small."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from headless_browser import browser, find_browser
from pictures import page_pictures

from levid.benchmarks.daemon.commissioned_rigs import (
    CHANNELS,
    FORCE_N,
    STOPS,
    Wiring,
    commissioned,
    drawn,
    mistakes,
    rig_file,
)
from levid.config.base import parse_text
from levid.config.rig import load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.daemon.commissioning import commission as commission_module
from levid.daemon.commissioning.commission import commission
from levid.daemon.commissioning.corrections import (
    corrected_text,
    corrections,
    first_lift_text,
    problems,
)
from levid.daemon.commissioning.device_session import DeviceSession
from levid.daemon.commissioning.errors import CommissionError
from levid.daemon.control.faults import FlightFault
from levid.daemon.loop.virtual_session import fly_virtually
from levid.drivers.base import Context, DriverError, ManipulatorDrives
from levid.drivers.loopback import LoopbackBackend

SWAPPED = Wiring(
    coil_order=(1, 0, 2, 3, 4, 5, 6, 8, 7),
    coil_scale=(1.0, 1.0, -1.0, 1.0, 1.2, 1.0, 1.0, 1.0, 1.0),
    sensor_order=(0, 1, 2, 5, 4, 3, 6, 7, 8),
    # At most 1.1: the sensor must not reach the end of its range on the stops.
    sensor_scale=(1.0, 1.0, 1.0, 1.1, 1.0, 1.0, -1.0, 1.0, 0.8),
)
SESSION = """
levid: session
name: hover
steps:
  - levitate: {unload_s: 0.2, ramp_s: 0.5, settle_s: 0.5}
  - land: {ramp_s: 0.4, release_s: 0.2}
"""


def shipped_text() -> str:
    """Return the shipped rig, on the simulator beside it."""
    text = shipped("rigs/loopback.yaml").read_text()
    text = text.replace("../models/rig.yaml", str(shipped("models/rig.yaml")))
    return text.replace("../sims/nominal.yaml", "sim.yaml")


@pytest.mark.parametrize("seed", range(3, 8))  # one of six is right
def test_all_that_is_wrong_is_found_and_nothing_else(tmp_path: Path, seed: int) -> None:
    wiring = drawn(seed)
    _, found = commissioned(tmp_path, "loopback", wiring, seed)
    assert not mistakes(found, wiring)
    assert found.delay_cycles == 2
    assert found.readback.tolist() == list(range(CHANNELS))
    assert 0.0 < found.largest_n <= FORCE_N


def test_corrected_rig_flies_where_the_wrong_one_does_not(tmp_path: Path) -> None:
    path = rig_file(tmp_path, "loopback", SWAPPED, 2)
    session = parse_text(SESSION, SessionConfig, "session")

    def fly(rig_path: Path, out: str) -> None:
        rig = load_rig(rig_path)
        fly_virtually(rig, rig_path, session, SESSION.encode(), tmp_path / out, lambda *_: None)

    with pytest.raises(FlightFault):
        fly(path, "wrong")
    rig, found = commissioned(tmp_path, "loopback", SWAPPED, 2)
    assert not problems(found)
    # The benchmark's rig has no lists in brackets: take the shipped text.
    corrected = tmp_path / "corrected.yaml"
    corrected.write_text(corrected_text(shipped_text(), found, rig))
    assert "# 3 x 3 grid" in corrected.read_text()
    fly(corrected, "right")
    first = tmp_path / "first.yaml"
    first.write_text(first_lift_text(corrected.read_text(), rig, 68.7))
    limits = load_rig(first).limits
    assert limits.coil_n == pytest.approx(2.5 * 68.7 / 9, rel=1e-3)
    assert limits.total_n == pytest.approx(1.25 * 68.7, rel=1e-3)
    assert (limits.tilt_rad, limits.gap_m_s) == (0.00325, 0.075)
    fly(first, "first")
    said = " ".join(corrections(found))
    for words in (
        "sensor channels 3 and 5 are swapped",
        "coil channels 7 and 8 are swapped",
        "sensor channel 6 reads with the wrong sign",
        "coil channel 4 pushes 1.2",
    ):
        assert words in said


def test_limits_of_a_first_lift_in_any_layout_of_the_block(tmp_path: Path) -> None:
    text = """limits:  # of the lab
    gap_m: 0.0008
# tilt_rad is the default
    coil_n: 9   # of the supply

    beam_m: 0.1
"""
    rig = load_rig(rig_file(tmp_path, "loopback", Wiring(), 1))
    none = {"gap_m": 8e-4, "coil_n": 9.0, "total_n": None, "tilt_rad": None, "gap_m_s": None}
    rig = rig.model_copy(update={"limits": rig.limits.model_copy(update=none)})
    found = yaml.safe_load(first_lift_text(f"{text}sensors: {{}}\n", rig, 90.0))["limits"]
    arm_m = max(map(abs, (*rig.geometry.coil_x_m, *rig.geometry.coil_y_m)))
    assert found["coil_n"] == 9  # tighter already
    assert found["total_n"] == pytest.approx(1.25 * 90.0)
    assert found["tilt_rad"] == pytest.approx(0.5 * 8e-4 / arm_m, rel=1e-3)
    assert found["gap_m_s"] == pytest.approx(0.5 * np.sqrt(2.0 * 9.81 * 8e-4), rel=1e-3)
    assert found["beam_m"] == 0.1


def test_swapped_current_sensors_are_a_problem(tmp_path: Path) -> None:
    _, found = commissioned(tmp_path, "loopback", Wiring(), 1)
    assert not problems(found)
    found = replace(found, readback=np.array([1, 0, *range(2, CHANNELS)]))
    assert [line.split(":")[0] for line in problems(found)] == ["coil 0", "coil 1"]
    assert not corrections(found)


@pytest.mark.parametrize(("way", "begin_m"), [(1.0, 0.0), (-1.0, 0.0), (1.0, 0.09)])
def test_beam_that_moves_the_wrong_way_is_a_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: float, begin_m: float
) -> None:
    plain = LoopbackBackend.drives

    class Wired(ManipulatorDrives):
        """Drives whose direction is `way`."""

        def __init__(self, inside: ManipulatorDrives) -> None:
            self.inside = inside

        def write(self, beam, rotor):  # type: ignore[no-untyped-def]
            self.inside.write(way * beam, rotor)

        def read(self, beam, rotor):  # type: ignore[no-untyped-def]
            self.inside.read(beam, rotor)
            beam *= way

    monkeypatch.setattr(LoopbackBackend, "drives", lambda self: Wired(plain(self)))
    path = rig_file(tmp_path, "loopback", SWAPPED, 6)
    rig = load_rig(path)
    with DeviceSession(Context(rig, 1e-3, tmp_path), FORCE_N, FORCE_N) as session:
        (backend,) = session.devices.backends
        assert isinstance(backend, LoopbackBackend)
        session.move_beam(begin_m)
        found = commission(session, rig, STOPS, FORCE_N, backend.lift, lambda *_: None, beam_m=0.02)
        assert session.beam_m == pytest.approx(begin_m, abs=1e-6)  # it is where it was
    assert found.beam is not None
    assert found.beam.sd < 0.05
    # Sensors and coils are known to a per cent each.
    assert found.beam.ratio == pytest.approx(way, abs=0.05)
    assert any("the beam moves to negative x" in line for line in problems(found)) == (way < 0.0)


def test_no_command_exceeds_the_limit(tmp_path: Path) -> None:
    rig = load_rig(rig_file(tmp_path, "loopback", Wiring(), 1))
    with DeviceSession(Context(rig, 1e-3, tmp_path), 3.0, 4.0) as session:
        for force in (3.1 * np.eye(9)[0], 0.5 * np.ones(9), np.full(9, np.nan)):
            with pytest.raises(DriverError, match="expected at most 3 N a coil and 4 N in all"):
                session.run(10, lambda _, f=force: f)
        with pytest.raises(DriverError, match=r"at most 0.1 m \(limits.beam_m\), found 0.11 m"):
            session.move_beam(0.11)
        assert session.largest_n == 0.0
        session.run(10, lambda _: 3.0 * np.eye(9)[4])
        found = session.run(20)
    assert np.abs(found.coil_n[5:]).max() < 0.1  # zero again


def test_platform_that_nobody_lifts_ends_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commission_module, "_HAND_S", 1.0)
    rig = load_rig(rig_file(tmp_path, "loopback", Wiring(), 1))
    with (
        DeviceSession(Context(rig, 1e-3, tmp_path), FORCE_N, FORCE_N) as session,
        pytest.raises(CommissionError, match=r"Lift the whole platform.*no sensor moved"),
    ):
        commission(session, rig, STOPS, FORCE_N, lambda _: None, lambda *_: None)


def test_command_writes_a_corrected_copy(levid, tmp_path: Path) -> None:
    rig_file(tmp_path, "loopback", SWAPPED, 3)
    rig = tmp_path / "mine.yaml"
    rig.write_text(shipped_text())
    new = tmp_path / "new.yaml"
    outcome = levid("commission", rig, "--out", new, "--json")
    assert outcome.code == 0
    found = json.loads(outcome.out)
    assert found["problems"] == []
    assert len(found["corrections"]) == 8
    assert found["written"] == str(new)
    page = Path(found["report"]).read_text()
    assert "This rig can fly with new.yaml, a copy of RIG.yaml with 8 corrections." in page
    assert "coil channels 7 and 8 are swapped in RIG.yaml" in page
    if find_browser() is not None:
        with browser(tmp_path / "profile") as window:
            window.open(Path(found["report"]).as_uri())
            page_pictures(window, "commissioning")
    assert levid("check", new, tmp_path / "new-first-lift.yaml").code == 0
    again = levid("commission", new, "--out", tmp_path / "again.yaml")
    assert "all channels are as RIG.yaml says" in again.out
    one, other = (load_rig(path) for path in (new, tmp_path / "again.yaml"))
    assert one.geometry == other.geometry
    assert one.channels == other.channels
    assert one.channels.coil_scale[2] == -1.0
    assert "exists" in levid("commission", rig, "--out", new).err
    assert "a quarter of the weight" in levid(
        "commission", rig, "--out", tmp_path / "x.yaml", "--force-n", 30
    ).err  # fmt: skip
    assert "at most 100 mm (limits.beam_m)" in levid(
        "commission", rig, "--out", tmp_path / "x.yaml", "--beam-mm", 101
    ).err  # fmt: skip


def test_dead_channel_is_a_problem_and_no_rig_is_written(levid, tmp_path: Path) -> None:
    rig_file(tmp_path, "loopback", Wiring(dead_coil=5, stuck_sensor=2), 4)
    rig = tmp_path / "mine.yaml"
    rig.write_text(shipped_text())
    outcome = levid("commission", rig, "--out", tmp_path / "new.yaml")
    assert outcome.code == 1
    assert "problem: coil 5 moves the platform too little, or not at all" in outcome.out
    assert "problem: sensor 2 does not follow the platform" in outcome.out
    page = (tmp_path / "new-commissioning" / "index.html").read_text()
    assert "2 channels must be repaired before this rig can fly." in page
    assert not (tmp_path / "new.yaml").exists()


def test_what_can_go_wrong_later_is_asked_before_anybody_lifts(levid, tmp_path: Path) -> None:
    rig_file(tmp_path, "loopback", Wiring(), 3)
    rig = tmp_path / "mine.yaml"
    rig.write_text(shipped_text())
    elsewhere = tmp_path / "other" / "new.yaml"
    assert "beside" in levid("commission", rig, "--out", elsewhere).err
    blocks = tmp_path / "blocks.yaml"
    blocks.write_text(shipped_text().replace("coil_x_m: [", "coil_x_m:\n    ["))
    outcome = levid("commission", blocks, "--out", tmp_path / "new.yaml")
    assert outcome.code == 1
    assert "coil_x_m: expected a list in brackets" in outcome.err
    limits = yaml.safe_load(shipped_text())["limits"]
    cut = re.sub(r"^limits:.*\n(?:[ #].*\n|\n)+", "", shipped_text(), flags=re.MULTILINE)
    flow = tmp_path / "flow.yaml"
    flow.write_text(f"{cut}\nlimits: {json.dumps(limits)}\n")
    outcome = levid("commission", flow, "--out", tmp_path / "new.yaml")
    assert outcome.code == 1
    assert "limits: expected one key on a line" in outcome.err
    assert not (tmp_path / "new.yaml").exists()


def test_wrong_stroke_is_a_problem_and_strong_coils_are_a_remark(levid, tmp_path: Path) -> None:
    rig_file(tmp_path, "loopback", Wiring(coil_scale=(0.5,) * 9), 3)
    rig = tmp_path / "mine.yaml"
    rig.write_text(shipped_text())
    outcome = levid("commission", rig, "--out", tmp_path / "new.yaml", "--stroke-mm", 1.0)
    assert outcome.code == 1
    assert "all sensors read 1.82 times as much as they should: is the stroke right?" in outcome.out
    outcome = levid("commission", rig, "--out", tmp_path / "new.yaml")
    assert outcome.code == 0
    assert "remark: the beam tilts the platform 2 times as much" in outcome.out
