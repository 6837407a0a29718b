"""Schema of RIG.yaml: real-time settings, access, recording, live view, self-test of the daemon."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from .base import Positive, Strict

Cpu = Annotated[int, Field(ge=0, le=4095)]
Port = Annotated[int, Field(ge=1, le=65_535)]
Id = Annotated[str, Field(min_length=1)] | Annotated[int, Field(ge=0)]


class Realtime(Strict):
    """Real-time settings of the loop's process; a setting without permission is a warning."""

    priority: Annotated[int, Field(ge=0, le=95)] = 80
    lock_memory: bool = True
    cpus: tuple[Cpu, ...] = ()
    timer_slack_ns: Annotated[int, Field(ge=0, le=1_000_000)] = 1
    cpu_latency_us: Annotated[int, Field(ge=0, le=1_000_000)] | Literal["auto"] | None = "auto"


class Service(Strict):
    """Access to the control socket, timeouts of the daemon's processes, metrics port."""

    allow_users: tuple[Id, ...] = ()
    allow_groups: tuple[Id, ...] = ()
    stop_users: tuple[Id, ...] = ()
    stop_groups: tuple[Id, ...] = ()
    watch_users: tuple[Id, ...] = ()
    watch_groups: tuple[Id, ...] = ()
    client_gone: Literal["go_on", "land"] = "go_on"
    supervisor_gone: Literal["zero", "land"] = "land"
    supervisor_s: Annotated[float, Field(ge=0.05, le=60.0)] = 1.0
    metrics_port: Port | None = None
    loop_s: Annotated[float, Field(ge=0.05, le=60.0)] = 1.0


class Recording(Strict):
    """Folder of logs and how long they are kept, rotation of files, flight recordings of faults."""

    root: Annotated[str, Field(min_length=1)] | None = None
    quota_gb: Positive | None = None
    keep_days: Positive | None = None
    keep_flights: Annotated[int, Field(ge=1, le=100_000)] = 10
    rotate_mb: Annotated[float, Field(ge=0.1, le=1e6)] = 2000.0
    rotate_s: Annotated[float, Field(ge=1.0, le=86_400.0)] = 3600.0
    faults: str | None = None
    before_fault_s: Annotated[float, Field(ge=0.1, le=60.0)] = 10.0
    keep_faults: Annotated[int, Field(ge=1, le=10_000)] = 100

    @model_validator(mode="after")
    def _limits_have_a_root(self) -> Self:
        for key in ("quota_gb", "keep_days"):
            if getattr(self, key) is not None and self.root is None:
                raise ValueError(
                    f"{key}: expected the key root beside it, the folder of all logs, found none: "
                    "levid deletes logs in that folder only"
                )
        return self


class Live(Strict):
    """Live view on 127.0.0.1: a stream for Foxglove and PlotJuggler, and a page for the browser.

    There is none without this section. `docs/live.md` describes both and who may use them.
    """

    port: Port = 8765
    page_port: Port = 8080
    rate_hz: Annotated[float, Field(ge=1.0, le=200.0)] = 50.0
    control: bool = False
    origins: tuple[Annotated[str, Field(min_length=1)], ...] = (
        "https://app.foxglove.dev",
        "file://",
    )

    @model_validator(mode="after")
    def _two_ports(self) -> Self:
        if self.port == self.page_port:
            raise ValueError(f"expected different port and page_port, found {self.port} twice")
        return self


class SelfTest(Strict):
    """Limits of the readings at rest, tested before the first lift-off and after each fault."""

    duration_s: Annotated[float, Field(ge=0.01, le=10.0)] = 0.2
    gap_m: Positive = 1.1e-3
    plane_m: Positive = 1e-4
    still_m: Positive = 1e-4
    coil_n: Positive = 0.5
    beam_m_s: Positive = 0.01
    rotor_rad_s: Positive = 0.5
