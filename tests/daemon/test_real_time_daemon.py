"""Test the daemon in real time over its socket: requests, refusals, a session, landing."""

import json
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from daemon_process import calm, daemon
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from waiting import wait_until

from levid.config.daemon_settings import Service
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.api.control_server import Server, ServerError
from levid.daemon.client import Client, DaemonError
from levid.daemon.host.peer_credentials import Access, peer_of
from levid.log.reader import read_log

RIG_FILE = shipped("rigs/loopback.yaml")
SESSION = """
levid: session
name: short
excitations: {psi: {input: psi, rms_n_m: 0.05}}
steps:
  - levitate: {unload_s: 0.2, ramp_s: 0.5, settle_s: 0.1}
  - record: {name: tilt, duration_s: 0.5, fade_s: 0.1, settle_s: 0.1, excite: [psi]}
  - land: {ramp_s: 0.5, release_s: 0.2}
"""


@pytest.fixture(scope="module")
def socket_file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("run")
    with daemon(calm(load_rig(RIG_FILE), folder), RIG_FILE, folder) as running:
        yield running.socket


def test_session_is_flown_and_logged_twice(socket_file: Path, tmp_path: Path) -> None:
    for name in ("first", "second"):
        shares: list[float] = []
        with Client(socket_file) as client:
            result = client.excite(
                SESSION, tmp_path / name, lambda _, share, to=shares: to.append(share)
            )
        assert [path.name for path in result.logs] == [
            "00-levitate.mcap",
            "01-tilt.mcap",
            "02-land.mcap",
        ]
        for path in result.logs:
            log = read_log(path)
            assert log.complete
            assert log.rows["fault"].max() == 0
        assert result.lost == 0
        assert shares == sorted(shares)


def test_log_time_is_the_time_of_day(socket_file: Path, tmp_path: Path) -> None:
    before = time.time_ns()
    with Client(socket_file) as client:
        result = client.excite(SESSION, tmp_path / "logs", lambda *_: None, note="21 °C")
    log = read_log(result.logs[0])
    assert log.metadata["note"] == "21 °C"
    # The loop counts periods from its start: a slip of a whole second would be a bug, not load.
    assert before - 1e9 < float(log.log_time_ns[0]) < time.time_ns() + 1e9


def test_land_ends_a_session_and_does_not_touch_the_next(socket_file: Path, tmp_path: Path) -> None:
    def land(step: str, share: float) -> None:
        with Client(socket_file) as other:
            other.request("land")

    long = SESSION.replace("duration_s: 0.5", "duration_s: 30")
    with Client(socket_file) as client:
        cut = client.excite(long, tmp_path / "cut", land)
        whole = client.excite(SESSION, tmp_path / "whole", lambda *_: None)
    assert cut.stopped
    assert not whole.stopped
    assert len(whole.logs) == 3


def test_another_rig_than_the_daemon_runs_is_refused(socket_file: Path, tmp_path: Path) -> None:
    other = RIG_FILE.read_text().replace("coil_n: 20", "coil_n: 10")
    with Client(socket_file) as client, pytest.raises(DaemonError, match="differs from the rig"):
        client.excite(SESSION, tmp_path / "logs", lambda *_: None, other)


def test_folder_that_cannot_be_made_is_refused_with_its_reason(socket_file: Path) -> None:
    with Client(socket_file) as client, pytest.raises(DaemonError, match="/proc/none"):
        client.excite(SESSION, Path("/proc/none/logs"), lambda *_: None)


@pytest.mark.parametrize(
    ("session", "message"),
    [
        ("levid: session\nname: x\nsteps: []\n", "steps"),
        (SESSION.replace("rms_n_m: 0.05", "rms_n_m: 50"), "saturate the coils"),
        (
            SESSION.replace("name: short", "name: short\nrate_hz: 1000"),
            "expected 250 Hz, as in the daemon's rig",
        ),
        ("{", "not valid YAML"),
    ],
)
def test_session_that_does_not_fit_is_refused(
    socket_file: Path, tmp_path: Path, session: str, message: str
) -> None:
    with Client(socket_file) as client, pytest.raises(DaemonError, match=message):
        client.excite(session, tmp_path / "logs", lambda *_: None)


def test_session_that_would_fill_the_memory_is_refused(socket_file: Path, tmp_path: Path) -> None:
    long = SESSION.replace("duration_s: 0.5", "duration_s: 86000").replace(
        "  - land", "  - record: {name: more, duration_s: 86000}\n  - land"
    )
    expected = "short: expected a total of at most 120000 s at 250 Hz, found 17200"
    with Client(socket_file) as client, pytest.raises(DaemonError, match=expected):
        client.excite(long, tmp_path / "logs", lambda *_: None)


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"nonsense",
        b"[]",
        b"{}",
        b'{"op": "fly"}',
        b'{"op": ["x"]}',
        b'{"op": "excite"}',
        b"\xff\xfe",
    ],
)
def test_nonsense_gets_an_answer_and_the_daemon_goes_on(socket_file: Path, line: bytes) -> None:
    with socket.socket(socket.AF_UNIX) as raw:
        raw.settimeout(10)
        raw.connect(str(socket_file))
        stream = raw.makefile("rwb")
        stream.write(line + b"\n")
        stream.flush()
        assert json.loads(stream.readline())["ok"] is False
    with Client(socket_file) as client:
        assert client.request("status")["fault"] == "NONE"


_PIECES = st.sampled_from(
    ["[", "{", '"', "1", "- ", "&a ", "*a, ", ": ", "\\n", "!!set ", "\t", "\u00e9"]
)
_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9), inner),
    max_leaves=20,
)
_REPEATED = st.builds(lambda piece, times: piece * times, _PIECES, st.integers(1, 100_000))
_REQUESTS = st.one_of(
    st.builds(
        lambda op, more: json.dumps({**more, "op": op}),
        st.sampled_from(["status", "move", "excite", "fly", ""]),
        st.dictionaries(st.text(max_size=9), _VALUES, max_size=5),
    ),
    _REPEATED.map(lambda text: json.dumps({"op": "excite", "out": "x", "session": SESSION + text})),
    _REPEATED.map(lambda text: text.replace("\n", " ")),
    st.builds(
        lambda op, value: json.dumps({"op": op, op: value}),
        st.sampled_from(["move", "levitate"]),
        _VALUES,
    ),
)


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(line=_REQUESTS)
def test_every_request_is_answered_and_none_ends_the_daemon(socket_file: Path, line: str) -> None:
    with socket.socket(socket.AF_UNIX) as raw:
        raw.settimeout(60)
        raw.connect(str(socket_file))
        raw.sendall(line.encode(errors="replace") + b"\n")
        answers = raw.makefile("rb")
        while "ok" not in (answer := json.loads(answers.readline())):
            pass
    assert answer["ok"] or 0 < len(answer["error"]) < 20_000
    with Client(socket_file) as client:
        if client.request("status")["state"] not in ("IDLE", "SELF_TEST"):
            client.request("land")  # some are requests
            wait_until(lambda: client.request("status")["state"] == "IDLE", 60.0)
        assert client.request("status")["fault"] == "NONE"


def test_client_that_hangs_up_costs_nothing(socket_file: Path) -> None:
    for _ in range(40):
        with socket.socket(socket.AF_UNIX) as raw:
            raw.connect(str(socket_file))
            raw.sendall(b'{"op": "sta')
    with Client(socket_file) as client:
        assert client.request("status")["rig"] == "loopback"


def test_second_daemon_on_one_socket_is_refused(socket_file: Path) -> None:
    with pytest.raises(ServerError, match="another daemon"):
        Server(socket_file, {}, Access(Service())).start()


def test_file_that_is_no_socket_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "precious.txt"
    path.write_text("mine")
    with pytest.raises(ServerError, match="another kind of file"):
        Server(path, {}, Access(Service())).start()
    assert path.read_text() == "mine"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives a process other groups")
def test_a_peer_is_known_by_all_of_its_groups(tmp_path: Path) -> None:
    path = str(tmp_path / "socket")
    connect = (
        "import socket, sys; s = socket.socket(socket.AF_UNIX); s.connect(sys.argv[1]); input()"
    )
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(path)
        listening.listen()
        with subprocess.Popen(
            [sys.executable, "-c", connect, path], extra_groups=[4242, 4243], stdin=subprocess.PIPE
        ) as process:
            accepted, _ = listening.accept()
            with accepted:
                peer = peer_of(accepted)
            assert process.stdin is not None
            process.stdin.write(b"\n")
    assert peer.pid == process.pid
    assert peer.gids == {os.getegid(), 4242, 4243}
    assert not Access(Service(allow_groups=(4243,))).refuses(replace(peer, uid=12345))


def test_whoever_was_hung_up_on_hears_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Access, "refuses", lambda *_: "it is not for you")
    server = Server(tmp_path / "levid.sock", {}, Access(Service()))
    server.start()
    try:
        with Client(tmp_path / "levid.sock") as client:
            poll = select.poll()
            poll.register(client._socket, 0)  # nothing but that the other end hung up
            assert poll.poll(30_000)
            with pytest.raises(DaemonError, match="it is not for you"):
                client.request("status")
    finally:
        server.close()


def test_no_daemon_says_how_to_start_one(tmp_path: Path) -> None:
    with pytest.raises(DaemonError, match="levid run RIG"), Client(tmp_path / "none.sock"):
        pass


def test_lift_off_is_refused_while_a_check_fails(tmp_path: Path) -> None:
    """With 1.4 times the gains this loop flies, but 1.36 times these would be unstable."""
    rig = calm(load_rig(RIG_FILE), tmp_path)
    control = rig.control.model_dump()
    stiff = {
        dof: {key: 1.4 * gain for key, gain in gains.items()} for dof, gains in control.items()
    }
    rig = rig.model_copy(update={"control": type(rig.control).model_validate(stiff)})
    with daemon(rig, RIG_FILE, tmp_path) as running, Client(running.socket) as client:
        checks = {f["check"]: f for f in client.request("status")["preflight"]}
        assert checks.keys() == {"devices", "amplifiers", "recorder", "real_time", "cpu", "loop"}
        assert checks["devices"]["outcome"] == checks["recorder"]["outcome"] == "passed"
        assert checks["loop"]["outcome"] == "failed"
        step = {"unload_s": 0.2, "ramp_s": 0.5, "settle_s": 0.1, "check_coils": False}
        with pytest.raises(DaemonError, match=r"loop: stable .*lower the gains.*--override loop"):
            client.request("levitate", levitate=step)
        assert client.request("status")["state"] == "IDLE"
        # The limit of timing only warns: this rig is simulated.
        client.request("levitate", levitate=step, override=["loop"], out=str(tmp_path / "out"))
        client.request("land")
        wait_until(lambda: client.request("status")["session"] is None, 60.0)
    log = read_log(tmp_path / "out" / "flight.mcap")
    assert log.metadata["override"] == "loop"
