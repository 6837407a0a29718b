"""Metrics as Prometheus would fetch them, parsed by its own library."""

import socket
import urllib.request

import pytest

from levid.daemon.metrics import MetricsError, serve_metrics
from levid.daemon.timing import Timing, account, memory_of

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
        **{"clients_gone": 3, "flooded_s": 4.0, "memory_stalled_s": 0.5},
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
    assert found["levid_state", "LEVITATING"] == 1
    assert found["levid_state", "IDLE"] == 0
    assert found["levid_fault", "NONE"] == 1
    assert found["levid_late_cycles_total", "wake_up"] == 1
    assert found["levid_cycle_seconds", "lateness", "1"] == pytest.approx(3e-6)
    assert found["levid_recording",] == 1
