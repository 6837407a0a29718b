"""How the daemon runs unattended: real-time rights, who may ask, what is recorded; of RIG.yaml."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from .base import Positive, Strict

Cpu = Annotated[int, Field(ge=0, le=4095)]
Id = Annotated[str, Field(min_length=1)] | Annotated[int, Field(ge=0)]


class Realtime(Strict):
    """What the loop's process asks of the kernel; what is not permitted is a warning."""

    priority: Annotated[int, Field(ge=0, le=95)] = 80
    lock_memory: bool = True
    cpus: tuple[Cpu, ...] = ()
    timer_slack_ns: Annotated[int, Field(ge=0, le=1_000_000)] = 1
    cpu_latency_us: Annotated[int, Field(ge=0, le=1_000_000)] | Literal["auto"] | None = "auto"


class Service(Strict):
    """The daemon's processes and its control socket."""

    allow_users: tuple[Id, ...] = ()
    allow_groups: tuple[Id, ...] = ()
    client_gone: Literal["go_on", "land"] = "go_on"
    supervisor_gone: Literal["zero", "land"] = "land"
    supervisor_s: Annotated[float, Field(ge=0.05, le=60.0)] = 1.0
    metrics_port: Annotated[int, Field(ge=1, le=65_535)] | None = None
    loop_s: Annotated[float, Field(ge=0.05, le=60.0)] = 1.0


class Recording(Strict):
    """When a log goes on in another file, and what is kept of faults."""

    rotate_mb: Annotated[float, Field(ge=0.1, le=1e6)] = 2000.0
    rotate_s: Annotated[float, Field(ge=1.0, le=86_400.0)] = 3600.0
    faults: str | None = None
    before_fault_s: Annotated[float, Field(ge=0.1, le=60.0)] = 10.0
    keep_faults: Annotated[int, Field(ge=1, le=10_000)] = 100


class SelfTest(Strict):
    """What readings at rest may be, before the first lift-off and after each fault."""

    duration_s: Annotated[float, Field(ge=0.01, le=10.0)] = 0.2
    gap_m: Positive = 1.1e-3
    plane_m: Positive = 1e-4
    still_m: Positive = 1e-4
    coil_n: Positive = 0.5
    beam_m_s: Positive = 0.01
    rotor_rad_s: Positive = 0.5
