"""Checks what candump saw: format, length, checksum and order of every frame but CANopen's."""

from __future__ import annotations

import re
import sys
from collections import Counter
from pathlib import Path

import cantools

from levid.config.shipped import shipped
from levid.wire.crc import FrameCrc

LINE = re.compile(r"\(\d+\.\d+\) vcan0 ([0-9A-F]{3})(?:#([0-9A-F]*)|##([0-9A-F])([0-9A-F]*))")
DATABASE = cantools.database.load_file(str(shipped("levid.dbc")))

seen: Counter[str] = Counter()
syncs: list[int] = []
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
        seen["CANopen"] += 1
        assert not fd, f"CANopen is classic CAN: {line}"
        assert can_id == 0 or can_id >= 0x80, line
        continue
    seen[message.name] += 1
    assert fd == message.is_fd, f"{message.name}: {line}"
    assert len(data) == message.length, f"{message.name}: {line}"
    signals = message.decode(data, decode_choices=False)
    of_cycle = None
    if message.name in answers:
        # Each Sync is answered once and in order, however late.
        of_cycle = syncs[len(answers[message.name])]
    elif "counter" in signals:
        of_cycle = syncs[-1]
    assert FrameCrc(can_id, len(data)).of(data, of_cycle) == data[-1], f"{message.name}: {line}"
    if message.name == "Sync":
        syncs.append(int(signals["cycle"]))
    elif message.name in answers:
        answers[message.name].append(int(signals["counter"]))
    elif message.name == "SetpointsFd":
        # The host sends them between one Sync and the next, however late it is.
        assert signals["counter"] == syncs[-1] % 16, f"setpoints of another cycle: {line}"

for name in ("Sync", "GapsFd", "ForcesFd", "SetpointsFd", "CANopen", "Request", "Answer"):
    assert seen[name], f"expected {name}, found {dict(seen)}"
for name, counters in answers.items():
    # Each Sync is answered once and in order; the last may have come too late for candump.
    assert counters == [s % 16 for s in syncs[: len(counters)]], (
        f"{name}: not the counters of the Syncs, in order"
    )
    assert len(syncs) - len(counters) <= 1, f"{name}: {len(counters)} for {len(syncs)} Syncs"
print(f"{sum(seen.values())} frames, all well-formed, every Sync answered in order: {dict(seen)}")
