"""The three roles a backend can play, and what a backend is; devices hide behind these."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..config.rig import RigConfig
from ..log.signals import Stale

Array = NDArray[np.float64]


class Sync(Protocol):
    """Begins a cycle."""

    def __call__(self, cycle: int, late_s: float = 0.0, /) -> None:
        """Begin the cycle of that number, which was due `late_s` ago."""


class DriverError(Exception):
    """A device or bus that cannot be used; the message says which, and what it did."""


class LinkError(DriverError):
    """A bus or port that is gone; it is opened anew when the fault is cleared."""


class StaleError(DriverError):
    """Readings that did not come, or not as they should, in more cycles in a row than allowed."""


class AmplifierError(DriverError):
    """Amplifiers that tripped, or switched off although force was asked of them."""


class SensorError(DriverError):
    """A sensor channel without a reading, stuck, or at the end of its range."""


class DriveError(DriverError):
    """A drive that does not follow: encoder lost, emergency, skew of the gantry."""


class CoilAmplifiers(ABC):
    """Nine (or as many) coil amplifiers that take forces and tell the forces they drive."""

    # Plain numbers: the flags themselves take a microsecond to combine.
    STALE = int(Stale.AMPLIFIERS)
    stale: int = 0
    """Bits of the log's `stale` after `read`: STALE where it filled in an earlier reading."""

    @abstractmethod
    def write(self, coil_n: Array) -> None:
        """Command coil forces (C,) in N; they act from the next cycle on."""

    @abstractmethod
    def read(self, coil_n: Array) -> None:
        """Fill `coil_n` (C,) with current times the nominal force constant, in N."""

    def release(self, zero_n: Array) -> None:
        """Command zero force, `zero_n` (C,), at once, without waiting for a cycle."""
        self.write(zero_n)


class PositionSensors(ABC):
    """Position sensors that tell the platform's height at their places."""

    STALE = int(Stale.SENSORS)
    stale: int = 0
    """As in CoilAmplifiers."""

    @abstractmethod
    def read(self, gap_m: Array) -> None:
        """Fill `gap_m` (S,) with heights above the working point, up positive, in m."""


class ManipulatorDrives(ABC):
    """The beam's gantry (X1 and X2 as one) and the rotor on it."""

    STALE = int(Stale.DRIVES)
    stale: int = 0
    """As in CoilAmplifiers."""

    @abstractmethod
    def write(self, beam: Array, rotor: Array) -> None:
        """Command position, velocity, acceleration: beam (3,) in m, m/s, m/s2, rotor in rad."""

    @abstractmethod
    def read(self, beam: Array, rotor: Array) -> None:
        """Fill beam (3,) with m, m/s, N and rotor (3,) with rad, rad/s, N m."""

    def release(self) -> None:
        """Go nowhere any more: brake and switch off, or stay; at once where the device can.

        What was written before is forgotten. Until the backend has recovered nothing else holds
        beam and rotor. Drives that have nothing to let go of do nothing.
        """
        return


@dataclass(frozen=True)
class Context:
    """What a backend is built from: the rig, the loop's period, and where relative paths start."""

    rig: RigConfig
    period_s: float
    folder: Path


class Backend(ABC):
    """One kind of connection, built once for all the roles that name it in the rig's YAML."""

    @classmethod
    @abstractmethod
    def check(cls, context: Context, role: str, options: dict[str, Any]) -> None:
        """Check a role's options without touching a device; raises ConfigError."""

    @abstractmethod
    def __init__(self, context: Context, roles: dict[str, dict[str, Any]]) -> None:
        """Open what is needed to play `roles` (name to options); raises DriverError."""

    @abstractmethod
    def sync(self, cycle: int, late_s: float = 0.0) -> None:
        """Begin a cycle, due `late_s` ago: all readings are of this moment.

        `cycle` jumps where periods were late. What is waited for after a late beginning is to be
        there before the next cycle is due all the same.
        """

    def amplifiers(self) -> CoilAmplifiers:
        """Return the amplifiers; raises DriverError where this backend has none."""
        raise DriverError(f"{type(self).__name__} plays no amplifiers")

    def sensors(self) -> PositionSensors:
        """Return the sensors; raises DriverError where this backend has none."""
        raise DriverError(f"{type(self).__name__} plays no sensors")

    def drives(self) -> ManipulatorDrives:
        """Return the drives; raises DriverError where this backend has none."""
        raise DriverError(f"{type(self).__name__} plays no drives")

    def recover(self) -> None:
        """Make good after a fault: open again what is gone, reset what tripped, compare limits.

        Raises:
            DriverError: the cause is not gone; the next call may succeed.
        """
        return

    @property
    def stale(self) -> int:
        """In how many cycles a reading did not come in time and the last one stood in for it."""
        return 0

    def close(self) -> None:
        """Send zero force, then let go of the device; safe to call twice."""
        return


class FirstError:
    """Lets what is done with one bus fail without keeping the others from theirs.

    Each `with` keeps back what it raises; `raise_it` raises the first of it.
    """

    def __init__(self) -> None:
        self._error: Exception | None = None

    def __enter__(self) -> None:
        return

    def __exit__(self, _: object, error: BaseException | None, __: object) -> bool:
        if isinstance(error, Exception):
            self._error = self._error or error
            return True
        return False

    def raise_it(self) -> None:
        """Raise the first error, if there was one.

        Nothing of it stays here: an error holds its frames, and those this object. In a process
        that does not collect such rings, a bus that is gone would cost 3 kB a cycle.
        """
        error, self._error = self._error, None
        if error is not None:
            try:
                raise error
            finally:
                del error


@dataclass(frozen=True)
class Devices:
    """The three roles of a rig, open and ready, and what to call at the start of each cycle."""

    amplifiers: CoilAmplifiers
    sensors: PositionSensors
    drives: ManipulatorDrives
    backends: tuple[Backend, ...]

    @property
    def syncs(self) -> tuple[Sync, ...]:
        """What to call, in this order, to begin a cycle."""
        return (self.backends[0].sync,) if len(self.backends) == 1 else (self.sync,)

    def sync(self, cycle: int, late_s: float = 0.0) -> None:
        """Begin a cycle on every backend, whatever happens to the others; raises what came first.

        Zero force, too, acts only where a cycle begins.
        """
        first = FirstError()
        for backend in self.backends:
            with first:
                backend.sync(cycle, late_s)
        first.raise_it()

    @property
    def stale(self) -> int:
        """Cycles with a reading that came too late, of all backends."""
        return sum(backend.stale for backend in self.backends)

    @property
    def stale_roles(self) -> int:
        """The log's `stale` for the readings at hand."""
        return self.sensors.stale | self.amplifiers.stale | self.drives.stale

    def recover(self) -> None:
        """Recover every backend after a fault; raises DriverError where one cannot."""
        for backend in self.backends:
            backend.recover()

    def close(self) -> None:
        """Close every backend, whatever happens to the others."""
        errors = []
        for backend in self.backends:
            try:
                backend.close()
            except Exception as error:  # noqa: BLE001 - one dead bus must not keep the others from zero force
                errors.append(f"{type(backend).__name__}: {error}")
        if errors:
            raise DriverError(f"did not close: {'; '.join(errors)}")
