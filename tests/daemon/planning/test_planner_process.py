"""Test planning in the planner process: success, cancellation, time-out, limits."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from waiting import wait_until

from levid.config.base import ConfigError
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.client import DaemonError
from levid.daemon.control.faults import Fault
from levid.daemon.control.states import State
from levid.daemon.host.child_process import Child
from levid.daemon.ipc.shared_status_words import Word
from levid.daemon.planning.plan_memory_file import PlanFileError, memory_file, read_plan, write_plan
from levid.daemon.planning.planner import Planner
from levid.daemon.planning.planner_link import PlannerLink
from levid.daemon.planning.planner_process import Work
from levid.daemon.planning.refused_request import RefusedError, Situation
from levid.daemon.supervision import request_handlers as requests_module
from levid.daemon.supervision.request_handlers import Requests

RIG = load_rig(shipped("rigs/loopback.yaml"))
SESSION = """
levid: session
name: short
excitations: {psi: {input: psi, rms_n_m: 0.05}, coil: {input: "coil:3", rms_n: 0.1}}
steps:
  - levitate: {unload_s: 0.2, ramp_s: 0.5, settle_s: 0.1, check_coils: {}}
  - record:
      {name: tilt, duration_s: 1.5, excite: [psi, coil], beam: [{to_m: 0.01}, {to_m: -0.01}],
       beam_feedforward: false}
  - move: {beam_m: 0.005, settle_s: 0.1}
  - land: {}
"""
AT_REST = Situation(State.IDLE, beam_m=0.002, rotor_rad=0.1)
_GIVE_UP_S = 120.0


class Board(dict[Word, int]):
    fault, state, detail = Fault.NONE, State.IDLE, ""

    def land(self) -> None:
        self[Word.LAND] += 1


class Recorder:
    """Is ready when it is told to be."""

    def __init__(self) -> None:
        self.asked, self.is_ready, self.problem = 0, True, ""

    def request_ready(self) -> None:
        self.asked += 1


class Bench:
    """Requests, and a planner in this process that answers when `go_on` is set."""

    def __init__(self) -> None:
        self.control_words = Board({Word.LAND: 0, Word.CLEAR: 0, Word.LOOPS: 1})
        self.begun: list[Any] = []
        self.go_on, self.given_up, self.asked = True, 0, []
        self.recorder = Recorder()
        self.job_runner = SimpleNamespace(coils_are_known=True, begin=self.begun.append)
        self.planner = self
        self.manipulator = (0.0, 0.0)
        self.preflight = self
        self.failed_checks: dict[str, str] = {}
        self.log_root, self.log_folder = None, Path
        self.rig, self.attachments = RIG, {}
        self.stopping, self.told = False, []
        self.log_soon = self.told.append
        self.requests = Requests(self)  # type: ignore[arg-type]
        self.now_s = 0.0
        self.sent: list[dict[str, Any]] = []
        self.refused: list[str] = []

    def reply(self) -> Any:
        return SimpleNamespace(waiting=True, send=self.sent.append, refuse=self.refused.append)

    def start(self, work: Work, data: bytes, situation: Situation) -> None:
        self.asked.append((work, data, situation))

    def answer(self) -> Any:
        work, data, situation = self.asked[-1]
        if not self.go_on:
            return None
        return "" if work is Work.FOLDER else Planner(RIG).plan(data, situation)

    def require(self, overridden: Sequence[str]) -> list[str]:
        """Refuse for each failed check, as `Preflight` of a rig whose devices are real."""
        refused = [text for name, text in self.failed_checks.items() if name not in overridden]
        if refused:
            raise RefusedError("; ".join(refused))
        return [f"overridden: {text}" for text in self.failed_checks.values()]

    def discard(self) -> None:
        return

    def cancel(self) -> None:
        self.given_up += 1

    def tick(self, seconds: float = 0.01, times: int = 1) -> None:
        for _ in range(times):
            self.now_s += seconds
            self.requests.tick(self.now_s, dict)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    made = Bench()
    monkeypatch.setattr(requests_module.time, "monotonic", lambda: made.now_s)
    return made


def test_planning_that_takes_long_is_told_now_and_then(bench: Bench) -> None:
    bench.go_on = False
    bench.requests.handlers["levitate"]({"op": "levitate"}, bench.reply())
    bench.tick(1.0, 13)
    assert bench.sent == [{"step": "planning", "share": 0.0}] * 2
    bench.go_on = True
    bench.tick(1.0, 100)
    assert len(bench.sent) == 2
    assert len(bench.begun) == 1


def test_planning_that_never_ends_is_given_up_and_the_next_is_planned(bench: Bench) -> None:
    bench.go_on = False
    bench.requests.handlers["levitate"]({"op": "levitate"}, bench.reply())
    bench.tick(1.0, 590)
    with pytest.raises(RefusedError, match="is being flown, or is about to be"):
        bench.requests.handlers["levitate"]({"op": "levitate"}, bench.reply())
    bench.tick(1.0, 20)
    assert bench.given_up == 1
    assert len(bench.refused) == 1
    assert "planning timed out after 600 s" in bench.refused[0]
    bench.go_on = True
    bench.requests.handlers["levitate"]({"op": "levitate"}, bench.reply())
    bench.tick(0.01, 5)
    assert len(bench.begun) == 1


def test_flight_that_is_to_be_logged_waits_for_the_recorder_and_gives_up(bench: Bench) -> None:
    bench.recorder.is_ready = False
    line = {"op": "levitate", "out": "/tmp/x"}
    bench.requests.handlers["levitate"](line, bench.reply())
    bench.tick(1.0, 100)
    assert bench.sent[-1] == {"step": "recorder", "share": 0.0}
    bench.recorder.problem = "no recorder"
    bench.tick(1.0, 30)
    assert not bench.begun
    assert "the recorder was not ready within 120 s (no recorder)" in bench.refused[0]
    assert "does not lift off without it" in bench.refused[0]
    bench.requests.handlers["levitate"](line, bench.reply())
    bench.tick(1.0, 50)
    bench.recorder.is_ready = True
    bench.tick(1.0, 2)
    assert len(bench.begun) == 1
    assert bench.recorder.asked == 2


def test_failed_check_forbids_a_lift_off_until_it_is_overridden(bench: Bench) -> None:
    bench.failed_checks = {"loop": "unstable"}
    levitate = bench.requests.handlers["levitate"]
    levitate({"op": "levitate", "out": "/tmp/x"}, bench.reply())
    bench.tick(0.01, 5)
    assert bench.refused == ["unstable"]
    assert not bench.begun
    levitate({"op": "levitate", "out": "/tmp/x", "override": ["loop"]}, bench.reply())
    bench.tick(0.01, 5)
    (job,) = bench.begun
    assert bench.told[-1] == "overridden: unstable"
    assert job.files[0].metadata["override"] == "loop"
    folder, root, room = bench.asked[-1][1].split(b"\0")
    assert (folder, root) == (b"/tmp/x", b"")
    # An hour by hand at 1 kHz, of rows of some 400 bytes.
    assert 1e9 < int(room) < 3e9


def test_move_in_flight_is_not_checked_again(bench: Bench) -> None:
    bench.failed_checks = {"cpu": "slow"}
    bench.control_words.state = State.LEVITATING
    bench.requests.handlers["move"]({"op": "move", "move": {"beam_m": 0.01}}, bench.reply())
    bench.tick(0.01, 5)
    assert len(bench.begun) == 1


def test_flight_without_a_log_needs_no_recorder(bench: Bench) -> None:
    bench.recorder.is_ready = False
    bench.requests.handlers["levitate"]({"op": "levitate"}, bench.reply())
    bench.tick(0.01, 5)
    assert len(bench.begun) == 1
    assert not bench.recorder.asked


@pytest.mark.parametrize(
    "length",
    [
        {"duration_s": 3000.0},
        {"excite": ["psi", "z"], "each_s": 1500.0},
        {"excite": ["psi", "z"], "orthogonal": {"realisations": 150, "periods": 5}},
    ],
    ids=lambda length: next(reversed(length)),
)
def test_session_that_is_far_too_long_is_refused_before_it_is_planned(
    monkeypatch: pytest.MonkeyPatch, length: dict[str, Any]
) -> None:
    """Hundreds of records of 50 minutes each would be planned for hours."""
    monkeypatch.setattr("levid.daemon.planning.planner.plan_session", lambda *_, **__: 1 / 0)
    multisine = {"signal": "multisine", "period_s": 2.0, "band_hz": [1, 40]}
    records = [{"record": {"name": f"r{i}", "fade_s": 0.0, **length}} for i in range(500)]
    session = {
        "levid": "session",
        "name": "long",
        "excitations": {
            "psi": {"input": "psi", "rms_n_m": 0.05, **multisine},
            "z": {"input": "z", "rms_n": 0.05, **multisine},
        },
        "steps": [{"levitate": {}}, *records, {"land": {}}],
    }
    request = {"op": "excite", "session": yaml.safe_dump(session), "out": "x"}
    with pytest.raises(RefusedError, match=r"expected a total of at most 30000 s .* found 1\.50"):
        Planner(RIG).plan(json.dumps(request).encode(), AT_REST)


def test_a_plan_in_a_file_is_the_plan_that_was_written() -> None:
    request = {"op": "excite", "session": SESSION, "out": "over/there", "client_gone": "land"}
    request["note"] = "new rods, 21 °C"
    planned = Planner(RIG).plan(json.dumps(request).encode(), AT_REST)
    fd = memory_file("test")
    try:
        write_plan(fd, planned)
        found = read_plan(fd, 9)
    finally:
        os.close(fd)
    for key in ("op", "out", "landing", "client_gone", "session", "note"):
        assert getattr(found, key) == getattr(planned, key), key
    assert (found.plan.name, found.plan.rate_hz) == (planned.plan.name, planned.plan.rate_hz)
    assert found.plan.note == planned.plan.note == "new rods, 21 °C"
    assert found.plan.cycles == planned.plan.cycles
    for step, other in zip(found.plan.steps, planned.plan.steps, strict=True):
        assert (step.index, step.kind, step.name) == (other.index, other.kind, other.name)
        for segment, written in zip(step.segments(), other.segments(), strict=True):
            for key, value in vars(written).items():
                np.testing.assert_array_equal(getattr(segment, key), value)


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_no_damaged_plan_leads_beyond_its_file(data: st.DataObject) -> None:
    """Whatever 8 bytes of its tables are: it is refused, or every array lies within the file."""
    planned = Planner(RIG).plan(
        b'{"op": "levitate", "levitate": {"settle_s": 0.1, "ramp_s": 0.1, "unload_s": 0.1}}',
        AT_REST,
    )
    fd = memory_file("test")
    damaged = -1
    try:
        write_plan(fd, planned)
        whole = bytearray(os.pread(fd, 1 << 24, 0))
        tables = 1024  # at the end, and the header
        place = data.draw(
            st.one_of(st.integers(0, 300), st.integers(len(whole) - tables, len(whole) - 8))
        )
        word = data.draw(st.one_of(st.integers(-(2**63), 2**63 - 1), st.integers(-9, 1 << 20)))
        whole[place : place + 8] = word.to_bytes(8, "little", signed=True)
        damaged = memory_file("test", bytes(whole))
        seals = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE
        fcntl.fcntl(damaged, fcntl.F_ADD_SEALS, seals)
        try:
            found = read_plan(damaged, 9)
        except PlanFileError:
            return
        for step in found.plan.steps:
            for segment in step.segments():
                assert segment.v.shape[1] == segment.beam.shape[1] == 3
                segment.v.sum()  # every byte can be read
                segment.coil_excitation.sum()
    finally:
        os.close(fd)
        if damaged >= 0:
            os.close(damaged)


def test_a_plan_that_can_still_be_changed_is_not_read() -> None:
    fd = memory_file("test", b"x" * 4096)
    try:
        with pytest.raises(PlanFileError, match="expected a sealed memory file"):
            read_plan(fd, 9)
    finally:
        os.close(fd)


@pytest.fixture(scope="module")
def planner() -> Iterator[PlannerLink]:
    link = PlannerLink(RIG.model_dump_json().encode(), 9, print)
    link.watch()
    yield link
    link.end()


def answer_of(link: PlannerLink, data: bytes, work: Work = Work.PLAN) -> Any:
    link.start(work, data, AT_REST)
    answer = None

    def answered() -> bool:
        nonlocal answer
        link.watch()
        answer = link.answer()
        return answer is not None

    wait_until(answered, _GIVE_UP_S)
    return answer


def test_a_process_of_its_own_plans(planner: PlannerLink) -> None:
    request = {"op": "excite", "session": SESSION, "out": "x"}
    found = answer_of(planner, json.dumps(request).encode())
    expected = Planner(RIG).plan(json.dumps(request).encode(), AT_REST)
    assert found.plan.cycles == expected.plan.cycles
    np.testing.assert_array_equal(
        found.plan.steps[1].segments()[-1].v, expected.plan.steps[1].segments()[-1].v
    )


HOSTILE = {
    "70,000 unknown keys": json.dumps(
        {"op": "move", "move": {f"key_{i}": i for i in range(70_000)}}
    ),
    "a number of 20,000 digits": json.dumps(
        {"op": "excite", "out": "x", "session": f"levid: session\nname: {'1' * 20_000}e\n"}
    ),
    "brackets": "[" * 1_000_000,
    "a rig of aliases": json.dumps(
        {
            "op": "excite",
            "out": "x",
            "session": SESSION,
            "rig": "a: &a [x,x,x,x,x,x,x,x,x]\n"
            + "".join(
                f"{chr(98 + i)}: &{chr(98 + i)} [{','.join([f'*{chr(97 + i)}'] * 9)}]\n"
                for i in range(9)
            ),
        }
    ),
    "not text": "\udcff" * 2000,
    "another op": json.dumps({"op": "status", "more": "x" * 5000}),
}


@pytest.mark.parametrize("line", HOSTILE.values(), ids=HOSTILE)
def test_a_request_that_is_none_is_refused_in_few_words(planner: PlannerLink, line: str) -> None:
    with pytest.raises(RefusedError) as refused:
        answer_of(planner, line.encode(errors="surrogateescape"))
    assert 0 < len(str(refused.value)) < 10_000
    assert "processor time" not in str(refused.value)


def test_what_is_wanted_no_more_ends_and_the_next_is_planned(planner: PlannerLink) -> None:
    pid = planner.pid
    planner.start(
        Work.PLAN, json.dumps({"op": "excite", "session": SESSION, "out": "x"}).encode(), AT_REST
    )
    planner.discard()
    assert answer_of(planner, b'{"op": "levitate"}').op == "levitate"
    assert planner.pid == pid


def test_a_planner_that_dies_is_started_anew(planner: PlannerLink) -> None:
    assert planner.pid is not None
    os.kill(planner.pid, signal.SIGKILL)
    with pytest.raises(RefusedError, match=r"the planner .*: try again"):
        answer_of(planner, b'{"op": "levitate"}')

    def plans() -> bool:
        planner.watch()
        try:
            return bool(answer_of(planner, b'{"op": "levitate"}').op == "levitate")
        except RefusedError:
            return False

    wait_until(plans, _GIVE_UP_S)


def test_client_of_a_planner_that_dies_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from daemon_process import calm, daemon

    file = shipped("rigs/loopback.yaml")
    with daemon(calm(RIG, tmp_path), file, tmp_path) as running:
        answers: list[str] = []
        started: list[Work] = []
        start = running.supervisor.planner.start

        def noted(work: Work, *of: Any) -> None:
            start(work, *of)
            started.append(work)

        monkeypatch.setattr(running.supervisor.planner, "start", noted)

        def ask() -> None:
            try:
                running.ask("excite", session=SESSION, out=str(tmp_path / "out"))
            except DaemonError as error:
                answers.append(str(error))

        pid = running.ask("status")["pids"]["planner"]
        os.kill(pid, signal.SIGSTOP)
        client = threading.Thread(target=ask)
        client.start()
        wait_until(lambda: started, _GIVE_UP_S)
        os.kill(pid, signal.SIGKILL)
        client.join(_GIVE_UP_S)
        assert ["the planner ended" in answer for answer in answers] == [True]
        again = running.until(lambda s: s["pids"]["planner"] not in (None, pid))
        assert again["fault"] == "NONE"


def test_planner_that_does_not_come_back_is_started_anew(
    planner: PlannerLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("levid.daemon.planning.planner_link._CANCEL_S", 0.2)
    pid = planner.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    planner.start(Work.PLAN, b'{"op": "levitate"}', AT_REST)
    planner.discard()
    wait_until(lambda: planner.watch() or planner.pid not in (pid, None), _GIVE_UP_S)
    assert answer_of(planner, b'{"op": "levitate"}').op == "levitate"


@pytest.mark.parametrize("op", ["excite", "levitate"])
def test_a_log_needs_the_name_of_a_folder(op: str) -> None:
    request = {"op": op, "session": SESSION, "out": ""}
    with pytest.raises(RefusedError, match=r"expected .*folder"):
        Planner(RIG).plan(json.dumps(request).encode(), AT_REST)


@pytest.mark.parametrize("note", [7, ["x"], "two\nlines", "x" * 1001])
def test_a_note_that_does_not_fit_into_a_log_is_refused(note: object) -> None:
    request = {"op": "excite", "session": SESSION, "out": "x", "note": note}
    with pytest.raises(ConfigError, match="note: expected"):
        Planner(RIG).plan(json.dumps(request).encode(), AT_REST)


SERVER = """
import socket, sys
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.planning import planner_process
from levid.daemon.host.process_confinement import Confinement
from levid.daemon.planning.planner import Planner
from levid.daemon.planning.refused_request import RefusedError

plan = Planner.plan

def planned(self, line, situation):
    if line == b"again":
        raise RefusedError("as well as ever")
    while line == b"for ever":
        pass
    return plan(self, line, situation)

Planner.plan = planned
planner_process._PLANNING = Confinement(*map(int, sys.argv[2:]))
planner = Planner(load_rig(shipped("rigs/loopback.yaml")))
planner_process.warm_up(planner)
planner_process.PlannerProcess(planner, socket.socket(fileno=int(sys.argv[1]))).run()
"""


@pytest.mark.parametrize(
    ("limits", "why"),
    [
        ((1, 1 << 34, 1 << 34), "took more than .* s of processor time"),
        ((60, 1 << 24, 1 << 34), "memory limit"),
        ((60, 1 << 34, 1 << 14), "File too large"),
    ],
    ids=["cpu", "memory", "file"],
)
def test_limits_end_a_request_and_not_the_planner(
    monkeypatch: pytest.MonkeyPatch, limits: tuple[int, ...], why: str
) -> None:
    class Limited(Child):
        """A planner with these limits."""

        def start(self, _: object, fds: Sequence[int]) -> None:
            self._process = subprocess.Popen(
                [sys.executable, "-c", SERVER, str(fds[0]), *map(str, limits)],
                pass_fds=fds,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            )

    monkeypatch.setattr("levid.daemon.planning.planner_link.Child", Limited)
    link = PlannerLink(b"", 9, print)
    link.watch()
    monkeypatch.setattr(link, "watch", lambda: None)
    try:
        long = SESSION.replace("duration_s: 1.5", "duration_s: 1000")
        line = json.dumps({"op": "excite", "session": long, "out": "x"}).encode()
        with pytest.raises(RefusedError, match=why):
            answer_of(link, b"for ever" if limits[0] == 1 else line)
        with pytest.raises(RefusedError, match="as well as ever"):
            answer_of(link, b"again")
    finally:
        link.end()
