"""Interfaces of the three roles and of a backend, and the errors that devices raise."""

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
    """Function that begins a cycle."""

    def __call__(self, cycle: int, late_s: float = 0.0, /) -> None:
        """Begin cycle number `cycle`, `late_s` s after it was due."""


class DriverError(Exception):
    """A device or bus cannot be used; the message names it and the cause."""


class LinkError(DriverError):
    """A bus or port was lost; it is opened again when the fault is cleared."""


class StaleError(DriverError):
    """Readings were missing or invalid in more consecutive cycles than allowed."""


class AmplifierError(DriverError):
    """Amplifiers tripped, or switched off while force was commanded."""


class SensorError(DriverError):
    """A sensor channel has no reading, or is at the end of its range."""


class DriveError(DriverError):
    """A drive does not follow: encoder lost, emergency, skew of the gantry."""


class CoilAmplifiers(ABC):
    """Amplifiers of C coils: accept force commands and report the forces that act."""

    # Integers: combining enum flags takes 1 us.
    STALE = int(Stale.AMPLIFIERS)
    stale: int = 0
    """Bits for the log field `stale`, set by `read`: STALE if it kept an earlier reading."""

    @abstractmethod
    def write(self, coil_n: Array) -> None:
        """Command coil forces (C,) in N, which act from the next cycle on."""

    @abstractmethod
    def read(self, coil_n: Array) -> None:
        """Fill `coil_n` (C,) with current times the nominal force constant, in N."""

    def release(self, zero_n: Array) -> None:
        """Command zero force, `zero_n` (C,), at once, between cycles too."""
        self.write(zero_n)


class PositionSensors(ABC):
    """S position sensors that measure the height of the platform."""

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
        """Brake and switch off, at once if the device can; earlier setpoints are discarded.

        Setpoints are ignored until `recover`. Drives that cannot be switched off do nothing.
        """
        return


@dataclass(frozen=True)
class Context:
    """Arguments of a backend: the rig, the period of the loop, the folder of relative paths."""

    rig: RigConfig
    period_s: float
    folder: Path


class Backend(ABC):
    """A kind of connection; one instance serves all roles that name it in RIG.yaml."""

    @classmethod
    @abstractmethod
    def check(cls, context: Context, role: str, options: dict[str, Any]) -> None:
        """Check a role's options without touching a device; raises ConfigError."""

    @classmethod
    def emulated(cls, context: Context, role: str, options: dict[str, Any]) -> bool:  # noqa: ARG003
        """Return whether the role's device is simulated: no force acts on anything real.

        False unless a backend knows better.
        """
        return False

    @classmethod
    def missing(cls, context: Context, role: str, options: dict[str, Any]) -> str:  # noqa: ARG003
        """Return what of the machine the role lacks, with a remedy; empty if nothing is known.

        No device is opened.
        """
        return ""

    @classmethod
    def reads_back(cls, context: Context, options: dict[str, Any]) -> bool:  # noqa: ARG003
        """Return whether its amplifiers measure the force that `CoilAmplifiers.read` returns.

        With False, levid does not compare it with the commands: a coil that keeps a force, or
        gives none, stays unknown. No device is opened.
        """
        return True

    @classmethod
    def gap_step_m(cls, context: Context, options: dict[str, Any]) -> float | None:  # noqa: ARG003
        """Return the smallest change in m that its sensors' readings show, None if unknown.

        For `levid check`: the control cycle measures it.
        """
        return None

    @abstractmethod
    def __init__(self, context: Context, roles: dict[str, dict[str, Any]]) -> None:
        """Open the devices of `roles` (options by name); raises DriverError."""

    @abstractmethod
    def sync(self, cycle: int, late_s: float = 0.0) -> None:
        """Begin a cycle, `late_s` s after it was due: all readings are sampled now.

        `cycle` skips the periods that were missed. After a late start the wait for readings is
        shortened, so that the next cycle starts on time.
        """

    def amplifiers(self) -> CoilAmplifiers:
        """Return the amplifiers; raises DriverError if this backend has none."""
        raise DriverError(f"{type(self).__name__} has no amplifiers")

    def sensors(self) -> PositionSensors:
        """Return the sensors; raises DriverError if this backend has none."""
        raise DriverError(f"{type(self).__name__} has no sensors")

    def drives(self) -> ManipulatorDrives:
        """Return the drives; raises DriverError if this backend has none."""
        raise DriverError(f"{type(self).__name__} has no drives")

    def recover(self) -> None:
        """Recover from a fault: reopen lost buses, reset trips, compare limits.

        Raises:
            DriverError: the cause persists; a later call may succeed.
        """
        return

    @property
    def stale(self) -> int:
        """Number of cycles in which a reading was missing and the last one was used."""
        return 0

    def close(self) -> None:
        """Send zero force and close the device; safe to call twice."""
        return


class FirstError:
    """Defers errors, so that the failure of one bus does not stop work on the others.

    Each `with` suppresses its exception; `raise_it` raises the first one.
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
        """Raise the first error, if there is one, and drop the reference to it.

        The error references its frames, and those reference this object. The loop runs without
        garbage collection: the cycle would leak 3 kB per control cycle while a bus is lost.
        """
        error, self._error = self._error, None
        if error is not None:
            try:
                raise error
            finally:
                del error


@dataclass(frozen=True)
class Devices:
    """Open devices of the three roles, and the function that begins a cycle."""

    amplifiers: CoilAmplifiers
    sensors: PositionSensors
    drives: ManipulatorDrives
    backends: tuple[Backend, ...]
    reads_back: bool = True
    """Whether the amplifiers measure the force: see Backend.reads_back."""

    @property
    def syncs(self) -> tuple[Sync, ...]:
        """Functions that begin a cycle, in the order of the calls."""
        return (self.backends[0].sync,) if len(self.backends) == 1 else (self.sync,)

    def sync(self, cycle: int, late_s: float = 0.0) -> None:
        """Begin a cycle on every backend, even if one fails; raises the first error.

        Zero force, too, takes effect only when a cycle begins.
        """
        first = FirstError()
        for backend in self.backends:
            with first:
                backend.sync(cycle, late_s)
        first.raise_it()

    @property
    def stale(self) -> int:
        """Number of cycles with a missing reading, summed over the backends."""
        return sum(backend.stale for backend in self.backends)

    @property
    def stale_roles(self) -> int:
        """Value of the log field `stale` for the current readings."""
        return self.sensors.stale | self.amplifiers.stale | self.drives.stale

    def recover(self) -> None:
        """Recover every backend after a fault; raises DriverError if one cannot."""
        for backend in self.backends:
            backend.recover()

    def close(self) -> None:
        """Close every backend, even if one fails; raises DriverError."""
        errors = []
        for backend in self.backends:
            try:
                backend.close()
            except Exception as error:  # noqa: BLE001 - the other buses still have to get zero force
                errors.append(f"{type(backend).__name__}: {error}")
        if errors:
            raise DriverError(f"cannot close: {'; '.join(errors)}")
