"""Live process: show rows of the shared memory, which it can only read, to local viewers.

It knows nothing that a client of the control socket does not know, and its requests have the role
that it inherited. It may die or hang at any time: no other process waits for it.
"""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ...config.escaping import one_line
from ...config.rig import RigConfig
from ..host.child_process import receive_signals
from ..host.process_confinement import Confinement, confine, lower_priority
from ..host.rate_limited_log import RateLimitedLog
from ..host.real_time_scheduling import set_process_name, signal_at_parent_death
from ..host.syscall_filter import forbid_syscalls
from ..ipc.shared_memory import SharedMemory
from ..ipc.shared_status_words import Word
from .control_link import ControlLink, RefusedByDaemonError
from .decimation import Decimator
from .flight_events import Event, FlightEvents
from .foxglove_stream import FoxgloveStream
from .page_data import bars_of, event_data, rig_data, row_data, status_data
from .page_server import PageServer, event_bytes
from .websocket_proxy import WebSocketProxy

STATUS_S = 0.5
"""Interval of the requests for the status, which are the heartbeat of this process as well."""
_PAGE_HZ = 10.0
_SEND_S = 0.05
"""Shortest time between two deliveries; a delivery may hold several intervals of rows."""
_NICE = 19
"""The lowest share of a processor that still lets a stop through on a busy machine."""
_LIMITS = Confinement(cpu_s=None, memory_bytes=1 << 30, file_bytes=1 << 20)
_PAGE = Path(__file__).with_name("page.html")
_REPEAT_S = 10.0
_MOTIONS = {"beam_m", "rotor_rad"}


class LiveProcess:
    """Serve the live view of a rig until the process ends.

    `requests` may stop and land; `flights`, if given, may do all that `levid` does.
    """

    def __init__(
        self,
        rig: RigConfig,
        shared: SharedMemory,
        requests: ControlLink,
        flights: ControlLink | None,
        token: str,
    ) -> None:
        live = rig.live
        assert live is not None
        self._shared, self._requests, self._flights = shared, requests, flights
        self._bars = bars_of(rig)
        self._rows = _decimator(shared, rig.rate_hz, live.rate_hz)
        self._page_rows = _decimator(shared, rig.rate_hz, _PAGE_HZ)
        self._period_s = 1.0 / rig.rate_hz
        self._status_event = b""
        self._rarely = RateLimitedLog(_print_error, _REPEAT_S)
        self._events = FlightEvents(self._on_event)
        self._stream = FoxgloveStream(f"levid: {rig.name}", shared.dtype, rig.rate_hz)
        self._proxy = WebSocketProxy(
            live.port, self._stream.address, live.origins, self._report_refusal
        )
        self._page = PageServer(
            live.page_port,
            _PAGE.read_text(encoding="utf-8"),
            self._page_requests(),
            token,
            self._greeting,
            self._report_refusal,
        )
        data = {**rig_data(rig, flights is not None), "page": self._page.page_token}
        self._rig_event = event_bytes("rig", data)

    async def run(self, parent: int) -> None:
        """Listen, give up all rights that are not needed, and serve. Raises OSError."""
        await self._proxy.start()
        await self._page.start()
        for link in (self._requests, self._flights):
            if link is not None:
                await link.open()
        confine(_LIMITS, _open_files_but_memory())
        signal_at_parent_death(parent, signal.SIGKILL)  # after the change of the user
        if warning := forbid_syscalls():
            print(f"live view: {one_line(warning)}", file=sys.stderr, flush=True)  # noqa: T201
        await asyncio.gather(self._send_rows(), self._send_page_rows(), self._send_status())

    async def _send_rows(self) -> None:
        # Several intervals at a time: a wake-up costs more than the rows.
        async for _ in _ticks(max(self._rows.factor * self._period_s, _SEND_S)):
            if not self._stream.wanted:
                self._rows.skip()
                continue
            while (rows := self._rows.read()) is not None:
                self._stream.send(rows, self._shared.control_words[Word.EPOCH_NS])
                await asyncio.sleep(0.0)  # requests first, after a pause of this process

    async def _send_page_rows(self) -> None:
        async for _ in _ticks(self._page_rows.factor * self._period_s):
            rows = None
            while (found := self._page_rows.read()) is not None:
                rows = found
                self._events.rows(rows.raw["state"], rows.lost)
            if rows is not None and self._page.watched:
                data = row_data(rows, self._bars, self._shared.heat)
                self._page.send(event_bytes("row", data))

    async def _send_status(self) -> None:
        async for _ in _ticks(STATUS_S):
            status = await self._requests.ask("status")
            self._events.status(status)
            self._stream.send_status(status)
            self._status_event = event_bytes("status", status_data(status))
            self._page.send(self._status_event)
            self._rarely.flush(time.monotonic())

    def _on_event(self, event: Event) -> None:
        self._stream.send_event(event)
        self._page.send(event_bytes("log", event_data(event)))

    def _greeting(self) -> Iterator[bytes]:
        yield self._rig_event
        yield self._status_event
        for event in self._events.kept:
            yield event_bytes("log", event_data(event))

    def _page_requests(self) -> dict[str, Any]:
        async def stop(_: Mapping[str, Any]) -> Mapping[str, Any]:
            return await self._requests.ask("stop")

        async def land(_: Mapping[str, Any]) -> Mapping[str, Any]:
            return await self._requests.ask("land")

        async def levitate(_: Mapping[str, Any]) -> Mapping[str, Any]:
            return await self._fly("levitate")

        async def clear(_: Mapping[str, Any]) -> Mapping[str, Any]:
            return await self._fly("clear")

        async def move(values: Mapping[str, Any]) -> Mapping[str, Any]:
            numbers = all(isinstance(value, int | float) for value in values.values())
            if not values or not numbers or not values.keys() <= _MOTIONS:
                raise RefusedByDaemonError(
                    f"move: expected numbers for {' or '.join(sorted(_MOTIONS))}"
                )
            return await self._fly("move", move=dict(values))

        if self._flights is None:
            return {"stop": stop}
        return {"stop": stop, "land": land, "levitate": levitate, "clear": clear, "move": move}

    async def _fly(self, op: str, **more: Any) -> Mapping[str, Any]:
        assert self._flights is not None
        if self._flights.busy:
            raise RefusedByDaemonError(f"{op}: the last request of this page is not complete")
        return await self._flights.ask(op, **more)

    def _report_refusal(self, reason: str) -> None:
        self._rarely.line("refused", time.monotonic(), f"live view: {reason}")


def _print_error(line: str) -> None:
    print(one_line(line), file=sys.stderr, flush=True)  # noqa: T201


def _decimator(shared: SharedMemory, rate_hz: float, to_hz: float) -> Decimator:
    return Decimator(shared.ring, max(round(rate_hz / to_hz), 1))


async def _ticks(period_s: float) -> AsyncIterator[None]:
    """Yield every `period_s`, and once after a pause of the process."""
    loop = asyncio.get_running_loop()
    next_s = loop.time()
    while True:
        yield
        next_s = max(next_s + period_s, loop.time())
        await asyncio.sleep(next_s - loop.time())


def _open_files_but_memory() -> list[int]:
    """Return the open descriptors, except those of the shared memory, which stays mapped."""
    found = []
    for entry in Path("/proc/self/fd").iterdir():
        try:
            target = str(entry.readlink())
        except OSError:  # that of this listing
            continue
        if not target.startswith("/memfd:levid-"):
            found.append(int(entry.name))
    return found


def main(fd: str, parent: str, requests: str, flights: str = "") -> None:
    """Serve the live view; read rig and token as JSON from standard input."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the supervisor ends this process
    receive_signals()
    set_process_name("levid-live")
    signal_at_parent_death(int(parent), signal.SIGKILL)
    lower_priority(_NICE)
    settings = json.loads(sys.stdin.buffer.read())
    rig = RigConfig.model_validate(settings["rig"])
    shared = SharedMemory(rig, int(fd), read_only=True)
    links: list[ControlLink] = [
        ControlLink(socket.socket(fileno=int(end))) for end in (requests, flights) if end
    ]

    async def serve() -> None:
        process = LiveProcess(
            rig, shared, links[0], links[1] if len(links) > 1 else None, settings["token"]
        )
        await process.run(int(parent))

    _run(serve)


def _run(serve: Callable[[], Any]) -> None:
    try:
        asyncio.run(serve())
    except OSError as error:  # a port is in use, or the daemon has closed the connection
        raise SystemExit(f"live view: {error}; its ports are keys of live in RIG.yaml") from None


if __name__ == "__main__":
    main(*sys.argv[1:])
