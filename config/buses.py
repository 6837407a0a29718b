"""Schema of RIG.yaml: CAN buses, serial ports, and the options of roles on them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from .base import NonNegative, Positive, Strict

Cycles = Annotated[int, Field(ge=0, le=1000)]
Name = Annotated[str, Field(min_length=1)]
NodeId = Annotated[int, Field(ge=1, le=127)]


class Bus(Strict):
    """Base of the buses of every backend."""

    @property
    def place(self) -> str:
        """Text that is equal for two sections that name the same wire."""
        return ", ".join(f"{key} {value}" for key, value in sorted(self.model_dump().items()))


class RoleOptions(Strict):
    """Base of the keys of a role on a bus."""

    bus: Name


class CanBus(Bus):
    """A CAN bus: classic, or CAN FD if `data_bitrate` is given."""

    interface: Name
    channel: str | int
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    data_bitrate: Annotated[int, Field(ge=10_000, le=12_000_000)] | None = None
    options: dict[str, str | int | float | bool] = Field(default_factory=dict)
    dbc: str | None = None
    latency_s: NonNegative | None = None
    """Latency that adapter and host add to a cycle; default: a typical value of the interface."""
    stale_cycles: Cycles = 2

    @property
    def fd(self) -> bool:
        """Whether the bus uses CAN FD frames."""
        return self.data_bitrate is not None

    @property
    def place(self) -> str:
        """Identity of the physical bus: two entries with the same place are one bus."""
        if self.interface == "levid_local":
            return f"{self.interface} {Path(str(self.channel)).resolve()}"
        if self.interface == "socketcan":  # its options belong to the socket, not to the bus
            return f"{self.interface} {self.channel}"
        options = (f"{key} {value}" for key, value in sorted(self.options.items()))
        return ", ".join((f"{self.interface} {self.channel}", *options))


class SerialBus(Bus):
    """A serial port, or any URL that pyserial opens."""

    port: Name
    baud: Annotated[int, Field(ge=9600, le=24_000_000)]
    latency_s: NonNegative = 1.25e-4
    stale_cycles: Cycles = 2

    @property
    def place(self) -> str:
        """Identity of the port: two entries with the same place are one port."""
        return self.port if "://" in self.port else str(Path(self.port).resolve())


class AmplifierOptions(RoleOptions):
    """Keys of the role `amplifiers` on a bus."""

    expire_cycles: Annotated[int, Field(ge=1, le=1000)] = 2


class SensorOptions(RoleOptions):
    """Keys of the role `sensors` on a bus."""


class SerialDriveOptions(RoleOptions):
    """Keys of the role `drives` on a serial port."""

    skew_m: Positive = 1e-4


class Nodes(Strict):
    """CANopen node numbers of the two linear motors and of the rotary motor."""

    x1: NodeId = 1
    x2: NodeId = 2
    phi: NodeId = 3


class CanDriveOptions(RoleOptions):
    """Keys of the role `drives` on a CAN bus, where drives are CANopen nodes (CiA 402)."""

    nodes: Nodes = Nodes()
    eds: str | None = None
    every: Annotated[int, Field(ge=1, le=100)] = 1
    skew_m: Positive = 1e-4
    heartbeat_s: Annotated[float, Field(ge=0.01, le=30.0)] = 0.2
    expire_s: Annotated[float, Field(ge=1e-3, le=60.0)] = 0.1
    homing_method: Annotated[int, Field(ge=1, le=37)] = 34
