"""Worst-case time of a cycle on a CAN bus, for the bus budget, and faster layouts of the buses.

Frame lengths follow Davis et al., Real-Time Systems 35, 2007, and ISO 11898-1:2015.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from ...config.backends import ROLES
from ...config.base import ConfigError
from ...config.buses import CanBus, CanDriveOptions, RoleOptions
from ...config.rig import RigConfig, Role
from ..bus_budget import Budget, BusTime, budget
from .can_frames import ValueFrames, load_frames
from .cia402 import RPDO, TPDO
from .python_can_interface_table import adapter_of, latency_s

_DRIVES = 3
_SYNC_BYTES = 1
_SLOW_DRIVES = 4
"""Cycles per drive SYNC in the suggested layouts."""
_FD_BITRATE = 5_000_000


def bus_time(rig: RigConfig, name: str, roles: Mapping[str, RoleOptions], folder: Path) -> BusTime:
    """Return the time of a cycle on CAN bus `name` with these roles.

    Raises:
        ConfigError: the DBC cannot be used.
    """
    bus, geometry = rig.can[name], rig.geometry
    dbc = folder / bus.dbc if bus.dbc else None
    frames = load_frames(dbc, len(geometry.coil_x_m), len(geometry.sensors_x_m), bus.fd)
    frame_s = _FrameTime(bus)

    def all_s(values: ValueFrames, *, sent: bool = False) -> float:
        return sum(frame_s(frame.length, sent=sent) for frame in values.frames)

    answers, setpoints, unawaited, before = 0.0, 0.0, 0.0, 0.0
    if "amplifiers" in roles or "sensors" in roles:
        answers += frame_s(frames.sync.length, sent=True)
    if "amplifiers" in roles:
        answers += all_s(frames.force)
        setpoints += all_s(frames.setpoint, sent=True)
    if "sensors" in roles:
        answers += all_s(frames.gap)
    drives = roles.get("drives")
    if isinstance(drives, CanDriveOptions):
        read_s = frame_s(_SYNC_BYTES, sent=True) + _DRIVES * frame_s(TPDO.size)
        write_s = _DRIVES * frame_s(RPDO.size, sent=True)
        if drives.every == 1:
            answers += read_s
            setpoints += write_s
        else:  # reading and writing fall into different cycles
            unawaited += max(read_s, write_s)
            # The drives' SYNC precedes the answers, and a frame on the bus is not interrupted.
            before = frame_s(_SYNC_BYTES, sent=True) + frame_s(TPDO.size)
    answers += frame_s.passing_s(max(frame.length for frame in frames.gap.frames))
    return BusTime(f"can {name}", answers, setpoints, unawaited, latency_s(bus), before)


def alternatives(rig: RigConfig, folder: Path) -> Iterator[str]:
    """Yield layouts of the rig's CAN roles, each with the highest rate that it carries."""
    on_can = _options(rig)
    yield from _single_bus_limit(rig, on_can, folder)
    for layout, rate_hz in _layouts(rig, on_can, folder):
        enough = " (enough)" if rate_hz >= rig.rate_hz else ""
        yield f"{layout}: {int(rate_hz)} Hz{enough}"


def can_frame_s(length: int, bitrate: float) -> float:
    """Return the longest time of a classic CAN frame with an 11-bit ID, gap included, in s.

    `length` is in bytes. 8 n + 44 bits, of which 34 + 8 n are stuffed: after the first, at most
    every fourth adds a stuff bit (Tindell and Burns 1994; Davis et al. 2007, eq. 1). The gap is 3
    bits.
    """
    return (8 * length + 44 + (34 + 8 * length - 1) // 4 + 3) / bitrate


def canfd_frame_s(length: int, bitrate: float, data_bitrate: float) -> float:
    """Return the longest time of a CAN FD frame with an 11-bit ID, gap included, in s.

    `length` is in bytes; the bit rate is switched (ISO 11898-1:2015). At the nominal rate: 17 bits
    from start of frame to BRS with 4 stuff bits, 10 bits after the checksum, and a gap of 3 bits.
    At the data rate: ESI, DLC and data, where every fourth bit may add a stuff bit, then stuff
    count (4) and checksum (17 bits, above 16 bytes 21) with a fixed stuff bit before every fourth.
    """
    body = 5 + 8 * length
    checksum = 4 + (17 if length <= 16 else 21)
    fast = body + body // 4 + checksum + -(-checksum // 4)
    return (17 + 4 + 10 + 3) / bitrate + fast / data_bitrate


class _FrameTime:
    """Time of a frame on a bus, or on the line to its adapter if that takes longer."""

    def __init__(self, bus: CanBus) -> None:
        self._bus, self._line = bus, adapter_of(bus.interface).line
        self._baud = self._line.rate(bus) if self._line is not None else 0

    def __call__(self, length: int, *, sent: bool = False) -> float:
        return max(self._bus_s(length), self._line_s(length, sent=sent))

    def passing_s(self, longest: int) -> float:
        """Return the extra time of the faster of bus and line, one frame each way.

        Frames pass both, one after the other.
        """
        return 2.0 * min(self._bus_s(longest), self._line_s(longest, sent=True))

    def _bus_s(self, length: int) -> float:
        bus = self._bus
        if bus.data_bitrate is not None and length > 8:
            return canfd_frame_s(length, bus.bitrate, bus.data_bitrate)
        return can_frame_s(length, bus.bitrate)

    def _line_s(self, length: int, *, sent: bool) -> float:
        return self._line.frame_s(length, self._baud, sent=sent) if self._line is not None else 0.0


def _options(rig: RigConfig) -> dict[str, RoleOptions]:
    found = {role: rig.on_bus(role) for role in ROLES}
    return {role: on[1] for role, on in found.items() if on is not None and on[0] == "can"}


def _single_bus_limit(
    rig: RigConfig, on_can: Mapping[str, RoleOptions], folder: Path
) -> Iterator[str]:
    """Yield the rate of one CAN FD bus without adapter latency if the rig's rate exceeds it."""
    bus = rig.can[next(iter(on_can.values())).bus]
    data_bitrate = max(bus.data_bitrate or 0, _FD_BITRATE)
    ideal = bus.model_copy(
        update={
            "interface": "socketcan",
            "bitrate": 1_000_000,
            "data_bitrate": data_bitrate,
            "latency_s": 0.0,
            "dbc": bus.dbc if bus.fd else None,
        }
    )
    moved = _moved(rig, dict.fromkeys(on_can, "one"), _drive_cycles(on_can), {"one": ideal})
    with suppress(ConfigError):  # a DBC of the rig's own may have no frames for CAN FD
        cycle_s = Budget((bus_time(moved, "one", _options(moved), folder),)).cycle_s
        if cycle_s * rig.rate_hz > 1.0:
            rate = f"{rig.rate_hz / 1e3:g} kHz" if rig.rate_hz >= 1e3 else f"{rig.rate_hz:g} Hz"
            yield (
                f"{rate} exceeds a single CAN bus: CAN FD at {data_bitrate / 1e6:g} Mbit/s carries "
                f"at most {int(1.0 / cycle_s)} Hz"
            )


def _layouts(
    rig: RigConfig, on_can: Mapping[str, RoleOptions], folder: Path
) -> Iterator[tuple[str, float]]:
    """Yield layouts of the roles on CAN, each with its highest rate in Hz."""
    one = dict.fromkeys(ROLES, "one")
    two = {"amplifiers": "one", "sensors": "two", "drives": "two"}
    three = dict(zip(ROLES, ("one", "two", "three"), strict=True))
    every = _drive_cycles(on_can)
    buses = [rig.can[option.bus] for option in on_can.values()]
    fd = all(bus.fd for bus in buses)
    kind = "CAN FD" if fd else "classic CAN"
    slow = f" and drives read every {every} cycles" if every else ""
    choices: list[tuple[str, Mapping[str, str], int | None, bool]] = [
        (f"one bus of {kind}{slow}", one, every, False),
        (f"two buses of {kind} (amplifiers on their own){slow}", two, every, False),
        (f"three buses of {kind}, one for each role", three, None, False),
    ]
    if not fd and all(adapter_of(bus.interface).fd != "no" for bus in buses):
        choices += [
            (f"one bus of CAN FD at 5 Mbit/s{slow}", one, every, True),
            (f"two buses of CAN FD (amplifiers on their own){slow}", two, every, True),
        ]
    for layout, names, cycles, with_fd in choices:
        can: dict[str, CanBus] = {}
        for role, option in on_can.items():
            bus = rig.can[option.bus]
            if with_fd and not bus.fd:
                bus = bus.model_copy(update={"data_bitrate": _FD_BITRATE, "dbc": None})
            can[names[role]] = bus
        with suppress(ConfigError):  # a DBC of the rig's own may have no frames for the layout
            found = budget(_moved(rig, {r: names[r] for r in on_can}, cycles, can), folder)
            yield layout, 1.0 / found.cycle_s


def _drive_cycles(on_can: Mapping[str, RoleOptions]) -> int | None:
    """Return the cycles per drive SYNC of a layout with slow drives, None without CAN drives."""
    drives = on_can.get("drives")
    return max(_SLOW_DRIVES, drives.every) if isinstance(drives, CanDriveOptions) else None


def _moved(
    rig: RigConfig, names: Mapping[str, str], every: int | None, can: Mapping[str, CanBus]
) -> RigConfig:
    """Return the rig with its CAN roles on the buses `can`, by name for each role in `names`."""
    update: dict[str, object] = {"can": dict(can)}
    for role, name in names.items():
        options = {**getattr(rig, role).options, "bus": name}
        if role == "drives" and every is not None:
            options["every"] = every
        update[role] = Role(backend="can", **options)
    return rig.model_copy(update=update)
