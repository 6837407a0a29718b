"""Inject faults into emulated electronics: table of faults, commands, faults of the bus."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from ..simulated_hand import HOLDS
from .emulated_devices import Core
from .faulty_actuators import SLOW_S

AXES = ("x1", "x2", "phi")


class InjectionError(Exception):
    """An unknown fault, or one with a missing or invalid argument."""


@dataclass(frozen=True)
class FaultKind:
    """Effect of a fault, and its argument: none, a channel, an axis or a number; or two of them."""

    does: str
    argument: str = ""


FAULTS: dict[str, FaultKind] = {
    "drop": FaultKind("answers are not sent"),
    "drop-setpoints": FaultKind("setpoints are ignored"),
    "delay": FaultKind("answers are sent a cycle late"),
    "corrupt": FaultKind("a bit of every answer is inverted"),
    "repeat": FaultKind("answers of the previous cycle are sent instead of new ones"),
    "reorder": FaultKind("answers of two cycles are sent in reverse order"),
    "bus-off": FaultKind(
        "the host's CAN controller goes bus-off; a serial port neither receives nor sends"
    ),
    "disconnect": FaultKind("the port is closed, or the devices leave the CAN bus"),
    "stuck": FaultKind("a sensor channel is stuck, detected by the ADC's self-test", "channel"),
    "frozen": FaultKind(
        "a sensor channel repeats its reading, or all do, not detected by the ADC's self-test",
        "channel",
    ),
    "off": FaultKind("a sensor reads too high by a distance", "channel metres"),
    "saturated": FaultKind("a sensor channel reads the end of its range", "channel"),
    "trip": FaultKind("a coil's amplifier trips", "channel"),
    "coil-force": FaultKind("an amplifier drives this force in N, whatever is set", "coil=number"),
    "coil-gain": FaultKind("an amplifier drives this multiple of its setpoint", "coil=number"),
    "coil-offset": FaultKind("an amplifier adds this force in N to its setpoint", "coil=number"),
    "jam": FaultKind("a drive does not move and reports no fault", "axis"),
    "slow": FaultKind(f"a drive follows with a lag of {SLOW_S:g} s and reports no fault", "axis"),
    "encoder": FaultKind("the encoder of a drive is lost", "axis"),
    "skew": FaultKind("X1 and X2 differ by a distance", "metres"),
    "push": FaultKind("an external force pushes the platform up", "newtons"),
    "lift": FaultKind("a hand lifts the platform to its upper stops: all, x, y, or rest", "hold"),
}


class Injector:
    """Switches faults of the electronics on; `clear` switches all off."""

    def __init__(self, core: Core) -> None:
        self._core = core
        self.wire: set[str] = set()
        """Active faults of bus and port."""

    def command(self, line: str) -> str:
        """Execute a line such as `trip 3`, `drop` or `clear`; return the line.

        Raises:
            InjectionError: the fault is unknown, or its argument is missing or invalid.
        """
        name, *arguments = line.split()
        if name == "clear":
            self.clear()
            return "clear"
        kind = FAULTS.get(name)
        if kind is None:
            raise InjectionError(f"expected clear or one of {', '.join(FAULTS)}, found '{name}'")
        if len(arguments) != len(kind.argument.split()):
            raise InjectionError(f"{name}: expected {kind.argument or 'no argument'}")
        with self._core.lock:
            self._inject(name, kind.argument, arguments)
        return line

    def _inject(self, name: str, argument: str, arguments: list[str]) -> None:
        injected = self._core.injected
        match argument:
            case "channel metres":
                channel = _channel(name, arguments[0], self._core.sensors)
                injected.off_m[channel] = _number(name, arguments[1])
            case "channel":
                count = self._core.coils if name == "trip" else self._core.sensors
                whole = (name, *arguments) == ("frozen", "all")
                channels = range(count) if whole else [_channel(name, arguments[0], count)]
                {
                    "stuck": injected.stuck,
                    "frozen": injected.frozen,
                    "saturated": injected.saturated,
                    "trip": injected.tripping,
                }[name].update(channels)
            case "axis":
                axis = _one_of(name, arguments[0], AXES)
                if name == "encoder":
                    injected.lost_axes.add(axis)
                else:
                    injected.actuators.delay_drive(name, AXES[axis])
            case "coil=number":
                coil, _, number = arguments[0].partition("=")
                channel = _channel(name, coil, self._core.coils)
                injected.actuators.set_force(name, channel, _number(name, number))
            case "metres":
                injected.skew_m = _number(name, arguments[0])
            case "hold":
                injected.hold = HOLDS[_one_of(name, arguments[0], HOLDS)]
            case "newtons":
                injected.push_n = _number(name, arguments[0])
            case _:
                self.wire.add(name)

    def clear(self) -> None:
        """Clear all faults; tripped amplifiers stay off until the host resets them."""
        with self._core.lock:
            self.wire.clear()
            injected = self._core.injected
            for channels in (
                injected.stuck, injected.frozen, injected.saturated, injected.off_m,
                injected.tripping, injected.lost_axes,
            ):  # fmt: skip
                channels.clear()
            injected.skew_m = injected.push_n = 0.0
            injected.hold = "rest"
            self._core.repair_actuators()

    @property
    def receives(self) -> bool:
        """Whether frames of the host arrive."""
        return not self.wire & {"bus-off", "disconnect"}


class Outgoing:
    """Applies the faults of the bus to the answers of the electronics.

    A batch has the frames that answer one cycle: (ID, payload).
    """

    def __init__(self, injector: Injector) -> None:
        self._injector = injector
        self._held: deque[list[tuple[int, bytes]]] = deque(maxlen=2)
        self._last: list[tuple[int, bytes]] = []

    def through(  # noqa: PLR0911 - one a fault
        self, batch: list[tuple[int, bytes]]
    ) -> list[tuple[int, bytes]]:
        """Return the frames to send now."""
        wire = self._injector.wire
        last, self._last = self._last, batch
        if not wire:
            self._held.clear()
            return batch
        if wire & {"drop", "bus-off", "disconnect"}:
            return []
        if "repeat" in wire:
            self._last = last or batch
            return self._last
        if "delay" in wire:
            self._held.append(batch)
            return self._held.popleft() if len(self._held) > 1 else []
        if "reorder" in wire:
            if not self._held:
                self._held.append(batch)
                return []
            return batch + self._held.popleft()
        if "corrupt" in wire:
            return [(can_id, _with_inverted_bit(data)) for can_id, data in batch]
        return batch


def _with_inverted_bit(data: bytes) -> bytes:
    """Invert a bit of the first value; never create a zero byte, which would end a COBS frame."""
    turned = bytearray(data)
    for i in range(1, len(turned)):
        if turned[i] not in (0, 1):
            turned[i] ^= 1
            return bytes(turned)
    turned[0] ^= 1
    return bytes(turned)


def _channel(name: str, text: str, count: int) -> int:
    if not text.isdecimal() or int(text) >= count:
        raise InjectionError(f"{name}: expected a channel from 0 to {count - 1}, found '{text}'")
    return int(text)


def _one_of(name: str, text: str, choices: Sequence[str]) -> int:
    if text not in choices:
        raise InjectionError(f"{name}: expected one of {', '.join(choices)}")
    return choices.index(text)


def _number(name: str, text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InjectionError(f"{name}: expected a finite number, found '{text}'")
    return number
