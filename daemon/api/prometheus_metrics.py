"""Metrics for Prometheus, on this machine alone: what `levid status` says, in its text format."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from ..control.faults import Fault
from ..control.states import State

if TYPE_CHECKING:
    from prometheus_client.metrics_core import Metric

_ADDRESS = "127.0.0.1"
_LONGEST_END_S = 1.0
_REQUEST_S = 2.0
"""How long a request may take, answer included: whoever drips his holds up the next for as long."""
_QUANTILES = {"p50": "0.5", "p99": "0.99", "p99.9": "0.999", "max": "1"}
_COUNTERS = {
    "cycle": ("levid_cycles", "periods since the start"),
    "stale": ("levid_stale_cycles", "cycles with a reading that came too late"),
    "lost": ("levid_lost_rows", "rows written over untaken, or missing in their log"),
    "recorder_restarts": ("levid_recorder_restarts", "recorders that died"),
    "clients_gone": ("levid_clients_gone", "clients that hung up during what they had asked for"),
    "flooded_s": ("levid_flooded_seconds", "time with too many requests at the control socket"),
    "memory_stalled_s": ("levid_memory_stalled_seconds", "waits for memory, where it was short"),
    "stolen_s": ("levid_stolen_seconds", "time for which a host kept the processors"),
}


class MetricsError(Exception):
    """Metrics that cannot be served."""


def serve_metrics(port: int, status: Callable[[], Mapping[str, Any]]) -> Callable[[], None]:
    """Answer on this port of the loopback interface; return what ends it. Raises MetricsError.

    One at a time: whoever asks a thousand times over takes no descriptors and threads from flying.
    """
    from prometheus_client import CollectorRegistry, make_wsgi_app

    registry = CollectorRegistry()
    registry.register(_Collector(status))
    try:
        server = make_server(_ADDRESS, port, make_wsgi_app(registry), _Server, _Handler)
    except OSError as error:
        raise MetricsError(f"service.metrics_port {port}: {error.strerror}") from None
    thread = threading.Thread(target=server.serve_forever, name="levid-metrics", daemon=True)
    thread.start()

    def close() -> None:
        # Whoever drips his request a byte at a time is not waited for.
        ending = threading.Thread(target=server.shutdown, name="levid-metrics-end", daemon=True)
        ending.start()
        ending.join(_LONGEST_END_S)
        server.server_close()

    return close


class _Server(WSGIServer):
    def handle_error(self, *_: object) -> None:
        """Say nothing: who asks and goes is nobody's trouble."""


class _Handler(WSGIRequestHandler):
    timeout = 1.0

    def handle(self) -> None:
        """Answer one request, in its time: `timeout` is from one byte to the next."""
        deadline = threading.Timer(_REQUEST_S, self._hang_up)
        deadline.daemon = True
        deadline.start()
        try:
            super().handle()
        finally:
            deadline.cancel()

    def _hang_up(self) -> None:
        with contextlib.suppress(OSError):  # it is over
            self.connection.shutdown(socket.SHUT_RDWR)

    def log_message(self, *_: object) -> None:
        """Say nothing: nobody wants to read of every look."""


class _Collector:
    """Asks for the status when it is asked: nothing is done in between."""

    def __init__(self, status: Callable[[], Mapping[str, Any]]) -> None:
        self._status = status

    def describe(self) -> list[Metric]:
        """Return nothing: the registry then does not ask for metrics before they are wanted."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield every metric."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        status = self._status()
        for key, (name, about) in _COUNTERS.items():
            yield CounterMetricFamily(name, about, value=status[key])
        timing = status["timing"]
        late = CounterMetricFamily("levid_late_cycles", "late cycles by cause", labels=["cause"])
        for cause, count in timing["late_by"].items():
            late.add_metric([cause], count)
        yield late
        times = GaugeMetricFamily(
            "levid_cycle_seconds", "times of a cycle since the start", labels=["part", "quantile"]
        )
        for part, quantiles in timing.items():
            if part.endswith("_us"):
                for name, quantile in _QUANTILES.items():
                    times.add_metric([part.removesuffix("_us"), quantile], quantiles[name] * 1e-6)
        yield times
        for kind, codes, found in (
            ("state", State, status["state"]),
            ("fault", Fault, status["fault"]),
        ):
            family = GaugeMetricFamily(f"levid_{kind}", f"1 for the {kind} at hand", labels=[kind])
            for code in codes:
                family.add_metric([code.name], float(code.name == found))
            yield family
        yield GaugeMetricFamily(
            "levid_recording",
            "0 where logs cannot be written",
            value=float(not status["recording"]),
        )
