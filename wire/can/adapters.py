"""What is known of each interface of python-can: how it waits, what it adds, what it can carry.

docs/can.md has the same as a table. What an interface of another package is like nobody knows: it
is read by a thread of its own, and held to be as slow as an adapter on full-speed USB.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Literal

from ...config.base import ConfigError
from ...config.buses import CanBus
from .read_ahead import LOOK_S

AT_ONCE_S = 2e-5
HIGH_SPEED_S, FULL_SPEED_S = 1.25e-4, 1e-3
"""A microframe and a frame of USB (2.0, 4.9.2): a transfer that is asked for begins within one."""
NETWORK_S = 1e-3
_NOMINAL = ("nom_brp", "nom_tseg1", "nom_tseg2", "nom_sjw")
_DATA = ("data_brp", "data_tseg1", "data_tseg2", "data_sjw")
_CLASSIC = ("brp", "tseg1", "tseg2", "sjw", "nof_samples")
_SLCAN_CLOCK_HZ = 60_000_000
"""Of no hardware: one that all its rates divide."""


@dataclass(frozen=True)
class AdapterLine:
    """A serial line between host and adapter, which each frame passes as so many bytes."""

    option: str
    baud: int
    head: int
    """Bytes of a frame besides its data."""
    per_byte: int = 1
    confirmed: int = 0
    """Bytes that come back for each frame that is sent."""
    in_channel: bool = False
    """Whether `channel@baud` names the rate too."""

    def rate(self, bus: CanBus) -> int:
        """Return its rate in bit/s, as python-can reads it; raises ConfigError."""
        found: Any = bus.options.get(self.option, self.baud)
        if self.in_channel and "@" in str(bus.channel):
            found = str(bus.channel).split("@")[1]
        try:
            baud = int(found)
        except ValueError:
            baud = 0
        if baud <= 0:
            raise ConfigError(f"options.{self.option}: expected a rate in bit/s, found {found}")
        return baud

    def frame_s(self, length: int, baud: int, *, sent: bool) -> float:
        """Return how long a frame of `length` bytes takes: ten bits a byte."""
        confirmed = self.confirmed if sent else 0
        return 10 * (self.head + self.per_byte * length + confirmed) / baud


@dataclass(frozen=True)
class Adapter:
    """An interface of python-can."""

    latency_s: float
    """What it adds to a cycle, unless the rig says what it does."""
    punctual: bool = False
    """Whether it waits by parts of a millisecond, or at least never longer than asked."""
    fd: Literal["no", "yes", "timing"] = "no"
    """Whether it carries CAN FD; "timing": with all segments of a bit as options alone."""
    bitrates: tuple[int, ...] = ()
    """Rates that it knows without those; none where it takes any."""
    fd_bitrates: tuple[int, ...] = ()
    data_bitrates: tuple[int, ...] = ()
    line: AdapterLine | None = None
    numbered: tuple[str, ...] | None = None
    """Its channel is a whole number, unless one of these options says which one is meant."""
    windows: bool = False


_KERNEL = Adapter(AT_ONCE_S, punctual=True, fd="yes")
_WINDOWS = Adapter(FULL_SPEED_S, windows=True, fd="yes")
_UNKNOWN = Adapter(FULL_SPEED_S, fd="yes")
_SLCAN_RATES = (
    10_000, 20_000, 50_000, 83_300, 100_000, 125_000, 250_000, 500_000, 750_000, 1_000_000,
)  # fmt: skip
_PCAN_RATES = (
    10_000, 20_000, 33_000, 47_000, 50_000, 83_000, 95_000, 100_000, 125_000, 250_000, 500_000,
    800_000, 1_000_000,
)  # fmt: skip
_KVASER_RATES = (
    10_000, 50_000, 62_000, 83_000, 100_000, 125_000, 250_000, 500_000, 1_000_000,
)  # fmt: skip

ADAPTERS: Mapping[str, Adapter] = {
    "levid_local": _KERNEL,
    "socketcan": _KERNEL,
    "udp_multicast": _KERNEL,
    "virtual": _KERNEL,
    "neousys": Adapter(AT_ONCE_S, punctual=True),
    "socketcand": Adapter(NETWORK_S, punctual=True),
    # On Linux it selects on the driver's descriptor.
    "pcan": Adapter(HIGH_SPEED_S, punctual=True, fd="timing", bitrates=_PCAN_RATES),
    # It rounds down to milliseconds, and asks again and again for the rest.
    "kvaser": Adapter(
        HIGH_SPEED_S,
        punctual=True,
        fd="yes",
        bitrates=_KVASER_RATES,
        fd_bitrates=(500_000, 1_000_000),
        data_bitrates=(500_000, 1_000_000, 2_000_000, 4_000_000, 8_000_000),
        numbered=(),
    ),
    "neovi": Adapter(HIGH_SPEED_S, fd="yes"),
    "canalystii": Adapter(FULL_SPEED_S),
    "cantact": Adapter(FULL_SPEED_S, numbered=()),
    "gs_usb": Adapter(FULL_SPEED_S, numbered=("index", "bus", "address")),
    # tIIILDD..\r, and \r or z\r for each that was sent (Lawicel CANUSB manual)
    "slcan": Adapter(
        FULL_SPEED_S,
        fd="yes",
        bitrates=_SLCAN_RATES,
        fd_bitrates=tuple(rate for rate in _SLCAN_RATES if rate != 83_300),
        data_bitrates=(2_000_000, 5_000_000),
        line=AdapterLine("tty_baudrate", 115_200, 6, per_byte=2, confirmed=2, in_channel=True),
    ),
    # Two bytes of 0xAA, 17 of the frame, two of 0x55; an escape before data, ID and checksum.
    "robotell": Adapter(
        FULL_SPEED_S, line=AdapterLine("ttyBaudrate", 115_200, 23, in_channel=True)
    ),
    "seeedstudio": Adapter(FULL_SPEED_S, line=AdapterLine("baudrate", 2_000_000, 5)),
    "serial": Adapter(FULL_SPEED_S, line=AdapterLine("baudrate", 115_200, 11)),
    **dict.fromkeys(
        ("etas", "iscan", "ixxat", "nican", "nixnet", "systec", "usb2can", "vector"), _WINDOWS
    ),
}


def adapter_of(interface: str) -> Adapter:
    """Return what is known of an interface; of one of another package, the worst."""
    return ADAPTERS.get(interface, _UNKNOWN)


def latency_s(bus: CanBus) -> float:
    """Return what adapter and host add to a cycle."""
    return adapter_of(bus.interface).latency_s if bus.latency_s is None else bus.latency_s


def check_bus(where: str, bus: CanBus) -> None:
    """Raise ConfigError for a bus that python-can would refuse, or open otherwise than it says."""
    from can import VALID_INTERFACES

    known = sorted({*VALID_INTERFACES, *ADAPTERS})
    if bus.interface not in known:
        near = get_close_matches(bus.interface, known, 1)
        hint = f"; {near[0]} is near" if near else ""
        raise ConfigError(
            f"{where}.interface: expected one of python-can ({', '.join(known)}) or of a package "
            f"that adds one, found '{bus.interface}'{hint}"
        )
    adapter = adapter_of(bus.interface)
    if adapter.windows and sys.platform != "win32":
        raise ConfigError(
            f"{where}.interface: python-can has {bus.interface} on Windows alone; where the kernel "
            "has a driver for the adapter it is socketcan"
        )
    if adapter.numbered is not None and not any(key in bus.options for key in adapter.numbered):
        _check_number(where, bus)
    if adapter.line is not None:
        try:
            adapter.line.rate(bus)
        except ConfigError as error:
            raise ConfigError(f"{where}.{error}") from None
    if bus.fd and adapter.fd == "no":
        raise ConfigError(
            f"{where}.data_bitrate: expected none, since {bus.interface} of python-can carries "
            f"classic CAN alone, found {bus.data_bitrate}; where the kernel has a driver for the "
            "adapter, socketcan carries CAN FD"
        )
    _check_rates(where, bus, adapter)


def arguments(bus: CanBus) -> dict[str, Any]:
    """Return what python-can's interface is given besides channel and rate."""
    found: dict[str, Any] = dict(bus.options)
    if bus.fd:
        found |= {"fd": True, "data_bitrate": bus.data_bitrate}
    elif bus.interface == "udp_multicast":
        found |= {"fd": False}  # it would send CAN FD unless told otherwise
    if bus.interface == "slcan":
        # It waits for bytes by the port's own time, of a millisecond unless told otherwise.
        found.setdefault("timeout", LOOK_S)
        if bus.data_bitrate is not None and not _given(bus, _NOMINAL + _DATA):
            from can import BitTimingFd

            # It takes rates out of a timing alone; what a bit is made of its firmware says.
            found["timing"] = BitTimingFd.from_sample_point(
                _SLCAN_CLOCK_HZ, bus.bitrate, 80.0, bus.data_bitrate, 80.0
            )
    return found


def _check_number(where: str, bus: CanBus) -> None:
    try:
        int(bus.channel)
    except ValueError:
        raise ConfigError(
            f"{where}.channel: expected the number that {bus.interface} gives it, counted from 0, "
            f"found '{bus.channel}'"
        ) from None


def _check_rates(where: str, bus: CanBus, adapter: Adapter) -> None:
    """Raise ConfigError for rates that the interface does not know, or that its options deny."""
    if bus.fd and _given(bus, _NOMINAL + _DATA):
        _compare(where, "bitrate", bus.bitrate, _rate(where, bus, _NOMINAL))
        _compare(where, "data_bitrate", bus.data_bitrate, _rate(where, bus, _DATA))
        return
    if bus.fd and adapter.fd == "timing":
        raise ConfigError(
            f"{where}.options: expected f_clock, {', '.join(_NOMINAL + _DATA)}, without which "
            f"{bus.interface} opens no CAN FD, found {', '.join(bus.options) or 'none'}"
        )
    if not bus.fd and _given(bus, _CLASSIC):
        _compare(where, "bitrate", bus.bitrate, _rate(where, bus, _CLASSIC))
        return
    if "tseg1" in bus.options:  # of an interface that takes it for any rate
        return
    rates = adapter.fd_bitrates if bus.fd else adapter.bitrates
    parts = _NOMINAL + _DATA if bus.fd else _CLASSIC
    for key, found, known in (
        ("bitrate", bus.bitrate, rates),
        ("data_bitrate", bus.data_bitrate, adapter.data_bitrates),
    ):
        if known and found is not None and found not in known:
            own = (
                ""
                if bus.interface == "slcan" and key == "data_bitrate"
                else (f", or f_clock, {', '.join(parts)} in options")
            )
            raise ConfigError(
                f"{where}.{key}: expected a rate that {bus.interface} knows "
                f"({', '.join(map(str, known))}){own}, found {found}"
            )


def _given(bus: CanBus, parts: tuple[str, ...]) -> bool:
    """Return whether the options say what a bit is made of, so that python-can goes by that."""
    clock = "f_clock" in bus.options or (bus.interface == "pcan" and "f_clock_mhz" in bus.options)
    return clock and all(part in bus.options for part in parts)


def _rate(where: str, bus: CanBus, parts: tuple[str, ...]) -> float:
    """Return the rate of a bit that is made of these, in bit/s."""
    options = bus.options
    try:
        clock = float(options.get("f_clock") or 1e6 * float(options["f_clock_mhz"]))
        prescaler, tseg1, tseg2 = (int(options[part]) for part in parts[:3])
        return clock / (prescaler * (1 + tseg1 + tseg2))
    except (ValueError, ZeroDivisionError):
        raise ConfigError(
            f"{where}.options: expected numbers in f_clock, {', '.join(parts)}"
        ) from None


def _compare(where: str, key: str, said: int | None, made: float) -> None:
    if said is None or abs(made - said) > 0.001 * said:
        raise ConfigError(f"{where}.{key}: expected {made:g}, as options make it, found {said}")
