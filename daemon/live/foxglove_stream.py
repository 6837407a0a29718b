"""Send log rows to Foxglove clients: the topics, schemas and bytes of the logs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import foxglove
import numpy as np
from numpy.typing import NDArray

from ...log.message_array import CDR_LE
from ...log.signals import ros2msg
from ...log.writer import SCHEMA_NAME, TOPIC
from .decimation import Decimated
from .flight_events import Event, Level
from .websocket_proxy import hidden_address

_CDR_HEADER = CDR_LE + b"\0\0"
_LEVELS = {Level.INFO: 2, Level.WARNING: 3, Level.ERROR: 4}
_NUMBER, _TEXT = {"type": "integer"}, {"type": "string"}
_LOG = {
    "title": "foxglove.Log",
    "type": "object",
    "properties": {
        "timestamp": {"type": "object", "properties": {"sec": _NUMBER, "nsec": _NUMBER}},
        "level": _NUMBER,
        "message": _TEXT,
        "name": _TEXT,
    },
}
"""Schema of Foxglove's panel Log."""
_WAITING_MESSAGES = 1024
"""Messages that wait for a client that does not read; then its oldest ones are discarded."""


class FoxgloveStream:
    """Serve the rows of a rig at `address`: decimated, minimum and maximum, and raw on demand.

    foxglove-sdk serves the clients in threads of its own; sending a message never waits.
    """

    def __init__(self, name: str, dtype: np.dtype[np.void], rate_hz: float) -> None:
        self._period_ns = 1e9 / rate_hz
        # Any local program could fill the journal with failed handshakes.
        foxglove.set_log_level("CRITICAL")
        self._context = context = foxglove.Context()  # its channels close with it
        schema = foxglove.Schema(name=SCHEMA_NAME, encoding="ros2msg", data=ros2msg(dtype).encode())

        def channel(topic: str) -> foxglove.Channel:
            return foxglove.Channel(topic, message_encoding="cdr", schema=schema, context=context)

        self._last, self._minimum = channel(TOPIC), channel(f"{TOPIC}_min")
        self._maximum, self._raw = channel(f"{TOPIC}_max"), channel(f"{TOPIC}_raw")
        self._status = foxglove.Channel("/levid/status", context=context)
        self._events = foxglove.Channel("/levid/events", schema=_LOG, context=context)
        host = hidden_address()
        self._server = foxglove.start_server(
            name=name,
            host=host,
            port=0,
            capabilities=[],
            context=context,
            message_backlog_size=_WAITING_MESSAGES,
        )
        self.address = host, self._server.port

    @property
    def wanted(self) -> bool:
        """Whether a client has subscribed to rows."""
        channels = self._last, self._minimum, self._maximum, self._raw
        return any(channel.has_sinks() for channel in channels)

    def send(self, rows: Decimated, epoch_ns: int) -> None:
        """Send intervals of rows; `epoch_ns` is the log time of cycle 0."""
        for channel, values, cycles in (
            (self._last, rows.last, rows.last["cycle"]),
            # The time of an interval is that of its last row, so that the topics agree.
            (self._minimum, rows.minimum, rows.last["cycle"]),
            (self._maximum, rows.maximum, rows.last["cycle"]),
            (self._raw, rows.raw, rows.raw["cycle"]),
        ):
            if channel.has_sinks():
                times_ns = epoch_ns + np.rint(cycles * self._period_ns).astype(np.int64)
                _log(channel, values, times_ns)

    def send_status(self, status: Mapping[str, Any]) -> None:
        """Send the answer of `levid status`."""
        if self._status.has_sinks():
            self._status.log(json.dumps(status).encode())

    def send_event(self, event: Event) -> None:
        """Send an event to Foxglove's panel Log."""
        stamp = {"sec": int(event.time_s), "nsec": int(1e9 * (event.time_s % 1.0))}
        self._events.log(
            {
                "timestamp": stamp,
                "level": _LEVELS[event.level],
                "message": event.text,
                "name": "levid",
            }
        )

    def close(self) -> None:
        """Disconnect all clients."""
        self._server.stop()


def _log(channel: foxglove.Channel, rows: NDArray[np.void], times_ns: NDArray[np.int64]) -> None:
    """Send each row as a message, as in a log."""
    size, data = rows.dtype.itemsize, np.ascontiguousarray(rows).tobytes()
    for k, time_ns in enumerate(times_ns.tolist()):
        channel.base.log(_CDR_HEADER + data[k * size : (k + 1) * size], time_ns)
