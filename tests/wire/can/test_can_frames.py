"""CAN payloads are what the DBC says, byte for byte, and frames count only if all checks pass."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import cantools
import numpy as np
import pytest

from levid.config.base import ConfigError
from levid.config.shipped import shipped
from levid.wire.can.can_frames import CanFrames, ValueFrames, load_frames
from levid.wire.can.crc8 import FrameCrc, crc8
from levid.wire.frame_rejection_reasons import Rejected

DBC = shipped("levid.dbc")
DATABASE = cantools.database.load_file(str(DBC))


@pytest.fixture(params=[False, True], ids=["classic", "fd"])
def frames(request: pytest.FixtureRequest) -> CanFrames:
    return load_frames(None, 9, 9, request.param)


def groups(frames: CanFrames) -> list[ValueFrames]:
    return [frames.setpoint, frames.gap, frames.force]


def test_checksum_has_the_check_value_of_autosar() -> None:
    # AUTOSAR_SWS_CRCLibrary, CRC-8 with polynomial 0x2F: check value of "123456789"
    assert crc8(b"123456789") == 0xDF


@pytest.mark.parametrize("length", range(2, 65))
def test_checksum_two_bytes_a_step_is_that_of_one(length: int) -> None:
    data = np.random.default_rng(length).bytes(length)
    expected = crc8(struct.pack(">H", 0x123) + data[:-1])
    assert FrameCrc(0x123, length).of(data) == expected
    of_cycle = crc8(struct.pack(">HH", 0x123, 0xABC) + data[:-1])
    assert FrameCrc(0x123, length).of(data, 0xABCD) == of_cycle


def test_payloads_are_those_of_cantools(frames: CanFrames) -> None:
    rng = np.random.default_rng(1)
    for group in groups(frames):
        for cycle in (*range(20), 61_439):
            values = rng.uniform(-32000, 32000, 9) * group.unit
            decoded: dict[str, float] = {}
            for can_id, data in group.encode(values, cycle, cycle % 16):
                message = DATABASE.get_message_by_frame_id(can_id)
                signals = message.decode(data, decode_choices=False)
                assert message.encode(signals) == data
                assert (signals["counter"], signals["state"]) == (cycle % 16, cycle % 16)
                covered = struct.pack(">HH", can_id, cycle >> 4) + data[:-1]
                assert signals["crc"] == crc8(covered)
                decoded |= signals
            found = [v for k, v in decoded.items() if k.startswith(group.kind)]
            np.testing.assert_allclose(found, values, atol=0.51 * group.unit)


def test_fields_are_those_of_cantools(frames: CanFrames) -> None:
    for fields, name, numbers in (
        (frames.sync, "Sync", {"cycle": 61_439}),
        (frames.request, "Request", {"request": 1, "index": 7, "value": 0x12345678}),
        (frames.answer, "Answer", {"index": 252, "value": 0xFEDCBA98}),
        (frames.sensor_request, "SensorRequest", {"request": 3, "index": 18, "value": 0x89ABCDEF}),
        (frames.sensor_answer, "SensorAnswer", {"index": 16, "value": 0x12345678}),
    ):
        can_id, data = fields.encode(*numbers.values())
        message = DATABASE.get_message_by_name(name)
        assert (can_id, len(data)) == (message.frame_id, message.length)
        signals = message.decode(data, decode_choices=False)
        crc = crc8(struct.pack(">H", can_id) + data[:-1])
        assert signals == {**numbers, "crc": crc}
        assert message.encode(signals) == data
        assert fields.decode(data) == tuple(numbers.values())


def test_what_is_packed_is_unpacked(frames: CanFrames) -> None:
    values = np.linspace(-20.0, 20.0, 9)
    values[4] = np.nan
    out = np.zeros(9)
    for can_id, data in frames.force.encode(values, 37, 3):
        assert frames.force.accept(can_id, data, 37) is None
    assert frames.force.complete
    assert frames.force.finish(out) is None
    assert set(frames.force.states) == {3}
    np.testing.assert_allclose(out, values, atol=0.5001e-3)


def test_range_is_clipped_and_not_wrapped(frames: CanFrames) -> None:
    out = np.zeros(9)
    for can_id, data in frames.setpoint.encode(np.full(9, 1e6), 0, 0):
        frames.setpoint.accept(can_id, data, 0)
    frames.setpoint.finish(out)
    np.testing.assert_allclose(out, 32.767)


def test_every_bit_that_is_turned_is_found(frames: CanFrames) -> None:
    """A CRC-8 finds any single bit: at the latest by `finish`."""
    group, out = frames.gap, np.full(9, 7.0)
    sent = group.encode(np.linspace(-9e-4, 9e-4, 9), 5, 0)
    for at, (can_id, data) in enumerate(sent):
        for bit in range(8 * len(data)):
            turned = bytearray(data)
            turned[bit // 8] ^= 1 << bit % 8
            group.begin()
            others = [frame for i, frame in enumerate(sent) if i != at]
            assert all(group.accept(i, d, 5) is None for i, d in others)
            wrong = group.accept(can_id, bytes(turned), 5)
            assert wrong is Rejected.CHECKSUM or group.finish(out) is Rejected.CHECKSUM
            assert (out == 7.0).all()


def test_frames_that_do_not_count_say_why(frames: CanFrames) -> None:
    group = frames.gap
    (can_id, data), *_ = group.encode(np.zeros(9), 5, 0)
    assert group.accept(can_id, data[:-1], 5) is Rejected.LENGTH
    assert group.accept(can_id, data, 6) is Rejected.COUNTER
    assert group.accept(can_id, data, 5) is None
    assert group.accept(can_id, data, 5) is Rejected.REPEATED
    assert frames.sync.decode(b"\0\0\0") is Rejected.CHECKSUM
    assert frames.sync.decode(b"") is Rejected.LENGTH
    assert frames.sync.decode(frames.sync.encode(61_439)[1]) == (61_439,)
    for beyond in (61_440, 65_535):
        assert frames.sync.decode(frames.sync.encode(beyond)[1]) is Rejected.CYCLE


@pytest.mark.parametrize("late", [1, 15, 16, 17, 32, 63])
def test_frames_of_earlier_cycles_do_not_count_though_their_counter_fits(
    frames: CanFrames, late: int
) -> None:
    """The counter has four bits: of a frame that is 16 cycles late it says what it should."""
    group, out, cycle = frames.gap, np.full(9, 7.0), 5  # and the cycle has just gone round
    sent = group.encode(np.linspace(-9e-4, 9e-4, 9), (cycle - late) % 61_440, 0)
    reasons = [group.accept(can_id, data, cycle) for can_id, data in sent]
    if late % 16:
        assert set(reasons) == {Rejected.COUNTER}
    else:
        assert group.finish(out) is Rejected.CHECKSUM
        assert group.behind == late
    assert [group.age(can_id, data, cycle) for can_id, data in sent] == [late] * len(sent)
    assert (out == 7.0).all()


def test_frame_under_another_id_does_not_count() -> None:
    frames = load_frames(None, 9, 9, False)
    (_, first), (other_id, _), *_ = frames.gap.encode(np.full(9, 1e-4), 0, 0)
    out = np.zeros(9)
    sent = frames.gap.encode(np.full(9, 1e-4), 0, 0)
    for can_id, data in [sent[0], (other_id, first), sent[2]]:
        frames.gap.accept(can_id, data, 0)
    assert frames.gap.finish(out) is Rejected.CHECKSUM


@pytest.mark.parametrize(("coils", "count"), [(3, 1), (4, 2), (6, 2), (9, 3)])
def test_fewer_coils_take_fewer_frames(coils: int, count: int) -> None:
    frames = load_frames(None, coils, coils, False)
    sent = frames.setpoint.encode(np.full(coils, 1.0), 0, 0)
    assert len(sent) == count
    out = np.zeros(coils)
    for can_id, data in sent:
        assert frames.setpoint.accept(can_id, data, 0) is None
    assert frames.setpoint.finish(out) is None
    np.testing.assert_allclose(out, 1.0)


def test_length_that_no_can_fd_frame_has_is_refused(tmp_path: Path) -> None:
    """Six channels, counter and checksum are 14 bytes, which would go out as 16."""
    head, fd, tail = DBC.read_text().partition("BO_ 36 SetpointsFd: 20")
    body, rest, tail = tail.partition("BO_ 40 ")
    fd = fd.replace("20", "14")
    lines = [line for line in body.splitlines() if not re.search(r"setpoint_[678]_n", line)]
    body = "\n".join(lines)
    for old, new in (("144|4", "96|4"), ("148|4", "100|4"), ("152|8", "104|8")):
        body = body.replace(old, new)
    path = tmp_path / "six.dbc"
    path.write_text(head + fd + body + "\n\n" + rest + tail)
    with pytest.raises(ConfigError, match=r"SetpointsFd: expected at most 8 bytes.*found 14"):
        load_frames(path, 6, 6, True)


def test_more_coils_than_the_dbc_has_are_refused() -> None:
    with pytest.raises(ConfigError, match="expected classic CAN messages with setpoint_0_n to"):
        load_frames(None, 10, 9, False)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("BO_ 16 Sync: 3", "BO_ 16 Sink: 3", "expected a message Sync"),
        ("SG_ setpoint_1_n : 16|16@1-", "SG_ setpoint_1_n : 16|16@1+", "signed"),
        ("SG_ counter : 48|4@1+", "SG_ counter : 48|3@1+", "expected counter at bit 48, 4 bits"),
        (
            "setpoint_2_n : 32|16@1- (0.001",
            "setpoint_2_n : 32|16@1- (0.002",
            "expected one scale and no offset",
        ),
        ("gap_1_m", "gap_8_m", "expected consecutive channels"),
        ('VERSION "1"', "nonsense", "not a valid DBC"),
        ("BO_ 16 Sync", "BO_ 2147483664 Sync", "Sync: expected an 11-bit ID"),
        *(
            (
                "setpoint_0_n : 0|16@1- (0.001,0) [-32.767|32.767]",
                f"setpoint_0_n : 0|16@1- ({scale},0) [0|0]",
                "expected one scale|expected a scale above 0",
            )
            for scale in ("0", "-0.001", "1e999")
        ),
    ],
)
def test_dbc_that_does_not_fit_says_where(tmp_path: Path, old: str, new: str, words: str) -> None:
    text = DBC.read_text()
    assert old in text
    path = tmp_path / "other.dbc"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ConfigError, match=words) as error:
        load_frames(path, 9, 9, False)
    assert str(path) in str(error.value)


def other(tmp_path: Path, change: Callable[[str], str]) -> str:
    """Return what is said of the shipped DBC, changed so."""
    path = tmp_path / "other.dbc"
    path.write_text(change(DBC.read_text()))
    with pytest.raises(ConfigError) as error:
        load_frames(path, 9, 9, False)
    return str(error.value)


@pytest.mark.parametrize("scale", ["0", "-0.001", "1e999", "1e-320"])
def test_scale_that_leaves_no_number_is_refused(tmp_path: Path, scale: str) -> None:
    pattern = re.compile(r"(SG_ gap_\d_m : \d+\|16@1- )\([^)]*\)")
    said = other(tmp_path, lambda text: pattern.sub(rf"\1({scale},0)", text))
    assert "expected a scale above 0" in said


@pytest.mark.parametrize("name", ["Sync", "Gaps0"])
def test_message_without_its_signals_is_refused(tmp_path: Path, name: str) -> None:
    def bare(text: str) -> str:
        head, message, rest = re.split(rf"(?m)(^BO_ \d+ {name}: .*\n)", text)
        signals, end, rest = rest.partition("\n\n")
        kept = [line for line in signals.splitlines() if "gap_0_m" in line]
        number = message.split()[1]
        rest = re.sub(rf"(?m)^VAL_ {number} .*\n", "", rest)
        return head + message + "\n".join(kept) + end + rest

    assert f"{name}: expected " in other(tmp_path, bare)


def test_channels_that_two_messages_carry_are_refused(tmp_path: Path) -> None:
    def doubled(text: str) -> str:
        found = re.search(r"(?ms)^BO_ \d+ Gaps0: .*?\n\n", text)
        assert found is not None
        again = re.sub(r"BO_ \d+ Gaps0", "BO_ 1999 Gaps9", found[0])
        return text.replace(found[0], found[0] + again)

    assert "repeated" in other(tmp_path, doubled)
