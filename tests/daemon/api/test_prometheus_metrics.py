"""Test the metrics over HTTP with the parser of Prometheus' own library."""

import contextlib
import socket
import struct
import time
import urllib.request

import pytest

from levid.daemon.api import prometheus_metrics
from levid.daemon.api.prometheus_metrics import MetricsError, serve_metrics
from levid.daemon.ipc.timing_histograms import Timing
from levid.daemon.loop.count_cycle_times import account, memory_of

parser = pytest.importorskip("prometheus_client.parser")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_status_is_served_in_prometheus_s_words() -> None:
    timing, before = Timing(memoryview(bytearray(Timing.SIZE))), memory_of(1e6)
    for skipped in (0, 0, 3):
        account(timing.counts, 3e3, 2e3, 1e3, 500.0, skipped, before)
    status = {
        **{"cycle": 12, "stale": 1, "lost": 0, "recorder_restarts": 2, "recording": ""},
        **{"clients_gone": 3, "flooded_s": 4.0, "memory_stalled_s": 0.5, "stolen_s": 0.25},
        **{"state": "LEVITATING", "fault": "NONE", "timing": timing.figures()},
    }
    port = free_port()
    close = serve_metrics(port, lambda: status)
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
            text = answer.read().decode()
        with pytest.raises(MetricsError, match=f"metrics_port {port}"):
            serve_metrics(port, lambda: status)
    finally:
        close()
    found = {
        (sample.name, *sample.labels.values()): sample.value
        for family in parser.text_string_to_metric_families(text)
        for sample in family.samples
    }
    assert found["levid_cycles_total",] == 12
    assert found["levid_recorder_restarts_total",] == 2
    assert found["levid_clients_gone_total",] == 3
    assert found["levid_flooded_seconds_total",] == 4
    assert found["levid_memory_stalled_seconds_total",] == 0.5
    assert found["levid_stolen_seconds_total",] == 0.25
    assert found["levid_state", "LEVITATING"] == 1
    assert found["levid_state", "IDLE"] == 0
    assert found["levid_fault", "NONE"] == 1
    assert found["levid_late_cycles_total", "wake_up"] == 1
    assert found["levid_cycle_seconds", "lateness", "1"] == pytest.approx(3e-6)
    assert found["levid_recording",] == 1


def test_whoever_drips_a_request_holds_the_next_one_up_for_a_while_only(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(prometheus_metrics, "_REQUEST_S", 0.3)
    port = free_port()
    close = serve_metrics(port, lambda: 1 / 0)  # type: ignore[arg-type,return-value]
    try:
        with socket.create_connection(("127.0.0.1", port)) as slow:
            slow.settimeout(0.1)
            began_s = time.monotonic()
            with contextlib.suppress(ConnectionError):
                while time.monotonic() - began_s < 30.0:
                    slow.sendall(b"G")
                    with contextlib.suppress(TimeoutError):
                        if not slow.recv(100):
                            break
        assert time.monotonic() - began_s < 10.0
        with socket.create_connection(("127.0.0.1", port)) as rude:
            rude.sendall(b"GET /")
            rude.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        with socket.create_connection(("127.0.0.1", port)) as last:
            last.sendall(b"nonsense\r\n\r\n")
            assert last.recv(100)
    finally:
        close()
    assert capfd.readouterr().err == ""


def test_connections_that_send_nothing_hold_nobody_up() -> None:
    port = free_port()
    close = serve_metrics(port, lambda: {})
    try:
        with contextlib.ExitStack() as held:
            for _ in range(60):  # a second each, if the server waited for each
                held.enter_context(socket.create_connection(("127.0.0.1", port)))
            with socket.create_connection(("127.0.0.1", port), timeout=30.0) as client:
                client.sendall(b"GET /nothing HTTP/1.0\r\n\r\n")
                assert client.recv(4) == b"HTTP"
    finally:
        close()
