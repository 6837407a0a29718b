"""How long a cycle keeps each bus of a rig busy, at worst, and the fastest rate that leaves.

A cycle is: SYNC, answers, control, setpoints. Answers of different buses come at the same time, and
so do setpoints, but setpoints follow answers: the period must hold the longest of either, and each
bus all of its own. Drives that are asked in every n-th cycle only are not waited for. Heartbeats
and requests are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..config.base import ConfigError
from ..config.buses import CanBus, CanDriveOptions, RoleOptions, SerialBus
from ..config.rig import RigConfig
from .can.adapters import adapter_of, latency_s
from .can.can_frames import ValueFrames, load_frames
from .can.cia402 import RPDO, TPDO
from .device_protocol import ROLES
from .serial.serial_frames import FrameContents

LONGEST_WAIT = 0.8
"""Share of a period for which answers are waited for at most: they have to fit into it."""
_DRIVES = 3
_SYNC_BYTES = 1
_SLOW_DRIVES = 4
_FD_BITRATE = 5_000_000
_TOLD_S = 1e-4
"""A latency above this is worth a word where the wire is too slow."""


def can_frame_s(length: int, bitrate: float) -> float:
    """Return the longest a classic CAN frame of `length` bytes takes, 11-bit ID, gap included.

    8 n + 44 bits, of which 34 + 8 n are stuffed: after the first, every fourth may bring one more
    (Tindell and Burns 1994; Davis et al., Real-Time Systems 35, 2007, eq. 1). Three bits follow.
    """
    return (8 * length + 44 + (34 + 8 * length - 1) // 4 + 3) / bitrate


def canfd_frame_s(length: int, bitrate: float, data_bitrate: float) -> float:
    """Return the longest a CAN FD frame with bit rate switch takes, 11-bit ID, gap included.

    ISO 11898-1:2015. At the nominal rate: 17 bits from start of frame to BRS with 4 stuff bits, and
    after the checksum 10 bits and a gap of 3. At the data rate: ESI, DLC and data, every fourth of
    which may bring a stuff bit, then stuff count (4) and checksum (17 bits, beyond 16 bytes 21)
    with a fixed stuff bit before every fourth.
    """
    body = 5 + 8 * length
    checksum = 4 + (17 if length <= 16 else 21)
    fast = body + body // 4 + checksum + -(-checksum // 4)
    return (17 + 4 + 10 + 3) / bitrate + fast / data_bitrate


def serial_s(length: int, baud: float) -> float:
    """Return how long `length` bytes take with a start and a stop bit each."""
    return 10 * length / baud


@dataclass(frozen=True)
class BusTime:
    """What a cycle takes of one bus, in s.

    `answers` and `setpoints` are waited for one after the other; `others` only fill the bus, but
    in some cycles `before` of them comes before the answers, and the rate has to hold those too.
    """

    name: str
    answers_s: float
    setpoints_s: float
    others_s: float
    latency_s: float
    before_s: float = 0.0

    @property
    def answered_s(self) -> float:
        """How long after a cycle's begin the last answer may come, latency included."""
        return self.before_s + self.answers_s + self.latency_s

    @property
    def busy_s(self) -> float:
        """How long the bus is busy in the fullest cycle, latency included."""
        return self.answers_s + self.setpoints_s + self.others_s + self.latency_s


@dataclass(frozen=True)
class Budget:
    """All buses of a rig; none for a rig that is on no bus."""

    buses: tuple[BusTime, ...]

    @property
    def cycle_s(self) -> float:
        """The shortest period that carries a cycle, 0 where there is no bus."""
        if not self.buses:
            return 0.0
        answered_s = max(b.answered_s for b in self.buses)
        in_turn = answered_s + max(b.setpoints_s for b in self.buses)
        return max(in_turn, answered_s / LONGEST_WAIT, *(b.busy_s for b in self.buses))


def budget(rig: RigConfig, folder: Path) -> Budget:
    """Return the budget of a rig; `folder` is where its relative paths start (ConfigError)."""
    return Budget(tuple(_buses(rig, _options(rig), rig.can, folder)))


def check_budget(rig: RigConfig, folder: Path) -> Budget:
    """Return the budget of a rig.

    Raises:
        ConfigError: its rate is faster than the buses carry; says what would fit.
    """
    found = budget(rig, folder)
    if found.cycle_s * rig.rate_hz <= 1.0:
        return found
    buses = ", ".join(map(_busy, found.buses))
    lines = [
        f"rate_hz: {rig.rate_hz:g} Hz is more than the wire carries: a cycle takes "
        f"{1e3 * found.cycle_s:.3f} ms at worst ({buses}); the fastest rate that fits is "
        f"{_rate(found.cycle_s)} Hz"
    ]
    lines += _no_single_bus(rig, folder)
    for how, other in _others(rig, folder):
        enough = " (enough)" if other.cycle_s * rig.rate_hz <= 1.0 else ""
        lines.append(f"{how}: {_rate(other.cycle_s)} Hz{enough}")
    raise ConfigError("; ".join(lines))


def _rate(cycle_s: float) -> str:
    return f"{int(1.0 / cycle_s)}"


def _busy(bus: BusTime) -> str:
    adapter = f", {1e3 * bus.latency_s:.3f} ms of it latency_s" if bus.latency_s > _TOLD_S else ""
    return f"{bus.name} is busy for {1e3 * bus.busy_s:.3f} ms{adapter}"


def _no_single_bus(rig: RigConfig, folder: Path) -> Iterator[str]:
    """Yield words for a rate that these roles reach on no single bus, whatever its adapter."""
    on_can = {r: o for r, (backend, o) in _options(rig).items() if backend == "can"}
    if not on_can:
        return
    bus = rig.can[next(iter(on_can.values())).bus]
    data_bitrate = max(bus.data_bitrate or 0, _FD_BITRATE)
    plain = bus.model_copy(
        update={
            "interface": "socketcan",
            "bitrate": 1_000_000,
            "data_bitrate": data_bitrate,
            "latency_s": 0.0,
            "dbc": bus.dbc if bus.fd else None,
        }
    )
    slow = {role: _moved(option, "one", _slow(on_can)) for role, option in on_can.items()}
    with suppress(ConfigError):  # a DBC of its own may have no frames for it
        cycle_s = Budget((_can(rig, "one", plain, slow, folder),)).cycle_s
        if cycle_s * rig.rate_hz > 1.0:
            rate = f"{rig.rate_hz / 1e3:g} kHz" if rig.rate_hz >= 1e3 else f"{rig.rate_hz:g} Hz"
            yield (
                f"{rate} fits no single CAN bus: CAN FD at {data_bitrate / 1e6:g} Mbit/s carries "
                f"{_rate(cycle_s)} Hz at most"
            )


def _options(rig: RigConfig) -> dict[str, tuple[str, RoleOptions]]:
    """Return backend and options of the roles that are on a bus."""
    return {role: found for role in ROLES if (found := rig.on_bus(role)) is not None}


def _buses(
    rig: RigConfig,
    options: Mapping[str, tuple[str, RoleOptions]],
    can: Mapping[str, CanBus],
    folder: Path,
) -> Iterator[BusTime]:
    names = dict.fromkeys((backend, option.bus) for backend, option in options.values())
    for backend, name in names:
        on = {r: o for r, (b, o) in options.items() if (b, o.bus) == (backend, name)}
        if backend == "serial":
            yield _serial(rig, name, rig.serial[name], on)
        else:
            yield _can(rig, name, can[name], on, folder)


def _serial(rig: RigConfig, name: str, bus: SerialBus, on: Mapping[str, RoleOptions]) -> BusTime:
    contents = FrameContents.of(rig, on)
    # The setpoints are the sync: they go out first, and nothing follows the answer.
    sent = serial_s(contents.on_wire(contents.cycle_bytes), bus.baud)
    came = serial_s(contents.on_wire(contents.readings_bytes), bus.baud)
    return BusTime(f"serial {name}", sent + came, 0.0, 0.0, bus.latency_s)


def _can(
    rig: RigConfig, name: str, bus: CanBus, on: Mapping[str, RoleOptions], folder: Path
) -> BusTime:
    dbc = folder / bus.dbc if bus.dbc else None
    geometry = rig.geometry
    frames = load_frames(dbc, len(geometry.coil_x_m), len(geometry.sensors_x_m), bus.fd)

    frame_s = _FrameTime(bus)

    def all_s(values: ValueFrames, *, sent: bool = False) -> float:
        return sum(frame_s(frame.length, sent=sent) for frame in values.frames)

    answers, setpoints, others, before = 0.0, 0.0, 0.0, 0.0
    if "amplifiers" in on or "sensors" in on:
        answers += frame_s(frames.sync.length, sent=True)
    if "amplifiers" in on:
        answers += all_s(frames.force)
        setpoints += all_s(frames.setpoint, sent=True)
    if "sensors" in on:
        answers += all_s(frames.gap)
    drives = on.get("drives")
    if isinstance(drives, CanDriveOptions):
        read_s = frame_s(_SYNC_BYTES, sent=True) + _DRIVES * frame_s(TPDO.size)
        write_s = _DRIVES * frame_s(RPDO.size, sent=True)
        if drives.every == 1:
            answers += read_s
            setpoints += write_s
        else:  # reading and writing fall into different cycles
            others += max(read_s, write_s)
            # SYNC goes before the answers, and a frame that has begun is not cut off.
            before = frame_s(_SYNC_BYTES, sent=True) + frame_s(TPDO.size)
    answers += frame_s.passing_s(max(frame.length for frame in frames.gap.frames))
    return BusTime(f"can {name}", answers, setpoints, others, latency_s(bus), before)


class _FrameTime:
    """How long a frame keeps a bus busy, or the line to its adapter where that takes longer."""

    def __init__(self, bus: CanBus) -> None:
        self._bus, self._line = bus, adapter_of(bus.interface).line
        self._baud = self._line.rate(bus) if self._line is not None else 0

    def __call__(self, length: int, *, sent: bool = False) -> float:
        return max(self._bus_s(length), self._line_s(length, sent=sent))

    def passing_s(self, longest: int) -> float:
        """Return what a way out and one back take longer than the slower of bus and line.

        Frames pass both, one behind the other: the quicker one counts for one frame each way.
        """
        return 2.0 * min(self._bus_s(longest), self._line_s(longest, sent=True))

    def _bus_s(self, length: int) -> float:
        bus = self._bus
        if bus.data_bitrate is not None and length > 8:
            return canfd_frame_s(length, bus.bitrate, bus.data_bitrate)
        return can_frame_s(length, bus.bitrate)

    def _line_s(self, length: int, *, sent: bool) -> float:
        return self._line.frame_s(length, self._baud, sent=sent) if self._line is not None else 0.0


def _slow(options: Mapping[str, RoleOptions]) -> int | None:
    """Return in every how many cycles slow drives are asked, None where there are none."""
    drives = options.get("drives")
    return max(_SLOW_DRIVES, drives.every) if isinstance(drives, CanDriveOptions) else None


def _moved(option: RoleOptions, bus: str, every: int | None) -> RoleOptions:
    """Return a role's options on another bus, with drives asked every so many cycles."""
    update: dict[str, object] = {"bus": bus}
    if every is not None and isinstance(option, CanDriveOptions):
        update["every"] = every
    return option.model_copy(update=update)


def _others(rig: RigConfig, folder: Path) -> Iterator[tuple[str, Budget]]:
    """Yield what else could be done with the roles that are on CAN, and its budget."""
    options = _options(rig)
    on_can = {role: option for role, (backend, option) in options.items() if backend == "can"}
    if not on_can:
        return

    def variant(buses: Mapping[str, str], every: int | None, fd: bool) -> Budget:
        moved = dict(options)
        can: dict[str, CanBus] = {}
        for role, option in on_can.items():
            moved[role] = "can", _moved(option, buses[role], every)
            bus = rig.can[option.bus]
            if fd and not bus.fd:
                bus = bus.model_copy(update={"data_bitrate": _FD_BITRATE, "dbc": None})
            can[buses[role]] = bus
        return Budget(tuple(_buses(rig, moved, can, folder)))

    one = dict.fromkeys(ROLES, "one")
    two = {"amplifiers": "one", "sensors": "two", "drives": "two"}
    three = dict(zip(ROLES, ("one", "two", "three"), strict=True))
    slow = _slow(on_can)
    fd = all(rig.can[option.bus].fd for option in on_can.values())
    kind = "CAN FD" if fd else "classic CAN"
    # What would fit is a hint: a rig with a DBC of its own may have none for the other format.
    said = f" and drives asked every {slow} cycles" if slow else ""
    choices: list[tuple[str, Mapping[str, str], int | None, bool]] = [
        (f"with one bus of {kind}{said}", one, slow, False),
        (f"with two buses of {kind} (amplifiers apart){said}", two, slow, False),
        (f"with three buses of {kind}, one a role", three, None, False),
    ]
    if not fd and all(adapter_of(rig.can[o.bus].interface).fd != "no" for o in on_can.values()):
        choices += [
            (f"with one bus of CAN FD at 5 Mbit/s{said}", one, slow, True),
            (f"with two buses of CAN FD (amplifiers apart){said}", two, slow, True),
        ]
    for how, buses, every, with_fd in choices:
        with suppress(ConfigError):
            yield how, variant(buses, every, with_fd)
