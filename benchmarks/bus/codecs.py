"""Encode and decode all frames of a cycle on CAN, against cantools, which knows no checksum.

All frames are those of the DBC, and of the drives a SYNC, targets and positions, whose layout
cantools gets in a DBC of its own. Before anything is timed, levid has to take every frame, and both
have to find the same bytes and the same values.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import cantools
import numpy as np

from levid.benchmarks.harness.table import Figure, Target, median_times
from levid.config.shipped import shipped
from levid.wire.can.can_frames import CanFrames, ValueFrames, load_frames
from levid.wire.can.cia402 import (
    ENABLE_OPERATION,
    POSITION_M,
    POSITION_RAD,
    RPDO,
    RPDO1_ID,
    SYNC_ID,
    TPDO,
    TPDO1_ID,
    sync_counter,
)

CYCLE, COILS = 5, 9
NODES = ((1, POSITION_M), (2, POSITION_M), (3, POSITION_RAD))
BATCHES = 100
LEAST_TIMES = 5.0
_STATUS, _PER_MILLE = 0x1637, 7
_SYNC_DBC = """
BO_ 128 CanopenSync: 1 Host
 SG_ counter : 0|8@1+ (1,0) [0|0] "" Drive
"""
_NODE_DBC = """
BO_ {rpdo} Target{node}: 6 Host
 SG_ controlword : 0|16@1+ (1,0) [0|0] "" Drive
 SG_ target : 16|32@1- ({unit},0) [0|0] "" Drive
BO_ {tpdo} Actual{node}: 8 Drive
 SG_ statusword : 0|16@1+ (1,0) [0|0] "" Host
 SG_ position : 16|32@1- ({unit},0) [0|0] "" Host
 SG_ force : 48|16@1- (0.001,0) [0|0] "" Host
"""
Frame = tuple[int, bytes]


class Cycle(NamedTuple):
    """What is sent and what comes in a cycle, as (ID, payload)."""

    sent: list[Frame]
    received: list[Frame]


def frames_of(frames: CanFrames, forces_n: np.ndarray, gaps_m: np.ndarray) -> Cycle:
    """Return all frames of a cycle with every role on this bus, drives included."""
    sent = [
        frames.sync.encode(CYCLE),
        *frames.setpoint.encode(forces_n, CYCLE, 0),
        (SYNC_ID, bytes((sync_counter(CYCLE),))),
        *_targets(0.02, 0.3),
    ]
    received = [
        *frames.gap.encode(gaps_m, CYCLE, 0),
        *frames.force.encode(forces_n, CYCLE, 0),
        *(
            (TPDO1_ID + node, TPDO.pack(_STATUS, round(0.01 * node / unit), _PER_MILLE))
            for node, unit in NODES
        ),
    ]
    return Cycle(sent, received)


def codec_figures(n: int) -> list[Figure]:
    """Return what it costs, in calls of which each contender has `n`."""
    rng = np.random.default_rng(1)
    figures: list[Figure] = []
    for fd, name, label in ((False, "can", "classic CAN"), (True, "canfd", "CAN FD")):
        contenders = _contenders(fd, rng.uniform(-9, 9, COILS), rng.uniform(-9e-4, 9e-4, COILS))
        us = median_us(contenders, n)
        ours, theirs = us["encode"] + us["decode"], us["cantools_encode"] + us["cantools_decode"]
        figures += [
            Figure(f"{name}_encode_us", us["encode"], "us", f"{label}: encode a cycle"),
            Figure(f"{name}_decode_us", us["decode"], "us", f"{label}: decode and check a cycle"),
            Figure(f"{name}_codec_us", ours, "us", f"{label}: both"),
            Figure(
                f"{name}_cantools_us",
                theirs,
                "us",
                f"{label}: both, cantools, no checks",
                f"{name}_codec_us",
            ),
            Figure(
                f"{name}_codec_times",
                theirs / ours,
                "",
                f"{label}: times as long cantools takes",
                target=Target(least=LEAST_TIMES),
            ),
        ]
    return figures


def median_us(contenders: dict[str, Callable[[], object]], n: int) -> dict[str, float]:
    """Return the time of a call in us: the median over BATCHES of the mean in each.

    The contenders take turns, batch by batch; each has `n` calls in all.
    """
    calls = max(n // BATCHES, 1)

    def batch(call: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            for _ in range(calls):
                call()

        return run

    found = median_times({name: batch(call) for name, call in contenders.items()}, BATCHES)
    return {name: 1e6 * seconds / calls for name, seconds in found.items()}


def _contenders(
    fd: bool, forces_n: np.ndarray, gaps_m: np.ndarray
) -> dict[str, Callable[[], object]]:
    frames = load_frames(None, COILS, COILS, fd)
    cycle = frames_of(frames, forces_n, gaps_m)
    gap, force = np.zeros(COILS), np.zeros(COILS)
    batches = [
        (group, [frame for frame in cycle.received if frame[0] in group.ids], out)
        for group, out in ((frames.gap, gap), (frames.force, force))
    ]
    positions = [data for can_id, data in cycle.received if can_id > TPDO1_ID]
    units = [unit for _, unit in NODES]

    def encode() -> list[Frame]:
        return [
            frames.sync.encode(CYCLE),
            *frames.setpoint.encode(forces_n, CYCLE, 0),
            (SYNC_ID, bytes((sync_counter(CYCLE),))),
            *_targets(0.02, 0.3),
        ]

    def decode() -> list[tuple[int, float, float]]:
        for group, batch, out in batches:
            group.begin()
            for can_id, data in batch:
                group.accept(can_id, data, CYCLE)
            group.finish(out)
        told = []
        for data, unit in zip(positions, units, strict=True):
            status, counts, per_mille = TPDO.unpack(data)
            told.append((status, counts * unit, 1e-3 * per_mille))
        return told

    database = cantools.database.load_file(str(shipped("levid.dbc")))
    pdos = _SYNC_DBC + "".join(
        _NODE_DBC.format(node=node, unit=unit, rpdo=RPDO1_ID + node, tpdo=TPDO1_ID + node)
        for node, unit in NODES
    )
    database.add_dbc_string(f'VERSION ""\nBU_: Host Drive\n{pdos}')
    message_of = database.get_message_by_frame_id
    sent = [(message_of(can_id), data) for can_id, data in cycle.sent]
    received = [(message_of(can_id), data) for can_id, data in cycle.received]
    numbers = [(message, message.decode(data, decode_choices=False)) for message, data in sent]

    def cantools_encode() -> list[bytes]:
        return [message.encode(values) for message, values in numbers]

    def cantools_decode() -> list[dict[str, Any]]:
        return [message.decode(data, decode_choices=False) for message, data in received]

    assert encode() == cycle.sent
    assert cantools_encode() == [data for _, data in cycle.sent]
    for group, batch, out in batches:
        _require_taken(group, batch, out)
    told = {k: v for signals in cantools_decode() for k, v in signals.items()}
    assert np.allclose(gap, [told[f"gap_{i}_m"] for i in range(COILS)], rtol=1e-12)
    assert np.allclose(force, [told[f"force_{i}_n"] for i in range(COILS)], rtol=1e-12)
    drives = [tuple(signals.values()) for signals in cantools_decode()[-len(NODES) :]]
    assert np.allclose(decode(), drives, rtol=1e-12)
    return {
        "encode": encode,
        "decode": decode,
        "cantools_encode": cantools_encode,
        "cantools_decode": cantools_decode,
    }


def _require_taken(group: ValueFrames, batch: list[Frame], out: np.ndarray) -> None:
    """Refusing a frame is quick, and no decoding."""
    group.begin()
    for can_id, data in batch:
        assert group.accept(can_id, data, CYCLE) is None
    assert group.finish(out) is None


def _targets(beam_m: float, rotor_rad: float) -> list[Frame]:
    """Return the targets of the drives, as levid.drivers.can.canopen_drives makes them."""
    places = (beam_m, beam_m, rotor_rad)
    return [
        (RPDO1_ID + node, RPDO.pack(ENABLE_OPERATION, round(place / unit)))
        for (node, unit), place in zip(NODES, places, strict=True)
    ]
