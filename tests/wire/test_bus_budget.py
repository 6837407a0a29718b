"""What a cycle takes of a bus: the standards' frame lengths, and rates that do not fit."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pydantic import ValidationError

from levid.config.base import ConfigError, parse_text
from levid.config.rig import RigConfig, load_rig
from levid.config.shipped import shipped
from levid.drivers.base import Context
from levid.drivers.bus_backend import AnswerTime
from levid.wire.bus_budget import budget, check_budget
from levid.wire.can.worst_case_cycle_time import can_frame_s, canfd_frame_s

HEAD = shipped("rigs/loopback.yaml").read_text().partition("amplifiers:")[0]
ONE_CLASSIC = """
can: {main: {interface: virtual, channel: x, bitrate: 1000000}}
amplifiers: {backend: can, bus: main}
sensors: {backend: can, bus: main}
drives: {backend: can, bus: main}
"""
ONE_FD_WITHOUT_DRIVES = """
can: {main: {interface: virtual, channel: x, data_bitrate: 5000000, latency_s: 0}}
amplifiers: {backend: can, bus: main}
sensors: {backend: can, bus: main}
drives: {backend: loopback}
sim: sim.yaml
"""


def rig(buses: str, rate_hz: float) -> RigConfig:
    return parse_text(HEAD.replace("rate_hz: 1000", f"rate_hz: {rate_hz}") + buses, RigConfig, "")


@pytest.mark.parametrize(("length", "bits"), [(0, 55), (1, 65), (8, 135)])
def test_classic_frame_is_that_of_davis_and_others(length: int, bits: int) -> None:
    # 55 + 10 n for an 11-bit ID: Davis, Burns, Bril, Lukkien 2007, eq. (2)
    assert can_frame_s(length, 1e6) == pytest.approx(bits * 1e-6)


def test_classic_frame_bounds_what_stuffing_really_adds() -> None:
    """The worst payload, stuffed bit by bit, stays within the bound and comes near it."""
    longest = 0
    for payload in (b"\x00" * 8, b"\xff" * 8, b"\x87\x87\x0f\x1e\x3c\x78\xf0\xe1", b"\x0f" * 8):
        for can_id in (0x000, 0x078, 0x0F0, 0x10F):
            bits = f"0{can_id:011b}000{len(payload):04b}" + "".join(f"{b:08b}" for b in payload)
            longest = max(longest, len(stuffed(bits + crc15(bits))) + 10 + 3)
    assert longest <= can_frame_s(8, 1.0)
    assert longest >= can_frame_s(8, 1.0) - 16  # of 24 stuff bits, most


def stuffed(bits: str) -> str:
    out, run = "", ""
    for bit in bits:
        out += bit
        run = run + bit if run[-1:] == bit else bit
        if len(run) == 5:
            out += "1" if bit == "0" else "0"
            run = out[-1]
    return out


def crc15(bits: str) -> str:
    crc = 0
    for bit in bits:
        top = (crc >> 14 & 1) ^ int(bit)
        crc = (crc << 1 & 0x7FFF) ^ (0x4599 if top else 0)
    return f"{crc:015b}"


def test_fd_frames_are_as_long_as_computed_by_hand() -> None:
    # 34 bits at 1 Mbit/s; 5 + 8 n, a quarter of that, checksum and fixed stuff bits at 5 Mbit/s
    assert canfd_frame_s(20, 1e6, 5e6) == pytest.approx(34e-6 + (165 + 41 + 25 + 7) / 5e6)
    assert canfd_frame_s(8, 1e6, 5e6) == pytest.approx(34e-6 + (69 + 17 + 21 + 6) / 5e6)


@pytest.mark.parametrize("name", ["can", "canfd", "serial"])
def test_shipped_rigs_fit_their_buses(name: str) -> None:
    path = shipped(f"rigs/{name}.yaml")
    check_budget(load_rig(path), path.parent)


def test_one_classic_bus_does_not_carry_1_khz_and_says_what_does() -> None:
    with pytest.raises(ConfigError) as error:
        check_budget(rig(ONE_CLASSIC, 1000.0), Path())
    text = str(error.value)
    # sync 85, six frames of answers 810, SYNC 65 and three TPDOs 405, three setpoints 405, three
    # RPDOs of 6 bytes 345 us, and 20 us of latency
    assert "a cycle takes at most 2.135 ms" in text
    assert "highest rate that fits is 468 Hz" in text
    assert "two buses of classic CAN (amplifiers on their own) and drives read every 4" in text
    # What is enough is marked; that it fits no single bus would be wrong: it fits one of CAN FD.
    assert "one for each role: 1092 Hz (enough)" in text
    assert "every 4 cycles: 558 Hz;" in text
    assert "exceeds a single" not in text


def test_10_khz_fits_no_single_can_bus() -> None:
    with pytest.raises(ConfigError, match="highest rate that fits is 3032 Hz") as error:
        check_budget(rig(ONE_FD_WITHOUT_DRIVES, 10_000.0), Path())
    text = str(error.value)
    assert "10 kHz exceeds a single CAN bus: CAN FD at 5 Mbit/s carries at most 3032 Hz" in text
    assert "two buses of CAN FD (amplifiers on their own): 4029 Hz;" in text
    assert "enough" not in text


def test_a_slow_adapter_is_told_from_a_slow_bus() -> None:
    """1 kHz fits a bus: it is USB that takes the time."""
    with pytest.raises(
        ConfigError, match=r"main is busy for 3.115 ms, including latency_s of 1.000 ms\)"
    ) as e:
        check_budget(
            rig(ONE_CLASSIC.replace("virtual, channel: x", "gs_usb, channel: 0"), 1000.0), Path()
        )
    assert "exceeds a single" not in str(e.value)
    assert "CAN FD" not in str(e.value)  # which it does not carry


def test_rig_on_no_bus_has_no_budget() -> None:
    path = shipped("rigs/loopback.yaml")
    assert budget(load_rig(path), path.parent).cycle_s == 0.0


def test_role_on_a_bus_that_is_not_there_says_which_are() -> None:
    text = ONE_CLASSIC.replace(
        "sensors: {backend: can, bus: main", "sensors: {backend: can, bus: x"
    )
    with pytest.raises(
        ConfigError, match=r"sensors.bus: expected a bus that the key 'can' defines \(main\)"
    ):
        budget(rig(text, 100.0), Path())


def test_a_dbc_for_one_format_says_what_fits_without_the_other(tmp_path: Path) -> None:
    """More coils than the shipped DBC has: what CAN FD would carry nobody knows."""
    text = shipped("levid.dbc").read_text()
    (tmp_path / "own.dbc").write_text(twelve(text))
    buses = ONE_CLASSIC.replace("bitrate: 1000000", "bitrate: 1000000, dbc: own.dbc")
    of_twelve = parse_text(HEAD.replace("rate_hz: 1000", "rate_hz: 2000") + buses, RigConfig, "")
    geometry = of_twelve.geometry.model_copy(
        update={
            "sensor_x_m": of_twelve.geometry.sensors_x_m,
            "sensor_y_m": of_twelve.geometry.sensors_y_m,
            "coil_x_m": (*of_twelve.geometry.coil_x_m, 0.01, 0.02, 0.03),
            "coil_y_m": (*of_twelve.geometry.coil_y_m, 0.01, -0.02, 0.03),
        }
    )
    with pytest.raises(ConfigError) as error:
        check_budget(of_twelve.model_copy(update={"geometry": geometry}), tmp_path)
    assert "more than the buses carry" in str(error.value)
    assert "CAN FD" not in str(error.value)


def twelve(text: str) -> str:
    """Return the DBC with room for three more coils, in classic frames."""
    for kind, last, number in (("setpoint", "Setpoints2", 1001), ("force", "Forces2", 1002)):
        found = re.search(rf"(?ms)^BO_ \d+ {last}: .*?\n\n", text)
        assert found is not None, last
        again = re.sub(r"BO_ \d+ \w+", f"BO_ {number} {last}b", found[0])
        for old in (6, 7, 8):
            again = again.replace(f"{kind}_{old}_n", f"{kind}_{old + 3}_n")
        text = text.replace(found[0], found[0] + again)
    return text


CAN = {"interface": "levid_local", "channel": "/tmp/bus"}
SOCKET = {"interface": "socketcan", "channel": "can0"}
UDP = {"interface": "udp_multicast", "channel": "239.74.163.2"}


@pytest.mark.parametrize(
    ("backend", "one", "other", "same"),
    [
        ("can", CAN, CAN, True),
        ("can", CAN, {**CAN, "channel": "/tmp/./bus/", "bitrate": 500_000}, True),
        ("can", SOCKET, {**SOCKET, "options": {"local_loopback": False}}, True),
        ("can", SOCKET, {**SOCKET, "channel": "can1"}, False),
        ("can", UDP, UDP, True),
        ("can", UDP, {**UDP, "options": {"port": 43114}}, False),
        ("serial", {"port": "/dev/a", "baud": 9600}, {"port": "/dev//a", "baud": 9600}, True),
        ("serial", {"port": "/dev/a", "baud": 9600}, {"port": "/dev/b", "baud": 9600}, False),
    ],
)
def test_two_names_for_one_wire_are_refused(
    backend: str, one: dict, other: dict, same: bool
) -> None:
    """Each would be held to carry what the whole of it does: 1020 Hz instead of 468."""
    data = load_rig(shipped("rigs/can.yaml")).model_dump()
    on = {"amplifiers": "force", "sensors": "motion", "drives": "motion"}
    data |= {role: {"backend": backend, "bus": name} for role, name in on.items()}
    data |= {"can": {}, "serial": {}} | {backend: {"force": one, "motion": other}}
    if same:
        with pytest.raises(ValidationError, match=r"for the bus .*, found 'force' and 'motion'"):
            RigConfig.model_validate(data)
        data |= {role: {"backend": backend, "bus": "force"} for role in on}
    RigConfig.model_validate(data)  # one that no role is on is nobody's


def test_what_goes_before_the_answers_is_waited_for_too() -> None:
    """SYNC of slower drives and a position that has begun: 200 us in which the ADC is silent."""
    data = load_rig(shipped("rigs/can.yaml")).model_dump()
    data["sensors"]["bus"] = data["drives"]["bus"] = "motion"
    both = RigConfig.model_validate(data)
    (motion,) = [b for b in budget(both, Path()).buses if b.name == "can motion"]
    assert motion.before_s == pytest.approx(200e-6)
    with pytest.raises(ConfigError, match="the highest rate that fits is 896 Hz"):
        check_budget(both, Path())


@pytest.mark.parametrize("kind", ["can", "canfd", "serial"])
def test_a_reading_that_is_missing_does_not_cost_the_setpoints(kind: str) -> None:
    path = shipped(f"rigs/{kind}.yaml")
    loaded = load_rig(path)
    period_s = 1.0 / loaded.rate_hz
    buses = budget(loaded, path.parent).buses
    answers = AnswerTime.of(Context(loaded, period_s, path.parent))
    assert max(b.answered_s for b in buses) <= answers.wait_s
    assert answers.wait_s + max(b.setpoints_s for b in buses) < period_s
    # However late a cycle begins, its answers are not waited for beyond its end.
    for late_s in (0.0, 0.3 * period_s, 0.9 * period_s, 3.0 * period_s):
        assert 0.0 <= answers.deadline_s(1.0, late_s) - 1.0 <= max(period_s - late_s, 0.0)


SLCAN = """
can: {main: {interface: slcan, channel: /dev/ttyUSB0, latency_s: 0OPTIONS}}
amplifiers: {backend: loopback}
sensors: {backend: can, bus: main}
drives: {backend: loopback}
sim: sim.yaml
"""


@pytest.mark.parametrize(
    ("options", "channel", "baud"),
    [
        ("", "/dev/ttyUSB0", 115_200),
        (", options: {tty_baudrate: 3000000}", "/dev/ttyUSB0", 3_000_000),
        (", options: {tty_baudrate: 9600}", "/dev/ttyUSB0@2000000", 2_000_000),
    ],
)
def test_characters_of_slcan_are_counted(options: str, channel: str, baud: int) -> None:
    text = SLCAN.replace("OPTIONS", options).replace("/dev/ttyUSB0", channel)
    (bus,) = budget(rig(text, 100.0), Path()).buses
    # Three readings of 22 characters and a Sync of 12 with two that confirm it, or the 135 and
    # 85 us on the bus if those are longer; a frame each way passes the other of the two as well.
    reading_s, longest_s, sync_s = 220 / baud, 240 / baud, 140 / baud
    needed = max(sync_s, 85e-6) + 3 * max(reading_s, 135e-6) + 2 * min(longest_s, 135e-6)
    assert bus.answers_s == pytest.approx(needed)


def test_slcan_at_its_usual_rate_does_not_carry_1_khz() -> None:
    with pytest.raises(ConfigError, match="more than the buses carry"):
        check_budget(rig(SLCAN.replace("OPTIONS", ""), 1000.0), Path())
