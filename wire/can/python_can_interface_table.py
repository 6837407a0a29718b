"""Table of python-can's interfaces: latency, accuracy of timeouts, bit rates, CAN FD.

docs/can.md has the same table. An interface of another package is read by a thread of its own and
assumed to be as slow as an adapter on full-speed USB.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Literal

from ...config.base import ConfigError
from ...config.buses import CanBus
from .receive_thread import POLL_S

KERNEL_S = 2e-5
HIGH_SPEED_S, FULL_SPEED_S = 1.25e-4, 1e-3
"""A microframe and a frame of USB (USB 2.0, 4.9.2): the longest wait before a transfer."""
NETWORK_S = 1e-3
_NOMINAL = ("nom_brp", "nom_tseg1", "nom_tseg2", "nom_sjw")
_DATA = ("data_brp", "data_tseg1", "data_tseg2", "data_sjw")
_CLASSIC = ("brp", "tseg1", "tseg2", "sjw", "nof_samples")
_SLCAN_CLOCK_HZ = 60_000_000
"""Nominal clock, a multiple of all bit rates; no hardware has it."""


@dataclass(frozen=True)
class AdapterLine:
    """A serial line between host and adapter, and the bytes of a frame on it."""

    option: str
    baud: int
    head: int
    """Bytes of a frame without its data."""
    per_byte: int = 1
    confirmed: int = 0
    """Bytes that confirm a sent frame."""
    in_channel: bool = False
    """Whether the channel may contain the rate: `channel@baud`."""

    def rate(self, bus: CanBus) -> int:
        """Return the rate in bit/s, read as python-can does; raises ConfigError."""
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
        """Return the time of a frame with `length` data bytes in s, at ten bits per byte."""
        confirmed = self.confirmed if sent else 0
        return 10 * (self.head + self.per_byte * length + confirmed) / baud


@dataclass(frozen=True)
class Adapter:
    """Properties of a python-can interface."""

    latency_s: float
    """Time added to a cycle, unless RIG.yaml has `latency_s`."""
    punctual: bool = False
    """Whether a timeout of less than 1 ms ends on time."""
    fd: Literal["no", "yes", "timing"] = "no"
    """Whether it carries CAN FD; "timing": only with all bit segments as options."""
    bitrates: tuple[int, ...] = ()
    """Bit rates supported without bit segments as options; empty if any rate is."""
    fd_bitrates: tuple[int, ...] = ()
    data_bitrates: tuple[int, ...] = ()
    line: AdapterLine | None = None
    numbered: tuple[str, ...] | None = None
    """The channel has to be an integer unless one of these options selects it; None: any text."""
    windows: bool = False


_KERNEL = Adapter(KERNEL_S, punctual=True, fd="yes")
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
    "neousys": Adapter(KERNEL_S, punctual=True),
    "socketcand": Adapter(NETWORK_S, punctual=True),
    # On Linux python-can waits on the file descriptor of the driver.
    "pcan": Adapter(HIGH_SPEED_S, punctual=True, fd="timing", bitrates=_PCAN_RATES),
    # Timeouts are rounded down to 1 ms, and python-can polls for the rest.
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
    # tIIILDD..\r, confirmed by \r or z\r (Lawicel CANUSB manual)
    "slcan": Adapter(
        FULL_SPEED_S,
        fd="yes",
        bitrates=_SLCAN_RATES,
        fd_bitrates=tuple(rate for rate in _SLCAN_RATES if rate != 83_300),
        data_bitrates=(2_000_000, 5_000_000),
        line=AdapterLine("tty_baudrate", 115_200, 6, per_byte=2, confirmed=2, in_channel=True),
    ),
    # 0xAA twice, 17 bytes of frame, 0x55 twice; escape bytes in data, ID and checksum.
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
    """Return the properties of an interface; worst-case values for other packages' ones."""
    return ADAPTERS.get(interface, _UNKNOWN)


def latency_s(bus: CanBus) -> float:
    """Return the time that adapter and host add to a cycle, in s."""
    return adapter_of(bus.interface).latency_s if bus.latency_s is None else bus.latency_s


def check_bus(where: str, bus: CanBus) -> None:
    """Raise ConfigError if python-can would reject the bus, or open it with other settings."""
    from can import VALID_INTERFACES

    known = sorted({*VALID_INTERFACES, *ADAPTERS})
    if bus.interface not in known:
        near = get_close_matches(bus.interface, known, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ConfigError(
            f"{where}.interface: expected one of python-can ({', '.join(known)}) or of a package "
            f"that adds one, found '{bus.interface}'{hint}"
        )
    adapter = adapter_of(bus.interface)
    if adapter.windows and sys.platform != "win32":
        raise ConfigError(
            f"{where}.interface: python-can supports {bus.interface} on Windows only; use "
            "socketcan if the kernel has a driver for the adapter"
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
            f"{where}.data_bitrate: {bus.interface} of python-can carries classic CAN only, found "
            f"{bus.data_bitrate}; remove it, or use socketcan if the kernel has a driver for the "
            "adapter"
        )
    _check_rates(where, bus, adapter)


def arguments(bus: CanBus) -> dict[str, Any]:
    """Return the arguments of can.Bus besides interface, channel and bit rate."""
    found: dict[str, Any] = dict(bus.options)
    if bus.fd:
        found |= {"fd": True, "data_bitrate": bus.data_bitrate}
    elif bus.interface == "udp_multicast":
        found |= {"fd": False}  # its default is CAN FD
    if bus.interface == "slcan":
        # Its read timeout is that of the port, by default 1 ms.
        found.setdefault("timeout", POLL_S)
        if bus.data_bitrate is not None and not _has_timing(bus, _NOMINAL + _DATA):
            from can import BitTimingFd

            # python-can reads only the rates of the timing; the firmware sets the bit segments.
            found["timing"] = BitTimingFd.from_sample_point(
                _SLCAN_CLOCK_HZ, bus.bitrate, 80.0, bus.data_bitrate, 80.0
            )
    return found


def _check_number(where: str, bus: CanBus) -> None:
    try:
        int(bus.channel)
    except ValueError:
        raise ConfigError(
            f"{where}.channel: expected the number of the adapter for {bus.interface}, from 0, "
            f"found '{bus.channel}'"
        ) from None


def _check_rates(where: str, bus: CanBus, adapter: Adapter) -> None:
    """Raise ConfigError for rates that the interface does not support or its options contradict."""
    if bus.fd and _has_timing(bus, _NOMINAL + _DATA):
        _compare(where, "bitrate", bus.bitrate, _rate(where, bus, _NOMINAL))
        _compare(where, "data_bitrate", bus.data_bitrate, _rate(where, bus, _DATA))
        return
    if bus.fd and adapter.fd == "timing":
        raise ConfigError(
            f"{where}.options: {bus.interface} needs f_clock, {', '.join(_NOMINAL + _DATA)} for "
            f"CAN FD, found {', '.join(bus.options) or 'none'}"
        )
    if not bus.fd and _has_timing(bus, _CLASSIC):
        _compare(where, "bitrate", bus.bitrate, _rate(where, bus, _CLASSIC))
        return
    if "tseg1" in bus.options:  # the interface applies it at any rate
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
                f"{where}.{key}: expected a rate of {bus.interface} "
                f"({', '.join(map(str, known))}){own}, found {found}"
            )


def _has_timing(bus: CanBus, parts: tuple[str, ...]) -> bool:
    """Return whether the options have all bit segments, which python-can uses then."""
    clock = "f_clock" in bus.options or (bus.interface == "pcan" and "f_clock_mhz" in bus.options)
    return clock and all(part in bus.options for part in parts)


def _rate(where: str, bus: CanBus, parts: tuple[str, ...]) -> float:
    """Return the bit rate of the bit segments `parts` in the options, in bit/s."""
    options = bus.options
    try:
        clock = float(options.get("f_clock") or 1e6 * float(options["f_clock_mhz"]))
        prescaler, tseg1, tseg2 = (int(options[part]) for part in parts[:3])
        return clock / (prescaler * (1 + tseg1 + tseg2))
    except (ValueError, ZeroDivisionError):
        raise ConfigError(
            f"{where}.options: expected numbers in f_clock, {', '.join(parts)}"
        ) from None


def _compare(where: str, key: str, given: int | None, computed: float) -> None:
    if given is None or abs(computed - given) > 0.001 * given:
        raise ConfigError(
            f"{where}.{key}: expected {computed:g}, as computed from options, found {given}"
        )
