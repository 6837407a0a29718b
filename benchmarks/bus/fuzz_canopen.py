"""Noise into both ends of CANopen drives: what the host receives, and what emulated nodes are told.

Half of it is near what is right: words that are random alone end at the first check.
"""

from __future__ import annotations

import logging
import math
import struct
from pathlib import Path

import numpy as np

from levid.benchmarks.bus.mutations import Outcome, mutated
from levid.config.buses import CanDriveOptions
from levid.config.rig import RigConfig, load_rig
from levid.config.shipped import shipped
from levid.drivers.base import DriveError
from levid.drivers.can.bus_link import CanLink
from levid.drivers.can.canopen_drives import CanDrives
from levid.sim.electronics.drive_nodes import DriveNodes
from levid.sim.electronics.emulated_rig import Electronics
from levid.wire.can.kernel_frame import ReceivedFrame

RIG = shipped("rigs/canfd.yaml")
NODES = (1, 2, 3)
EMERGENCY, TPDO, RPDO, SDO, HEARTBEAT = 0x080, 0x180, 0x200, 0x600, 0x700
ENABLED, ENABLED_MASK = 0x27, 0x6F
BEAM_M, ROTOR_RAD, _MOST_COUNTS = 1e-9, 1e-7, 2**31
_BEAM_COUNTS, _SKEW_COUNTS = 10**8, 10**5  # within what the rig allows
_SLOW_BEAM, _SLOW_ROTOR = 10_000, 1_500  # what the rig's acceleration allows, mostly
CanFrame = tuple[int, bytes]


class Wire:
    """A bus that brings what it is given, and keeps what is sent."""

    def __init__(self) -> None:
        self.coming: list[ReceivedFrame] = []
        self.sent: list[CanFrame] = []

    def send(self, can_id: int, data: bytes) -> None:
        self.sent.append((can_id, data))

    def receive(self, _timeout_s: float) -> ReceivedFrame | None:
        return self.coming.pop(0) if self.coming else None

    def shutdown(self) -> None:
        return


def drives_heard(n: int, rng: np.random.Generator) -> Outcome:
    """Cycles of emergencies, heartbeats and PDOs as the host receives them; `n` frames in all.

    A cycle counts if all three positions came; the fault DRIVE must follow from what drives say in
    it, and from nothing else.
    """
    rig, options = rig_of_drives()
    link, wire = CanLink("main", rig.can[options.bus]), Wire()
    link._bus = wire  # type: ignore[assignment]
    drives = CanDrives(link, rig, options, Path(), 1 << 30, lambda: math.inf)
    beam, rotor = np.zeros(3), np.zeros(3)
    tried = accepted = wrong = 0
    while tried < n:
        speech, places = said(rng), positions(rng, slow=rng.random() < 0.3)
        tried += len(speech) + len(places)
        wire.coming = [ReceivedFrame(can_id, data, 0.0) for can_id, data in speech + places]
        wire.sent.clear()
        drives.watch.reset()
        drives._checked, drives._stopped, drives._sync_number = True, False, -1
        for axis in drives._axes:
            axis.begin(0)
        fault = False
        try:
            drives.sync(0)
            drives.read(beam, rotor)
        except DriveError:
            fault = True
        found = came(places)
        whole = len(found) == len(NODES)
        accepted += whole
        wrong += bool(drives.stale) == whole
        counts = [found[node][1] for node in NODES] if whole else [0, 0, 0]
        wrong += not _motion_is(beam, rotor, counts, 1.0 / rig.rate_hz, most_bends(rig))
        disabled = whole and any(found[i][0] & ENABLED_MASK != ENABLED for i in NODES)
        skew_m = abs(counts[0] * BEAM_M - counts[1] * BEAM_M)
        wrong += fault != (disabled or skew_m > options.skew_m or _complained(speech))
    return Outcome(tried, accepted, wrong, accepted / tried)


def nodes_told(n: int, rng: np.random.Generator) -> Outcome:
    """Frames to the emulated nodes, of any length: none of them ends anything."""
    rig, options = rig_of_drives()
    electronics = Electronics(rig, RIG.parent)
    answers: list[CanFrame] = []
    nodes = DriveNodes(
        rig, options, None, electronics.core, electronics.injector, lambda *f: answers.append(f)
    )
    logging.getLogger("canopen").setLevel(logging.CRITICAL)  # it logs every frame that is wrong
    wrong = answered = 0
    for _ in range(n):
        base = int(rng.choice([0x000, EMERGENCY, RPDO, SDO, HEARTBEAT, 0x300]))
        node = int(rng.integers(0, 5)) if base else 0
        data = rng.integers(0, 256, int(rng.integers(9)), np.uint8).tobytes()
        try:
            nodes.handle_frame(base + node, data)
            answers += nodes.sync()
        except Exception:  # noqa: BLE001 - it would end the thread that answers
            wrong += 1
        answered += bool(answers)
        wrong += any(len(sent) > 8 or not 0 <= can_id < 0x800 for can_id, sent in answers)
        answers.clear()
    wrong += not np.isfinite(electronics.core.motion).all()
    return Outcome(n, answered, wrong, answered / n)


def rig_of_drives() -> tuple[RigConfig, CanDriveOptions]:
    """Return the rig and what its drives are, which answer every SYNC."""
    rig = load_rig(RIG)
    found = rig.on_bus("drives")
    assert found is not None
    assert isinstance(found[1], CanDriveOptions)
    return rig, found[1].model_copy(update={"every": 1})


def most_bends(rig: RigConfig) -> tuple[float, float, float]:
    """Return by how much a position of X1, X2 and the rotor may bend in a cycle, in m and rad.

    Five times what its acceleration allows, and what four counts of rounding make of it: beyond
    that it stood still and made up for it.
    """
    beam, rotor = rig.limits.beam_acceleration_m_s2, rig.limits.rotor_acceleration_rad_s2
    per = 5.0 / rig.rate_hz**2
    x = per * beam + 4.0 * BEAM_M
    return x, x, per * rotor + 4.0 * ROTOR_RAD


def speed_of(p: float, last: tuple[float, float, float], period_s: float, most: float) -> float:
    """Return the speed at `p` after the `last` three, newest first: by the last period if bent."""
    a, b, c = last
    if bend_of(p, last) > most:
        return (p - a) / period_s
    return (11.0 * p - 18.0 * a + 9.0 * b - 2.0 * c) / (6.0 * period_s)


def bend_of(p: float, last: tuple[float, float, float]) -> float:
    """Return the larger of the last two second differences."""
    a, b, c = last
    return max(abs((p - a) - (a - b)), abs((a - b) - (b - c)))


def said(rng: np.random.Generator, quiet: float = 0.5) -> list[CanFrame]:
    """Return emergencies and heartbeats, none in this share of the cycles."""
    frames = []
    for _ in range(int(rng.integers(5)) if rng.random() >= quiet else 0):
        base = int(rng.choice([EMERGENCY, HEARTBEAT]))
        data = bytearray(rng.integers(0, 256, int(rng.integers(9)), np.uint8).tobytes())
        if base == EMERGENCY and rng.random() < 0.5:
            data = bytearray(8 if rng.random() < 0.5 else 7)  # no error; and too short for one
        elif data and rng.random() < 0.5:
            data[0] = int(rng.choice([0x00, 0x04, 0x05, 0x7F]))
        frames.append((base + int(rng.choice(NODES)), bytes(data)))
    return frames


def _complained(said: list[CanFrame]) -> bool:
    """Return whether a drive has an error, or is not, or no longer, operational."""
    error: dict[int, bool] = {}
    operational: set[int] = set()
    left = False
    for can_id, data in said:
        node = can_id & 0x7F
        if can_id & ~0x7F == EMERGENCY:
            if len(data) == 8:
                error[node] = data[:2] != b"\0\0"
        elif (state := data[0] & 0x7F if data else -1) == 5:
            operational.add(node)
        else:
            left |= state == 0 or node in operational
    return left or any(error.values())


def positions(
    rng: np.random.Generator,
    near: float = 0.7,
    calm: float = 0.5,
    skew: int = _SKEW_COUNTS,
    *,
    slow: bool = False,
) -> list[CanFrame]:
    """Return the PDOs of a cycle, in this share of them such as drives in operation send.

    All of them come, once and unchanged, in the share `calm`; else one is lost, repeated or cut.
    `skew`: how far X1 and X2 are from where the gantry is, in counts. `slow`: all stay about zero,
    so near that cycle after cycle they may be a motion.
    """
    as_is, near = rng.random() < calm, rng.random() < near
    most = (_SLOW_BEAM if slow else _BEAM_COUNTS) if near else _MOST_COUNTS
    skew = min(skew, _SLOW_BEAM) if slow else skew
    x = int(rng.integers(-most, most))
    frames = []
    for node in rng.permutation(NODES):
        counts = int(rng.integers(-_MOST_COUNTS, _MOST_COUNTS))
        if near and node != NODES[2]:
            counts = x + int(rng.integers(-skew, skew))
        elif near and slow:
            counts = int(rng.integers(-_SLOW_ROTOR, _SLOW_ROTOR))
        status = int(rng.integers(1 << 16))
        if near:
            status = status & ~ENABLED_MASK | ENABLED
        data = struct.pack("<Hih", status, counts, int(rng.integers(-(2**15), 2**15)))
        frames.append((TPDO + int(node), data))
    if as_is:
        return frames
    at = int(rng.integers(3))
    match int(rng.integers(3)):
        case 0:
            del frames[at]
        case 1:
            frames.insert(at, frames[int(rng.integers(3))])
        case 2:
            frames[at] = frames[at][0], mutated(frames[at][1], rng)
    return frames


def came(positions: list[CanFrame]) -> dict[int, tuple[int, int]]:
    """Return statusword and position of each node whose PDO came: the first that is whole."""
    came: dict[int, tuple[int, int]] = {}
    for can_id, data in positions:
        if len(data) == 8:
            came.setdefault(can_id & 0x7F, struct.unpack_from("<Hi", data))
    return came


def _motion_is(
    beam: np.ndarray,
    rotor: np.ndarray,
    counts: list[int],
    Ts_s: float,
    bends: tuple[float, float, float],
) -> bool:
    """Return whether these are the positions, and speeds of drives that were at rest at 0."""
    at = [c * unit for c, unit in zip(counts, (BEAM_M, BEAM_M, ROTOR_RAD), strict=True)]
    rest = 0.0, 0.0, 0.0
    v1, v2, omega = (speed_of(p, rest, Ts_s, most) for p, most in zip(at, bends, strict=True))
    told = [*beam[:2], *rotor[:2]]
    expected = [0.5 * (at[0] + at[1]), 0.5 * (v1 + v2), at[2], omega]
    # A micron of 2 m is 1e-6: of what differences of doubles lose, far less than 1e-9 is left.
    same = np.allclose(told, expected, rtol=1e-9, atol=1e-12)
    in_range = abs(beam[0]) <= _MOST_COUNTS * BEAM_M and abs(rotor[0]) <= _MOST_COUNTS * ROTOR_RAD
    return bool(same and in_range and np.isfinite([beam[2], rotor[2]]).all())
