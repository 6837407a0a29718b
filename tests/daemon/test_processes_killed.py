"""Test the daemon with each of its processes killed, stopped or without processor time."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from daemon_process import CALM, GIVE_UP_S, Daemon, calm, daemon, refused
from waiting import wait_until

from levid.config.rig import RigConfig, load_rig
from levid.config.shipped import shipped
from levid.daemon.client import Client, DaemonError
from levid.daemon.control.faults import Fault
from levid.daemon.control.states import IN_FLIGHT, State, may_become
from levid.daemon.ipc.shared_status_words import Word
from levid.daemon.planning.planner_link import PlannerLink
from levid.log.errors import LogError
from levid.log.reader import Log, read_log

RIG_FILE = shipped("rigs/loopback.yaml")
SESSION = """
levid: session
name: long
excitations: {psi: {input: psi, rms_n_m: 0.05}}
steps:
  - levitate: {unload_s: 0.2, ramp_s: 0.5, settle_s: 0.1}
  - record: {name: tilt, duration_s: 60, settle_s: 0.1, excite: [psi]}
  - land: {ramp_s: 0.3, release_s: 0.2}
"""


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    folder = tmp_path_factory.mktemp("run")
    rig = calm(load_rig(RIG_FILE), folder, recording={"rotate_s": 5.0, "before_fault_s": 3.0})
    with daemon(rig, RIG_FILE, folder) as running:
        yield running


@pytest.fixture
def ready(shared: Daemon) -> Daemon:
    """The daemon at rest: what an earlier test left behind is cleared."""
    if shared.ask("status")["fault"] != "NONE":
        shared.ask("clear")
    shared.until(lambda s: s["state"] == "IDLE" and s["session"] is None)
    return shared


class Flying:
    """A session being flown for a client in another thread; `end` is what the client was told."""

    def __init__(
        self, running: Daemon, out: Path, session: str = SESSION, waits: bool = True
    ) -> None:
        self.running, self.out, self.end = running, out, ""
        self.answer: dict[str, object] = {}
        self._thread = threading.Thread(target=self._fly, args=(session,))
        self._thread.start()
        if waits:
            running.until(lambda s: s["step"] == "tilt")

    def _fly(self, session: str) -> None:
        with Client(self.running.socket) as client:
            try:
                self.answer = client.request("excite", session=session, out=str(self.out))
            except DaemonError as error:
                self.end = str(error)

    def join(self) -> str:
        self._thread.join(GIVE_UP_S)
        assert not self._thread.is_alive()
        return self.end

    def land(self) -> dict[str, object]:
        self.running.ask("land")
        assert self.join() == ""
        return self.answer


def recording(running: Daemon, fault: Fault) -> Log:
    """Return the flight recording of the fault at hand."""
    status = running.until(lambda s: s["fault_log"].endswith(f"-{fault.name}.mcap"))
    log = read_log(status["fault_log"])
    assert log.complete
    return log


@pytest.mark.parametrize("late", [False, True])
def test_dead_recorder_is_started_anew_and_no_row_is_lost(
    ready: Daemon, tmp_path: Path, late: bool
) -> None:
    before = ready.ask("status")["recorder_restarts"]
    flying = Flying(ready, tmp_path / "out")
    if late:  # a chunk of the record is on disk; else the part holds nothing, and is begun anew
        first = tmp_path / "out" / "01-tilt.mcap"
        ready.until(lambda _: first.exists() and first.stat().st_size > 20_000)
    os.kill(ready.ask("status")["pids"]["recorder"], signal.SIGKILL)
    status = ready.until(lambda s: s["recorder_restarts"] == before + 1 and not s["recording"])
    ready.until(lambda s: s["cycle"] > status["cycle"] + 125)  # rows for the new recorder
    answer = flying.land()
    assert answer["lost"] == 0
    names = [Path(path).name for path in answer["records"]]
    assert names[: 1 + late] == ["01-tilt.mcap", "01-tilt.2.mcap"][: 1 + late]
    rows = np.concatenate([read_log(path).rows for path in answer["logs"]])
    # What it had written and not yet told is written again: parts overlap, and nothing is missing.
    _, once = np.unique(rows["cycle"], return_index=True)
    rows = rows[once]
    periods = np.diff(rows["cycle"].astype(int))
    np.testing.assert_array_equal(periods, 1 + rows["skipped"][1:].astype(int))


def test_stopped_recorder_delays_nobody(ready: Daemon, tmp_path: Path) -> None:
    flying = Flying(ready, tmp_path / "out")
    pid = ready.ask("status")["pids"]["recorder"]
    os.kill(pid, signal.SIGSTOP)
    try:
        cycle = ready.ask("status")["cycle"]
        ready.until(lambda s: s["cycle"] > cycle + 100)
    finally:
        os.kill(pid, signal.SIGCONT)
    assert flying.land()["lost"] == 0


def test_flight_that_is_to_be_logged_waits_on_the_ground_for_the_recorder(
    ready: Daemon, tmp_path: Path
) -> None:
    pid = ready.ask("status")["pids"]["recorder"]
    os.kill(pid, signal.SIGSTOP)
    try:
        flying = Flying(ready, tmp_path / "out", waits=False)
        wait_until(lambda: not ready.supervisor.recorder.is_ready, GIVE_UP_S)
        cycle = ready.ask("status")["cycle"]
        assert ready.until(lambda s: s["cycle"] > cycle + 100)["state"] == "IDLE"
    finally:
        os.kill(pid, signal.SIGCONT)
    ready.until(lambda s: s["step"] == "tilt")
    result = flying.land()
    assert result["lost"] == 0
    assert read_log(result["logs"][0]).complete


def test_flight_is_refused_where_the_recorder_does_not_come(
    ready: Daemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("levid.daemon.supervision.request_handlers._RECORDER_S", 0.3)
    pid = ready.ask("status")["pids"]["recorder"]
    os.kill(pid, signal.SIGSTOP)
    try:
        step = {"unload_s": 0.1, "ramp_s": 0.2, "settle_s": 0.1}
        said = refused(ready, "levitate", levitate=step, out=str(tmp_path / "out"))
        assert "the recorder was not ready within 0.3 s" in said
        assert "does not lift off without it" in said
        assert ready.ask("status")["state"] == "IDLE"
        ready.ask("levitate", levitate=step)  # nothing of this is to be logged
        ready.ask("land")
        ready.until(lambda s: s["state"] == "IDLE")
    finally:
        os.kill(pid, signal.SIGCONT)


def test_fault_while_the_recorder_hangs_is_recorded_as_far_back_as_promised(
    ready: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("levid.daemon.recording.recorder_link.HUNG_S", 1.0)
    before = ready.ask("status")
    begun = before["cycle"]
    ready.until(lambda s: s["cycle"] > begun + 4 * 250)  # it promises 3 s
    os.kill(before["pids"]["recorder"], signal.SIGSTOP)
    ready.ask("stop")
    ready.until(lambda s: s["fault_log"] not in ("", before["fault_log"]))
    assert any("the recorder: it hung for 1 s" in line for line in ready.said)
    log = recording(ready, Fault.STOPPED)
    at = int(np.flatnonzero(np.diff(log.rows["fault"].astype(int)) > 0)[-1]) + 1
    assert int(log.rows["cycle"][at]) - int(log.rows["cycle"][0]) >= 3 * 250
    assert "lacks_s" not in log.metadata
    assert any(line.endswith(f"STOPPED: {ready.ask('status')['fault_log']}") for line in ready.said)


def test_reload_that_is_sent_to_every_process_ends_none(ready: Daemon) -> None:
    before = ready.ask("status")
    for name in ("loop", "recorder"):
        os.kill(before["pids"][name], signal.SIGHUP)
    after = ready.until(lambda s: s["cycle"] > before["cycle"] + 50 or s["fault"] != "NONE")
    for key in ("fault", "pids", "recorder_restarts"):
        assert after[key] == before[key]


def test_dead_loop_is_a_fault_and_is_started_anew(ready: Daemon, tmp_path: Path) -> None:
    flying = Flying(ready, tmp_path / "out")
    ready.until(lambda s: s["state"] == "EXCITING")
    os.kill(ready.ask("status")["pids"]["loop"], signal.SIGKILL)
    assert "fault LOOP" in flying.join()
    assert "killed by SIGKILL" in ready.ask("status")["detail"]
    # What it had flown is in a whole log, and in the flight recording.
    log = read_log(tmp_path / "out" / "01-tilt.mcap")
    assert log.complete
    assert State.EXCITING in recording(ready, Fault.LOOP).rows["state"]
    assert "clear it first" in refused(ready, "levitate")
    assert ready.ask("clear")["cleared"] == "LOOP"
    again = Flying(ready, tmp_path / "again")
    first = read_log(again.land()["logs"][0])
    assert first.rows["cycle"][0] > log.rows["cycle"][-1]  # one time runs on through both


def test_full_disk_ends_the_recording_and_not_the_flight(ready: Daemon, tmp_path: Path) -> None:
    flying = Flying(ready, tmp_path / "out")
    ready.until(lambda _: (tmp_path / "out" / "01-tilt.mcap").exists())
    pid = ready.ask("status")["pids"]["recorder"]
    limits = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        status = ready.until(lambda s: s["recording"])
        assert State[status["state"]] in IN_FLIGHT
        assert status["fault"] == "NONE"
        ready.ask("land")
        assert "recording failed" in flying.join()
        assert any("the flight goes on" in line for line in ready.said)
    finally:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, limits)
    assert read_log(tmp_path / "out" / "00-levitate.mcap").complete
    assert Flying(ready, tmp_path / "again").land()["lost"] == 0


def test_long_log_goes_on_in_another_file(ready: Daemon, tmp_path: Path) -> None:
    flying = Flying(ready, tmp_path / "out")
    second = tmp_path / "out" / "01-tilt.2.mcap"
    ready.until(lambda _: second.exists())
    answer = flying.land()
    assert str(second) in answer["records"]
    first, second_log = read_log(tmp_path / "out" / "01-tilt.mcap"), read_log(second)
    assert first.complete
    assert second_log.complete
    assert second_log.metadata["part"] == "2"
    assert second_log.rows["cycle"][0] > first.rows["cycle"][-1]


def test_stop_is_zero_force_from_there_on_whoever_holds_the_socket(
    ready: Daemon, tmp_path: Path
) -> None:
    flying = Flying(ready, tmp_path / "out")
    silent = [socket.socket(socket.AF_UNIX) for _ in range(100)]
    try:
        for connection in silent:
            connection.connect(str(ready.socket))
            connection.sendall(b'{"op": "sta')
        assert ready.ask("stop") == {"ok": True, "stopping": True}
    finally:
        for connection in silent:
            connection.close()
    assert "fault STOPPED" in flying.join()
    rows = read_log(tmp_path / "out" / "01-tilt.mcap").rows
    at = int(np.flatnonzero(rows["fault"])[0])
    assert rows["coil_n"][at - 1].any()
    assert not rows["coil_n"][at:].any()
    assert np.all(rows["fault"][at:] == Fault.STOPPED)
    assert np.all(rows["state"][at:] == State.FAULT)


def test_fault_is_on_disk_though_nothing_was_recorded(ready: Daemon) -> None:
    before = ready.ask("status")["fault_log"]  # may be of an earlier stop
    ready.ask("levitate", levitate={"unload_s": 0.2, "ramp_s": 0.4, "settle_s": 0.1})
    ready.ask("stop")
    ready.until(lambda s: s["fault_log"] != before)
    log = recording(ready, Fault.STOPPED)
    rows = log.rows
    at = int(np.flatnonzero(rows["fault"])[-1])
    assert rows["fault"][at] == Fault.STOPPED
    assert State.LEVITATING in rows["state"][:at]
    assert log.metadata["kind"] == "fault"
    assert "rig.yaml" in log.attachments


def test_states_follow_each_other_as_the_table_says(ready: Daemon, tmp_path: Path) -> None:
    step = {"ramp_s": 0.4, "settle_s": 0.1, "check_coils": {}}
    ready.ask("levitate", out=str(tmp_path / "out"), levitate=step)
    ready.ask("move", move={"beam_m": 0.005, "settle_s": 0.1})
    ready.ask("land")
    ready.until(lambda s: s["state"] == "IDLE")
    rows = read_log(tmp_path / "out" / "flight.mcap").rows
    assert rows["coil_excitation_n"].any(axis=0).all()  # every coil was pushed
    states = rows["state"]
    changes = [State(int(s)) for s in states[np.flatnonzero(np.diff(states)) + 1]]
    assert changes == [State.LEVITATING, State.MOVING, State.LEVITATING, State.LANDING]
    for before, after in zip([State.IDLE, *changes], changes, strict=False):
        assert may_become(before, after)


def test_client_that_dies_leaves_a_flight_or_has_it_landed(ready: Daemon, tmp_path: Path) -> None:
    before = ready.ask("status")["clients_gone"]
    for count, (gone, land) in enumerate((("land", False), ("go_on", True)), start=1):
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(ready.socket))
            request = {"op": "excite", "session": SESSION, "out": str(tmp_path / gone)}
            client.sendall(json.dumps({**request, "client_gone": gone}).encode() + b"\n")
            ready.until(lambda s: s["step"] == "tilt")
        if land:
            cycle = ready.ask("status")["cycle"]
            assert ready.until(lambda s, c=cycle: s["cycle"] > c + 50)["step"] == "tilt"
            ready.ask("land")
        ready.until(lambda s: s["session"] is None)
        log = read_log(tmp_path / gone / "02-land.mcap")
        assert log.complete
        assert log.rows["fault"].max() == 0
        assert ready.ask("status")["clients_gone"] == before + count
        what = "landing" if gone == "land" else "the flight goes on"
        assert sum(f"disconnected: {what}" in line for line in ready.said) == 1


@pytest.mark.parametrize(("gone", "state"), [("land", "IDLE"), ("go_on", "LEVITATING")])
def test_client_that_dies_while_it_lifts_off(ready: Daemon, gone: str, state: str) -> None:
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(ready.socket))
        step = {"ramp_s": 0.4, "settle_s": 3.0}
        request = {"op": "levitate", "levitate": step, "client_gone": gone}
        client.sendall(json.dumps(request).encode() + b"\n")
        ready.until(lambda s: s["state"] == "LEVITATING" and s["share"] > 0.2)
    assert ready.until(lambda s: s["session"] is None)["state"] == state
    ready.ask("land")
    ready.until(lambda s: s["state"] == "IDLE")


def test_move_leaves_the_landing_as_it_was_asked_for(ready: Daemon) -> None:
    step = {"unload_s": 0.1, "ramp_s": 0.2, "settle_s": 0.1}
    ready.ask("levitate", levitate=step, land={"ramp_s": 0.7, "release_s": 0.3})
    control_words = ready.supervisor.control_words
    asked = control_words[Word.LAND_RAMP], control_words[Word.LAND_RELEASE]
    ready.ask("move", move={"beam_m": 0.002, "settle_s": 0.1})
    assert (control_words[Word.LAND_RAMP], control_words[Word.LAND_RELEASE]) == asked == (175, 75)
    ready.ask("land")
    ready.until(lambda s: s["state"] == "IDLE")


@pytest.mark.parametrize("meanwhile", ["stop and clear", "land", "client gone"])
def test_nothing_lifts_off_that_was_called_off_while_it_was_planned(
    ready: Daemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, meanwhile: str
) -> None:
    planning, go_on, answer = threading.Event(), threading.Event(), PlannerLink.answer

    def answered(link: PlannerLink) -> Any:
        planning.set()
        return answer(link) if go_on.is_set() else None

    monkeypatch.setattr(PlannerLink, "answer", answered)
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(ready.socket))
        request = {"op": "excite", "session": SESSION, "out": str(tmp_path / "out")}
        client.sendall(json.dumps(request).encode() + b"\n")
        assert planning.wait(60.0)
        if meanwhile == "client gone":
            client.close()
        elif meanwhile == "land":
            assert not ready.ask("land")["landing"]
        else:
            ready.ask("stop")
            ready.until(lambda s: s["fault"] == "STOPPED")
            ready.ask("clear")
        go_on.set()
        if meanwhile != "client gone":
            answer = json.loads(client.makefile().readline())
            assert "cancelled" in answer["error"]
    # Another is taken up only when that one is over; this one flies.
    monkeypatch.undo()
    again = {"op": "levitate", "levitate": {"unload_s": 0.1, "ramp_s": 0.2, "settle_s": 0.1}}

    def accepted() -> bool:
        try:
            return bool(ready.ask(**again))
        except DaemonError:
            return False

    wait_until(accepted, GIVE_UP_S)
    ready.ask("land")
    ready.until(lambda s: s["state"] == "IDLE")


def test_session_in_flight_is_refused_before_a_folder_is_made(
    ready: Daemon, tmp_path: Path
) -> None:
    ready.ask("levitate", levitate={"unload_s": 0.1, "ramp_s": 0.2, "settle_s": 0.1})
    said = refused(ready, "excite", session=SESSION, out=str(tmp_path / "out"))
    assert "expected the state IDLE, found LEVITATING" in said
    assert not (tmp_path / "out").exists()
    ready.ask("land")
    ready.until(lambda s: s["state"] == "IDLE")


@pytest.fixture
def alone(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[bytes], Daemon]]:
    """`levid run` in a process of its own, which may be killed."""
    with run_of(calm(load_rig(RIG_FILE), tmp_path, service={"supervisor_s": 2.0}), tmp_path) as it:
        yield it


@contextmanager
def run_of(rig: RigConfig, tmp_path: Path) -> Iterator[tuple[subprocess.Popen[bytes], Daemon]]:
    file = tmp_path / "rig.yaml"
    plain = rig.model_dump(mode="json")
    plain |= {"sim": str(shipped("sims/nominal.yaml")), "socket": str(tmp_path / "levid.sock")}
    file.write_text(yaml.safe_dump(plain))
    process = run(file)
    running = Daemon(None, None, tmp_path / "levid.sock", [])  # type: ignore[arg-type]
    try:
        until_idle(process, running)
        yield process, running
    finally:
        process.send_signal(signal.SIGCONT)
        process.terminate()
        process.wait()


def run(file: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-m", "levid.cli.main", "run", str(file)])


def affinities(pid: int) -> list[set[int]]:
    """Return the processors of each thread of a process, the first one's first."""
    threads = sorted(int(path.name) for path in Path(f"/proc/{pid}/task").iterdir())
    return [os.sched_getaffinity(thread) for thread in threads]


def until_idle(process: subprocess.Popen[bytes], running: Daemon) -> None:
    def idle() -> bool:
        assert process.poll() is None
        try:
            return bool(running.ask("status")["state"] == "IDLE")
        except DaemonError:
            return False

    wait_until(idle, GIVE_UP_S)


def gone(pid: int) -> bool:
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return True
    return status.rpartition(")")[2].split()[0] == "Z"


@pytest.mark.real_time
def test_no_request_drops_a_platform_that_flies(tmp_path: Path) -> None:
    """Each once kept the supervisor from its heartbeat for seconds; half a second is a landing."""
    keys = {f"key_{i}": i for i in range(45_000)}
    digits = f"levid: session\nname: {'1' * 20_000}e\n"
    many = "levid: session\n" + "".join(f"key{i}: 1\n" for i in range(20_000))
    lines = [
        json.dumps({"op": "move", "move": keys}),
        json.dumps({"op": "excite", "out": "x", "session": digits}),
        json.dumps({"op": "excite", "out": "x", "session": many}),
        json.dumps({"op": "status", "more": "x" * 1_000_000}),
        "[" * 1_000_000,
    ]
    quick = {"unload_s": 0.2, "ramp_s": 0.4, "settle_s": 0.1}
    rig = calm(load_rig(RIG_FILE), tmp_path, service={"supervisor_s": 0.5})
    with run_of(rig, tmp_path) as (_, running):
        running.ask("levitate", levitate=quick)
        for line in lines:
            with socket.socket(socket.AF_UNIX) as client:
                client.connect(str(running.socket))
                client.sendall(line.encode() + b"\n")
                answers = client.makefile("rb")
                while "ok" not in (answer := json.loads(answers.readline())):
                    pass
            assert not answer["ok"]
            status = running.ask("status")
            assert (status["state"], status["fault"]) == ("LEVITATING", "NONE")
        running.ask("land")
        running.until(lambda s: s["state"] == "IDLE")


@pytest.mark.parametrize("supervisor_gone", ["land", "zero"])
def test_dead_supervisor_takes_all_along_and_leaves_whole_logs(
    tmp_path: Path, supervisor_gone: str
) -> None:
    service = {"supervisor_s": 30.0, "supervisor_gone": supervisor_gone}  # that it is dead is known
    rig = calm(load_rig(RIG_FILE), tmp_path, service=service)
    with run_of(rig, tmp_path) as (process, running):
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(running.socket))
            request = {"op": "excite", "session": SESSION, "out": str(tmp_path / "out")}
            client.sendall(json.dumps(request).encode() + b"\n")
            pids = running.until(lambda s: s["step"] == "tilt")["pids"]
            process.kill()
            process.wait()
        children = [pids[name] for name in ("loop", "recorder", "planner")]
        wait_until(lambda: all(map(gone, children)), GIVE_UP_S)
        log = read_log(tmp_path / "out" / "01-tilt.mcap")
        assert log.complete
        lands = supervisor_gone == "land"
        if lands:
            log = read_log(tmp_path / "out" / "02-land.mcap")
            assert log.complete
            states = log.rows["state"]
            assert set(states) == {State.LANDING, State.FAULT}
            assert (states == State.LANDING).sum() == pytest.approx(0.5 * 250, abs=2)
            assert log.rows["z_m"][-1] < -0.85e-3  # it sank, as the session lands
        (fault,) = (tmp_path / "faults").glob("*-SUPERVISOR.mcap")
        rows = read_log(fault).rows
        at = int(np.flatnonzero(rows["fault"])[0])
        assert rows["fault"][at] == Fault.SUPERVISOR
        assert not rows["coil_n"][at:].any()
        assert (State.LANDING in rows["state"]) is lands
        # Started again it is idle, whatever was flown before.
        again = run(tmp_path / "rig.yaml")
        try:
            until_idle(again, running)
        finally:
            again.terminate()
            assert again.wait() == 0


def nth_recording(folder: Path, n: int) -> Log:
    """Wait for the n-th flight recording of a supervisor that does not answer, and return it."""
    logs: list[Log] = []

    def complete() -> bool:
        found = sorted(folder.glob("*.mcap"))
        if len(found) >= n:
            with contextlib.suppress(LogError):  # not complete yet
                logs.append(read_log(found[-1]))
        return bool(logs) and logs[-1].complete

    wait_until(complete, GIVE_UP_S)
    return logs[-1]


def test_stopped_supervisor_is_noticed_and_can_go_on(
    alone: tuple[subprocess.Popen[bytes], Daemon], tmp_path: Path
) -> None:
    process, running = alone
    running.ask("levitate", levitate={"unload_s": 0.2, "ramp_s": 0.4, "settle_s": 0.1})
    process.send_signal(signal.SIGSTOP)
    time.sleep(0.5)  # shorter than supervisor_s, which is 2 s
    process.send_signal(signal.SIGCONT)
    cycle = running.ask("status")["cycle"]
    assert running.until(lambda s: s["cycle"] > cycle + 50)["state"] == "LEVITATING"
    process.send_signal(signal.SIGSTOP)
    try:
        log = nth_recording(tmp_path / "faults", 1)
    finally:
        process.send_signal(signal.SIGCONT)
    assert State.LANDING in log.rows["state"]
    assert not log.rows["coil_n"][log.rows["state"] == State.FAULT].any()
    status = running.until(lambda s: s["fault"] != "NONE")
    assert status["fault"] == "SUPERVISOR"
    assert status["detail"] == "no heartbeat"
    assert running.ask("clear")["cleared"] == "SUPERVISOR"


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two processors")
def test_loop_has_its_processors_and_the_others_the_rest(tmp_path: Path) -> None:
    *others, own = sorted(os.sched_getaffinity(0))
    realtime = {**CALM["realtime"], "cpus": (own,)}
    with run_of(calm(load_rig(RIG_FILE), tmp_path, realtime=realtime), tmp_path) as (_, running):
        pids = running.ask("status")["pids"]
        found = {name: affinities(pid) for name, pid in pids.items()}
    loop, *helpers = found.pop("loop")
    assert loop == {own}
    assert helpers
    assert all(one == {own, *others} for one in helpers)
    assert set(found) == {"supervisor", "recorder", "planner"}
    assert all(one == set(others) for threads in found.values() for one in threads)


def test_sigterm_in_flight_lands(alone: tuple[subprocess.Popen[bytes], Daemon]) -> None:
    process, running = alone
    quick = {"unload_s": 0.2, "ramp_s": 0.4, "settle_s": 0.1}
    running.ask("levitate", out=str(running.socket.parent / "out"), levitate=quick)
    process.terminate()
    assert process.wait() == 0
    rows = read_log(running.socket.parent / "out" / "flight.mcap").rows
    assert rows["state"][-1] in (State.LANDING, State.IDLE)
    # It sank: with a millimetre's rods and no force it would have dropped from zero.
    assert rows["z_m"][-1] < -0.85e-3
    assert rows["fault"].max() == 0
    assert not running.socket.exists()
