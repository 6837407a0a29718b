"""Checks what candump saw: format and length of all frames, checksum and order of the DBC's."""

from __future__ import annotations

import re
import sys
from collections import Counter
from pathlib import Path

import cantools

from levid.config.shipped import shipped
from levid.wire.can.cia402 import (
    EMERGENCY_ID,
    HEARTBEAT_ID,
    NMT_ID,
    RPDO,
    RPDO1_ID,
    SDO_ANSWER_ID,
    SDO_REQUEST_ID,
    SYNC_COUNTER,
    SYNC_ID,
    TPDO,
    TPDO1_ID,
    DriveStates,
    Node,
    state_of,
)
from levid.wire.can.crc8 import FrameCrc

LINE = re.compile(r"\(\d+\.\d+\) vcan0 ([0-9A-F]{3})(?:#([0-9A-F]*)|##([0-9A-F])([0-9A-F]*))")
# A socket's queue holds some 270 frames, a cycle is three: who is further behind loses some.
FULL = 50
DATABASE = cantools.database.load_file(str(shipped("levid.dbc")))


NODES = (1, 2, 3)
CANOPEN = {NMT_ID: ("NMT", 2), SYNC_ID: ("SYNC", 1)} | {
    base + node: (name, length)
    for name, base, length in (
        ("emergency", EMERGENCY_ID, 8), ("TPDO", TPDO1_ID, TPDO.size),
        ("RPDO", RPDO1_ID, RPDO.size), ("SDO answer", SDO_ANSWER_ID, 8),
        ("SDO request", SDO_REQUEST_ID, 8), ("heartbeat", HEARTBEAT_ID, 1),
    )
    for node in NODES
}  # fmt: skip
"""Name and length by ID: the rig's drives count SYNCs."""


def of_canopen(can_id: int, data: bytes, line: str) -> str:
    """Return what a frame of CANopen is, and check what it says."""
    assert can_id in CANOPEN, f"nobody's frame: {line}"
    name, length = CANOPEN[can_id]
    assert len(data) == length, f"{name}: expected {length} bytes: {line}"
    if name == "SYNC":
        assert 1 <= data[0] <= SYNC_COUNTER, line
    elif name == "heartbeat":
        assert data[0] in frozenset(Node), line
        told[can_id, "heartbeat"] += 1
    elif name == "TPDO":
        state = state_of(TPDO.unpack(data)[0])
        assert state is not None, f"no state of CiA 402: {line}"
        told[can_id, state.name] += 1
        told[can_id, "TPDO"] += 1
        # Each SYNC is answered once at most, however late.
        assert told[can_id, "TPDO"] <= seen["SYNC"], line
    return name


def answered(crc: FrameCrc, data: bytes, before: list[int], line: str) -> int:
    """Return which Sync this answers: the next, or one behind those that a full queue lost."""
    first = before[-1] + 1 if before else 0
    for at in range(first, len(syncs)):
        if (syncs[at] ^ data[-2]) & 0xF == 0 and crc.of(data, syncs[at]) == data[-1]:
            lost = [i for i in range(first, at) if waiting[i] <= FULL]
            assert not lost, f"Sync {lost[0]} not answered, {waiting[lost[0]]} waited: {line}"
            return at
    raise AssertionError(f"an answer to no Sync from {first} on, of {len(syncs)}: {line}")


seen: Counter[str] = Counter()
told: Counter[tuple[int, str]] = Counter()
syncs: list[int] = []
waiting: list[int] = []  # Syncs that were not answered yet when each was sent
answers: dict[str, list[int]] = {"GapsFd": [], "ForcesFd": []}
for line in Path(sys.argv[1]).read_text().splitlines():
    assert not line.startswith("DROPCOUNT"), f"candump lost frames, nothing can be said: {line}"
    found = LINE.fullmatch(line.strip())
    assert found is not None, f"expected a frame of candump -L, found {line!r}"
    can_id, fd = int(found[1], 16), found[3] is not None
    data = bytes.fromhex(found[4] if fd else found[2])
    try:
        message = DATABASE.get_message_by_frame_id(can_id)
    except KeyError:
        assert not fd, f"CANopen is classic CAN: {line}"
        seen[of_canopen(can_id, data, line)] += 1
        continue
    seen[message.name] += 1
    assert fd == message.is_fd, f"{message.name}: {line}"
    assert len(data) == message.length, f"{message.name}: {line}"
    signals = message.decode(data, decode_choices=False)
    of_cycle = None
    crc = FrameCrc(can_id, len(data))
    if message.name in answers:
        answers[message.name].append(answered(crc, data, answers[message.name], line))
        continue
    of_cycle = syncs[-1] if "counter" in signals else None
    assert crc.of(data, of_cycle) == data[-1], f"{message.name}: {line}"
    if message.name == "Sync":
        done = answers["ForcesFd"]
        waiting.append(len(syncs) - (done[-1] + 1 if done else 0))
        syncs.append(int(signals["cycle"]))
    elif message.name == "SetpointsFd":
        # The host sends them between one Sync and the next, however late it is.
        assert signals["counter"] == syncs[-1] % 16, f"setpoints of another cycle: {line}"

of_dbc = ("Sync", "GapsFd", "ForcesFd", "SetpointsFd", "Request", "Answer")
for name in (*of_dbc, "NMT", "SYNC", "RPDO", "SDO request", "SDO answer"):
    assert seen[name], f"expected {name}, found {dict(seen)}"
for node in NODES:
    assert told[TPDO1_ID + node, DriveStates.OPERATION_ENABLED.name], f"node {node}: {told}"
    assert told[HEARTBEAT_ID + node, "heartbeat"], f"node {node}: {told}"
for name, found in answers.items():
    # The last may have come too late for candump.
    assert len(syncs) - found[-1] <= 2, f"{name}: nothing after Sync {found[-1]} of {len(syncs)}"
lost = len(syncs) - len(answers["GapsFd"])
print(
    f"{sum(seen.values())} frames, all well-formed; each Sync answered once and in order, but for "
    f"{lost} that a full queue lost: {dict(seen)}"
)
