"""Faults that the emulated electronics play on command, and what each of them does."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from .core import Core

AXES = ("x1", "x2", "phi")


class InjectionError(Exception):
    """A fault that does not exist, or that lacks its argument."""


@dataclass(frozen=True)
class FaultKind:
    """What a fault does, and the argument it takes: nothing, a number, or an axis."""

    does: str
    argument: str = ""


FAULTS: dict[str, FaultKind] = {
    "drop": FaultKind("answers are not sent"),
    "drop-setpoints": FaultKind("setpoints are not heard"),
    "delay": FaultKind("answers are sent a cycle late"),
    "corrupt": FaultKind("a bit of every answer is turned"),
    "repeat": FaultKind("the answers of the cycle before are sent again instead of new ones"),
    "reorder": FaultKind("the answers of two cycles change places"),
    "bus-off": FaultKind(
        "the host's CAN controller leaves the bus; on a serial port nobody hears or sends"
    ),
    "disconnect": FaultKind("the port is closed, or the devices leave the bus without a word"),
    "stuck": FaultKind("a sensor channel is stuck, which the ADC's self-test finds", "channel"),
    "frozen": FaultKind(
        "a sensor channel repeats its reading, which no self-test finds", "channel"
    ),
    "saturated": FaultKind("a sensor channel reads the end of its range", "channel"),
    "trip": FaultKind("a coil's amplifier trips", "channel"),
    "encoder": FaultKind("the encoder of a drive is lost", "axis"),
    "skew": FaultKind("X1 and X2 drift apart by so many metres", "metres"),
    "push": FaultKind("somebody pushes the platform up with so many newtons", "newtons"),
}


class Injector:
    """Switches faults of one set of electronics; `clear` ends all of them."""

    def __init__(self, core: Core) -> None:
        self._core = core
        self.wire: set[str] = set()
        """Faults of bus and port at hand."""

    def command(self, line: str) -> str:
        """Carry out a line such as `trip 3`, `drop` or `clear`; return what was done.

        Raises:
            InjectionError: the line is not understood.
        """
        name, *arguments = line.split()
        if name == "clear":
            self.clear()
            return "clear"
        kind = FAULTS.get(name)
        if kind is None:
            raise InjectionError(f"expected clear or one of {', '.join(FAULTS)}, found '{name}'")
        if bool(arguments) != bool(kind.argument) or len(arguments) > 1:
            raise InjectionError(f"{name}: expected {kind.argument or 'no argument'}")
        injected = self._core.injected
        with self._core.lock:
            match kind.argument:
                case "channel":
                    count = self._core.coils if name == "trip" else self._core.sensors
                    channel = _whole(name, arguments[0], count)
                    {
                        "stuck": injected.stuck,
                        "frozen": injected.frozen,
                        "saturated": injected.saturated,
                        "trip": injected.tripping,
                    }[name].add(channel)
                case "axis":
                    if arguments[0] not in AXES:
                        raise InjectionError(f"{name}: expected one of {', '.join(AXES)}")
                    injected.lost_axes.add(AXES.index(arguments[0]))
                case "metres":
                    injected.skew_m = _number(name, arguments[0])
                case "newtons":
                    injected.push_n = _number(name, arguments[0])
                case _:
                    self.wire.add(name)
        return line

    def clear(self) -> None:
        """End all faults; what tripped stays off until it is reset."""
        with self._core.lock:
            self.wire.clear()
            injected = self._core.injected
            for channels in (
                injected.stuck, injected.frozen, injected.saturated,
                injected.tripping, injected.lost_axes,
            ):  # fmt: skip
                channels.clear()
            injected.skew_m = injected.push_n = 0.0

    @property
    def hears(self) -> bool:
        """Whether anything arrives."""
        return not self.wire & {"bus-off", "disconnect"}


class Outgoing:
    """The answers of one bus on their way out, through the faults of the wire.

    A batch is what answers one cycle: frames of whatever kind, each with its payload last.
    """

    def __init__(self, injector: Injector) -> None:
        self._injector = injector
        self._held: deque[list[tuple[int, bytes]]] = deque(maxlen=2)
        self._last: list[tuple[int, bytes]] = []

    def through(  # noqa: PLR0911 - one a fault
        self, batch: list[tuple[int, bytes]]
    ) -> list[tuple[int, bytes]]:
        """Return the frames that leave now."""
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
            return [(can_id, _with_a_bit_turned(data)) for can_id, data in batch]
        return batch


def _with_a_bit_turned(data: bytes) -> bytes:
    """Turn a bit of the first value; in a stuffed frame never into a zero, which would cut it."""
    turned = bytearray(data)
    for i in range(1, len(turned)):
        if turned[i] not in (0, 1):
            turned[i] ^= 1
            return bytes(turned)
    turned[0] ^= 1
    return bytes(turned)


def _whole(name: str, text: str, count: int) -> int:
    if not text.isdecimal() or int(text) >= count:
        raise InjectionError(f"{name}: expected a channel from 0 to {count - 1}, found '{text}'")
    return int(text)


def _number(name: str, text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InjectionError(f"{name}: expected a finite number, found '{text}'")
    return number
