"""Test the live stream of a flight against the log of the same flight, with foreign decoders."""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from foxglove_client import FoxgloveClient, Message
from live_view import LiveView, live_view
from mcap.reader import make_reader
from mcap_ros2._dynamic import generate_dynamic
from mcap_ros2._vendor.rosidl_adapter.parser import parse_message_string
from numpy.typing import NDArray
from waiting import wait_until
from websockets.exceptions import InvalidStatus

from levid.config.base import ConfigError
from levid.daemon.client import Client
from levid.daemon.control.faults import Fault
from levid.daemon.control.states import State
from levid.daemon.live.live_link import LiveLink
from levid.log.reader import read_log
from levid.log.signals import dtype_from_ros2msg

SESSION = """
levid: session
name: short
excitations: {psi: {input: psi, rms_n_m: 0.05}}
steps:
  - levitate: {unload_s: 0.2, ramp_s: 0.5, settle_s: 0.1}
  - record: {name: tilt, duration_s: 0.5, fade_s: 0.1, settle_s: 0.1, excite: [psi]}
  - land: {ramp_s: 0.5, release_s: 0.2}
"""
TOPICS = ("/levid/cycle", "/levid/cycle_min", "/levid/cycle_max", "/levid/cycle_raw")
FACTOR = 5


@pytest.fixture(scope="module")
def view(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveView]:
    with live_view(tmp_path_factory.mktemp("run")) as running:
        yield running


def rows_of(client: FoxgloveClient, topic: str) -> NDArray[np.void]:
    dtype = dtype_from_ros2msg(client.channels[topic]["schema"])
    messages = client.messages[topic]
    assert all(message.data[:4] == b"\0\1\0\0" for message in messages)
    return np.concatenate([np.frombuffer(message.data[4:], dtype) for message in messages])


def fly(view: LiveView, out: Path) -> dict[str, Any]:
    with Client(view.daemon.socket) as client:
        return client.request("excite", session=SESSION, out=str(out))


class Flight(NamedTuple):
    """A flight that was logged and streamed: its logs, and what a client received."""

    logs: list[Path]
    rows: dict[str, NDArray[np.void]]
    messages: dict[str, list[Message]]
    channels: dict[str, dict[str, Any]]


@pytest.fixture(scope="module")
def flight(view: LiveView, tmp_path_factory: pytest.TempPathFactory) -> Flight:
    answer: dict[str, Any] = {}
    out = tmp_path_factory.mktemp("logs") / "out"
    thread = threading.Thread(target=lambda: answer.update(fly(view, out)))
    with FoxgloveClient(view.port) as client:
        client.subscribe(*TOPICS)
        client.until("/levid/cycle_raw", 1)
        thread.start()
        while thread.is_alive():
            client.collect(0.2)
        client.collect(0.5)
        rows = {topic: rows_of(client, topic) for topic in TOPICS}
        return Flight(list(map(Path, answer["logs"])), rows, client.messages, client.channels)


def test_raw_stream_of_a_flight_is_its_log(flight: Flight) -> None:
    logs = list(map(read_log, flight.logs))
    logged = np.concatenate([log.rows for log in logs])
    times_ns = dict(
        zip(
            logged["cycle"].tolist(),
            np.concatenate([log.log_time_ns for log in logs]).tolist(),
            strict=True,
        )
    )
    raw = flight.rows["/levid/cycle_raw"]
    assert (np.diff(raw["cycle"].astype(int)) > 0).all()
    # Every logged row came, byte for byte, at the log's time.
    sent = raw[np.isin(raw["cycle"], logged["cycle"])]
    assert sent.tobytes() == logged.tobytes()
    for row, message in zip(raw, flight.messages["/levid/cycle_raw"], strict=True):
        assert times_ns.get(int(row["cycle"]), message.time_ns) == message.time_ns
    assert set(raw["state"].tolist()) >= {State.LEVITATING, State.EXCITING, State.LANDING}


def test_decimated_rows_have_last_minimum_and_maximum_of_their_interval(flight: Flight) -> None:
    last, low, high, raw = (flight.rows[topic] for topic in TOPICS)
    assert len(last) == len(low) == len(high)
    places = np.searchsorted(raw["cycle"], last["cycle"])
    seen = np.flatnonzero((places >= FACTOR - 1) & (places < len(raw)))[:-1]
    assert len(seen) > 50
    for k in seen:
        interval = raw[places[k] - FACTOR + 1 : places[k] + 1]
        assert last[k] == interval[-1]
        for name in raw.dtype.names:
            np.testing.assert_array_equal(low[name][k], interval[name].min(axis=0))
            np.testing.assert_array_equal(high[name][k], interval[name].max(axis=0))
    times = [[m.time_ns for m in flight.messages[topic]] for topic in TOPICS[:3]]
    assert times[0] == times[1] == times[2]


def test_a_foreign_decoder_reads_the_stream_and_the_names_of_its_codes(flight: Flight) -> None:
    channel = flight.channels["/levid/cycle"]
    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
    name, schema = channel["schemaName"], channel["schema"]
    decode = generate_dynamic(name, schema)[name]
    messages, rows = flight.messages["/levid/cycle"], flight.rows["/levid/cycle"]
    for message, row in zip(messages[::20], rows[::20], strict=True):
        fields = decode(message.data)
        assert (fields.cycle, fields.state, fields.z_m) == (row["cycle"], row["state"], row["z_m"])
        assert list(fields.gap_m) == row["gap_m"].tolist()
    constants = parse_message_string("levid", "Cycle", schema).constants
    named = {constant.name: constant.value for constant in constants}
    states = {f"STATE_{state.name}": state.value for state in State}
    assert named == states | {f"FAULT_{fault.name}": fault.value for fault in Fault}


def test_channel_has_the_schema_and_name_of_a_log(flight: Flight) -> None:
    with flight.logs[0].open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    (schema,) = summary.schemas.values()
    (logged,) = summary.channels.values()
    channel = flight.channels[logged.topic]
    assert channel["schema"] == schema.data.decode()
    assert channel["schemaName"] == schema.name
    assert flight.channels["/levid/status"]["encoding"] == "json"
    assert flight.channels["/levid/events"]["schemaName"] == "foxglove.Log"


@pytest.mark.parametrize("origin", ["https://evil.example", "http://localhost:1", "null"])
def test_other_pages_are_refused(view: LiveView, origin: str) -> None:
    with pytest.raises(InvalidStatus) as error:
        FoxgloveClient(view.port, origin)
    assert error.value.response.status_code == 403


def test_another_name_of_this_machine_is_refused(view: LiveView) -> None:
    with socket.create_connection(("127.0.0.1", view.port)) as client:
        client.sendall(b"GET / HTTP/1.1\r\nHost: evil.example\r\nUpgrade: websocket\r\n\r\n")
        assert client.makefile("rb").readline().startswith(b"HTTP/1.1 421 ")


@pytest.mark.parametrize("origin", ["https://app.foxglove.dev", "file://", None])
def test_foxglove_is_let_in(view: LiveView, origin: str | None) -> None:
    with FoxgloveClient(view.port, origin) as client:
        client.subscribe("/levid/cycle")
        assert client.until("/levid/cycle", 3)


def test_no_port_is_open_to_other_machines(view: LiveView) -> None:
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            address, port = line.split()[1].split(":")
            if int(port, 16) in (view.port, view.page_port) and line.split()[3] == "0A":
                assert address == "0100007F"  # 127.0.0.1, little endian
    addresses = {entry[4][0] for entry in socket.getaddrinfo(socket.gethostname(), None)}
    for address in addresses:
        if not str(address).startswith("127.") and ":" not in str(address):
            for port in (view.port, view.page_port):
                with socket.socket() as probe:
                    assert probe.connect_ex((str(address), port)) != 0


def test_process_has_read_only_memory_and_no_rights(view: LiveView) -> None:
    pid = view.pid
    links = [str(fd.readlink()) for fd in Path(f"/proc/{pid}/fd").iterdir()]
    assert not [link for link in links if "memfd:levid-" in link and "levid-rig" not in link]
    maps = Path(f"/proc/{pid}/smaps").read_text().split("\n")
    own = [k for k, line in enumerate(maps) if "memfd:levid-" in line]
    assert own
    for k in own:
        assert maps[k].split()[1] == "r--s"
        flags = next(line for line in maps[k:] if line.startswith("VmFlags"))
        assert "mw" not in flags.split()  # it cannot even be made writable
    status = Path(f"/proc/{pid}/status").read_text()
    facts = {line.split(":")[0]: line.split()[1:] for line in status.splitlines()}
    assert facts["Seccomp"] == ["2"]
    assert facts["NoNewPrivs"] == ["1"]
    if os.geteuid() == 0:
        assert set(facts["Uid"]) == {"65534"}
        assert facts["CapEff"] == ["0000000000000000"]
    for task in Path(f"/proc/{pid}/task").iterdir():
        assert os.getpriority(os.PRIO_PROCESS, int(task.name)) == 19


def test_killed_or_stopped_in_flight_nothing_else_notices(view: LiveView, tmp_path: Path) -> None:
    answer: dict[str, Any] = {}
    thread = threading.Thread(target=lambda: answer.update(fly(view, tmp_path / "out")))
    before = view.daemon.ask("status")["pids"]
    thread.start()
    view.daemon.until(lambda s: s["state"] == "EXCITING")
    os.kill(before["live"], signal.SIGSTOP)
    view.daemon.until(lambda s: s["state"] == "LANDING")
    os.kill(before["live"], signal.SIGKILL)
    thread.join()
    assert (answer["lost"], answer["stopped"]) == (0, False)
    assert all(read_log(path).complete for path in answer["logs"])
    after = view.daemon.until(lambda s: s["pids"]["live"] not in (None, before["live"]))["pids"]
    assert {**after, "live": 0} == {**before, "live": 0}
    # On a slow machine the daemon itself kills what hangs, and says so instead.
    why = ("live view ended", "killed the live view")
    wait_until(lambda: any(word in line for line in view.daemon.said for word in why))
    view.until_served()
    with FoxgloveClient(view.port) as client:
        client.subscribe("/levid/cycle")
        client.until("/levid/cycle", 3)


def test_hung_process_is_killed_and_restarted(
    view: LiveView, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("levid.daemon.live.live_link.HUNG_S", 1.0)
    pid = view.pid
    os.kill(pid, signal.SIGSTOP)
    view.daemon.until(lambda s: s["pids"]["live"] not in (None, pid))
    view.until_served()


def test_client_that_does_not_read_delays_no_other(view: LiveView) -> None:
    stalled = [FoxgloveClient(view.port) for _ in range(3)]
    for client in stalled:
        client.subscribe(*TOPICS)
    with FoxgloveClient(view.port) as client:
        client.subscribe("/levid/cycle")
        client.until("/levid/cycle", 50)
        cycles = rows_of(client, "/levid/cycle")["cycle"].astype(int)
        assert (np.diff(cycles) > 0).all()
    for client in stalled:
        client.abort()


def test_rig_without_live_starts_no_process(view: LiveView, tmp_path: Path) -> None:
    rig = view.daemon.supervisor.rig.model_copy(update={"live": None})
    said: list[str] = []
    # Neither shared memory nor server: it must touch neither.
    link = LiveLink(rig, None, None, tmp_path, said.append)  # type: ignore[arg-type]
    link.announce()
    link.watch()
    assert link.pid is None
    assert not said
    link.end()
    assert not list(tmp_path.iterdir())


def test_missing_package_is_an_error_with_its_remedy(
    view: LiveView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=r"pip install 'levid\[live\]'"):
        LiveLink(view.daemon.supervisor.rig, None, None, tmp_path, print)  # type: ignore[arg-type]
