"""Serve the figures of `levid status` to Prometheus, on the loopback interface only."""

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
_SHUTDOWN_S = 1.0
_REQUEST_S = 2.0
"""Time limit of a request with its answer: a slow client delays the next one by this at most."""
_DEFER_S = 30
_QUANTILES = {"p50": "0.5", "p99": "0.99", "p99.9": "0.999", "max": "1"}
_COUNTERS = {
    "cycle": ("levid_cycles", "periods since the start"),
    "stale": ("levid_stale_cycles", "cycles with a stale reading"),
    "lost": ("levid_lost_rows", "rows overwritten before they were recorded, or missing in a log"),
    "recorder_restarts": ("levid_recorder_restarts", "restarts of the recorder"),
    "clients_gone": ("levid_clients_gone", "clients that disconnected during their flight"),
    "flooded_s": ("levid_flooded_seconds", "time with too many requests at the control socket"),
    "memory_stalled_s": ("levid_memory_stalled_seconds", "time processes waited for low memory"),
    "stolen_s": ("levid_stolen_seconds", "processor time taken by the host of a virtual machine"),
}


class MetricsError(Exception):
    """Report that the metrics cannot be served."""


def serve_metrics(port: int, status: Callable[[], Mapping[str, Any]]) -> Callable[[], None]:
    """Serve metrics on a loopback port; return the function that ends it. Raises MetricsError.

    Requests are answered one at a time: a flood takes no descriptors or threads from the daemon.
    """
    from prometheus_client import CollectorRegistry, make_wsgi_app

    registry = CollectorRegistry()
    registry.register(_Collector(status))
    try:
        server = make_server(_ADDRESS, port, make_wsgi_app(registry), _Server, _Handler)
    except OSError as error:
        raise MetricsError(
            f"service.metrics_port {port}: cannot serve metrics: {error.strerror}"
        ) from None
    thread = threading.Thread(target=server.serve_forever, name="levid-metrics", daemon=True)
    thread.start()

    def close() -> None:
        # Do not wait for a client that sends its request byte by byte.
        ending = threading.Thread(target=server.shutdown, name="levid-metrics-end", daemon=True)
        ending.start()
        ending.join(_SHUTDOWN_S)
        server.server_close()

    return close


class _Server(WSGIServer):
    request_queue_size = 64

    def server_activate(self) -> None:
        """Listen; the kernel holds back connections that send nothing, so that none delays us."""
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, _DEFER_S)
        super().server_activate()

    def handle_error(self, *_: object) -> None:
        """Log nothing: a client that disconnects is no problem."""


class _Handler(WSGIRequestHandler):
    timeout = 1.0

    def handle(self) -> None:
        """Answer one request within _REQUEST_S; `timeout` limits only the pause between bytes."""
        deadline = threading.Timer(_REQUEST_S, self._hang_up)
        deadline.daemon = True
        deadline.start()
        try:
            super().handle()
        finally:
            deadline.cancel()

    def _hang_up(self) -> None:
        with contextlib.suppress(OSError):  # closed already
            self.connection.shutdown(socket.SHUT_RDWR)

    def log_message(self, *_: object) -> None:
        """Log nothing: requests are frequent."""


class _Collector:
    """Read the status at each request for metrics, and only then."""

    def __init__(self, status: Callable[[], Mapping[str, Any]]) -> None:
        self._status = status

    def describe(self) -> list[Metric]:
        """Return nothing, so that the registry does not collect metrics at registration."""
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
            family = GaugeMetricFamily(f"levid_{kind}", f"1 for the current {kind}", labels=[kind])
            for code in codes:
                family.add_metric([code.name], float(code.name == found))
            yield family
        yield GaugeMetricFamily(
            "levid_recording",
            "0 if logs cannot be written",
            value=float(not status["recording"]),
        )
