"""Test the answer that a client gets at the end of its flight."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from loop_with_scripted_clock import LIFT, ScriptedLoop

from levid.config.session import Step
from levid.daemon.control.faults import Fault
from levid.daemon.control.states import State
from levid.daemon.ipc.shared_status_words import Word
from levid.daemon.planning.plan import plan_steps
from levid.daemon.recording.log_router import LogFile
from levid.daemon.supervision import flight_runner as pilot_module
from levid.daemon.supervision.flight_runner import Job, JobRunner
from levid.drivers.base import Devices
from levid.log.signals import Stale


class Recorder:
    """Has every row on disk as soon as it is told to be."""

    def __init__(self) -> None:
        self.files: dict[int, list[Path]] = {}
        self.failed: dict[int, str] = {}
        self.problem = ""
        self.lost = ""

    def forget(self) -> None:
        return

    def receive(self) -> None:
        return

    def define(self, file: LogFile) -> int:
        tag = len(self.files) + 1
        self.files[tag] = [file.path]
        return tag


def job_of(flight: ScriptedLoop, told: list[Any], *steps: Step) -> Job:
    """Return a job of these steps that is logged; what its client is told goes into `told`."""
    reply: Any = SimpleNamespace(
        waiting=True,
        send=told.append,
        refuse=told.append,
        done=lambda **answer: told.append({"ok": True, **answer}),
    )
    plan = plan_steps(steps, "x", flight.rig, 0.0, 0.0)
    segments = [(step, step.segments()) for step in plan.steps]
    files = {0: LogFile(Path("a.mcap"), {}, {})}
    return Job(plan, segments, files, reply, lambda: None, (500, 200))


@pytest.mark.parametrize("cleared_after", [1, 100, None])
def test_a_flight_that_failed_is_not_well_flown_because_somebody_cleared(
    cleared_after: int | None,
) -> None:
    flight, told = ScriptedLoop(), []
    job_runner = JobRunner(flight.rig, flight.shared, Recorder())  # type: ignore[arg-type]
    job = job_of(flight, told, Step(levitate=LIFT), Step(land={}))
    control_words, ring = flight.control_words, flight.shared.ring

    def script(n: int) -> None:
        if n == 300:
            job_runner.begin(job)
        if n == 1200:
            flight.loop.state_machine.fail(Fault.GAP, "0.95 mm at sensor 3")
        if cleared_after and n == 1200 + cleared_after:
            job_runner.note_fault()  # as the supervisor does before it hands a clear on
            control_words.clear()
        if n > 3000:
            ring.durable = ring.head
        if not n % 10:
            job_runner.tick()

    flight.run(script, 3100)
    assert [each for each in told if isinstance(each, str)] == told[-1:]
    assert "GAP" in told[-1]
    assert "0.95 mm at sensor 3" in told[-1]


def test_client_is_told_that_a_slow_disk_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    flight, told = ScriptedLoop(), []
    job_runner = JobRunner(flight.rig, flight.shared, Recorder())  # type: ignore[arg-type]
    job = job_of(flight, told, Step(levitate=LIFT), Step(land={"ramp_s": 0.2, "release_s": 0.1}))
    ring, clock, now_s = flight.shared.ring, flight.clock, 0.0
    over = 300 + job.plan.cycles
    monkeypatch.setattr(pilot_module.time, "monotonic", lambda: now_s)

    def script(n: int) -> None:
        nonlocal now_s
        now_s = 1e-3 * n
        clock.skipped = 1 if n in (over - 20, over + 500) else 0
        if n == 300:
            job_runner.begin(job)
        if n == 7000:
            ring.durable = ring.head
        if not n % 10:
            job_runner.tick()

    flight.run(script, 7100)
    # Every half second from the end of the flight until all is on disk, some ticks of 10 ms late.
    waited = told.count({"step": "writing", "share": 1.0})
    assert (7000 - over) // 510 <= waited <= (7000 - over) // 500
    assert told[-1]["ok"]
    # The wait is no part of the flight, nor what was late in it; a look is ten cycles late at most.
    assert job.plan.cycles <= told[-1]["cycles"] <= job.plan.cycles + 12
    assert told[-1]["late"] == 1


def test_a_flight_whose_rows_never_reach_the_disk_did_not_go_well(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight, told, recorder = ScriptedLoop(), [], Recorder()
    job_runner = JobRunner(flight.rig, flight.shared, recorder)  # type: ignore[arg-type]
    job = job_of(flight, told, Step(levitate=LIFT), Step(land={"ramp_s": 0.2, "release_s": 0.1}))
    now_s = 0.0
    monkeypatch.setattr(pilot_module.time, "monotonic", lambda: now_s)
    monkeypatch.setattr(pilot_module, "_WRITING_S", 1.0)
    recorder.problem = "the recorder does not answer"

    def script(n: int) -> None:
        nonlocal now_s
        now_s = 1e-3 * n
        if n == 300:
            job_runner.begin(job)
        if not n % 10:
            job_runner.tick()

    flight.run(script, 300 + job.plan.cycles + 1200)
    assert told[-1] == "the last rows are not on the disk: the recorder does not answer"


def test_a_loop_that_dies_does_so_in_a_step_with_a_name() -> None:
    flight, told = ScriptedLoop(), []
    job_runner = JobRunner(flight.rig, flight.shared, Recorder())  # type: ignore[arg-type]
    job = job_of(flight, told, Step(levitate=LIFT), Step(land={}))
    ring = flight.shared.ring

    def script(n: int) -> None:
        if n == 300:
            job_runner.begin(job)
        if n == 600:
            job_runner.abort(Fault.LOOP, "killed by SIGKILL")
            ring.durable = ring.head
            flight.control_words[Word.WRITING] = 0
        if not n % 10:
            job_runner.tick()

    flight.run(script, 650)
    assert "LOOP" in told[-1]
    assert f"'{job.plan.steps[0].name}'" in told[-1]


@pytest.mark.parametrize("broken", ["no number", "no segments"])
def test_plan_that_cannot_be_flown_on_is_landed(broken: str) -> None:
    flight, told = ScriptedLoop(), []
    job_runner = JobRunner(flight.rig, flight.shared, Recorder())  # type: ignore[arg-type]
    job = job_of(
        flight, told, Step(levitate={**LIFT, "settle_s": 9.0}), Step(move={"beam_m": 0.01})
    )
    ring, (lift, move) = flight.shared.ring, job.segments

    def segments() -> Iterator[Any]:
        yield lift
        if broken == "no segments":
            raise MemoryError("no memory")
        moving = [replace(s, beam=np.full_like(s.beam, np.nan)) for s in move[1]]
        yield move[0], moving

    job.segments = segments()

    def script(n: int) -> None:
        if n == 300:
            job_runner.begin(job)
        if not n % 10:
            job_runner.tick()
        if n > 14_000:
            ring.durable = ring.head

    flight.run(script, 14_100)
    assert flight.control_words.fault is Fault.NONE
    assert flight.control_words.state is State.IDLE
    assert "the flight was landed early" in told[-1]
    assert job_runner.job is None


@pytest.mark.parametrize("dead", [True, False])
@pytest.mark.parametrize(
    ("settle_s", "away_s"),
    [(1.0, 0.0), (0.0, 0.0), (0.1, 2.0)],
    ids=["settles", "does-not-settle", "nobody-looks-in-time"],
)
def test_check_of_coils_is_judged_whatever_follows(
    settle_s: float, away_s: float, dead: bool
) -> None:
    told: list[Any] = []
    flight = ScriptedLoop(without_coil_3 if dead else lambda devices: devices)
    job_runner = JobRunner(flight.rig, flight.shared, Recorder())  # type: ignore[arg-type]
    lift = {"unload_s": 0.2, "ramp_s": 0.5, "settle_s": settle_s, "check_coils": {}}
    job = job_of(flight, told, Step(levitate=lift))
    job.holds = True
    pushed = 300 + job.plan.cycles - round(1e3 * settle_s)

    def script(n: int) -> None:
        if n == 300:
            job_runner.begin(job)
        if not n % 10 and not pushed - 50 < n < pushed + 1e3 * away_s:
            job_runner.tick()

    flight.run(script, 5000)
    assert job_runner.job is None
    if dead:
        assert flight.control_words.fault is Fault.COIL_CHECK
        assert "COIL_CHECK" in told[-1]
        assert "coil 3 moved the platform" in told[-1]
    else:
        assert flight.control_words.fault is Fault.NONE
        assert told[-1]["ok"]


@pytest.mark.parametrize("late", [1, 3])
def test_late_cycle_in_the_push_of_a_reversed_coil_hides_nothing(late: int) -> None:
    told: list[Any] = []
    flight = ScriptedLoop(with_coil_3_reversed)
    job_runner = JobRunner(flight.rig, flight.shared, Recorder())  # type: ignore[arg-type]
    job = checked(flight, told)
    clock, pushed = flight.clock, first_push(job)

    def script(n: int) -> None:
        # In the push of coil 0, which is sound, and of coil 3.
        clock.skipped = late if n in (pushed + 3, pushed + 3 * TURN + 12) else 0
        if n == 300:
            job_runner.begin(job)
        if not n % 10:
            job_runner.tick()

    flight.run(script, pushed + 9 * TURN + 100)
    assert flight.control_words.fault is Fault.COIL_CHECK
    assert flight.control_words.detail.startswith("coil 3 moved the platform")
    assert flight.control_words.detail.count("moved the platform") == 1
    assert not job_runner.coils_are_known


@pytest.mark.parametrize(("held", "shaken"), [(6, [4, 5]), (12, [4, 5, 6, 7, 8])])
def test_coil_whose_push_was_held_for_long_is_told_of_and_stays_unknown(
    held: int, shaken: list[int]
) -> None:
    told: list[Any] = []
    said: list[str] = []
    flight = ScriptedLoop()
    job_runner = JobRunner(flight.rig, flight.shared, Recorder(), said.append)  # type: ignore[arg-type]
    job, again = checked(flight, told), checked(flight, told)
    clock, pushed = flight.clock, first_push(job)
    over = pushed + 9 * TURN + 200

    def script(n: int) -> None:
        # Others are shaken by what the push of coil 4 has set going.
        clock.skipped = held if n == pushed + 4 * TURN + 12 else 0
        if n == 300:
            job_runner.begin(job)
        if n == over:
            assert told[-1]["unjudged_coils"] == shaken
            assert not job_runner.coils_are_known
            flight.control_words.land()
        if n == over + 1000:
            job_runner.begin(again)
        if not n % 10:
            job_runner.tick()

    flight.run(script, over + 1000 + pushed + 9 * TURN)
    assert flight.control_words.fault is Fault.NONE
    coils = ", ".join(map(str, shaken))
    (line,) = said
    assert f"skipped for coils {coils}:" in line
    assert told[-1]["unjudged_coils"] == []
    assert job_runner.coils_are_known
    flight.control_words.clear()  # somebody may have changed cables
    assert not job_runner.coils_are_known


@pytest.mark.parametrize(
    ("silent", "shaken"), [(5, [4, 5]), (12, [4, 5, 6, 7, 8])], ids=["short", "long"]
)
def test_coil_is_not_judged_while_its_amplifiers_say_nothing(
    silent: int, shaken: list[int]
) -> None:
    """Electronics that stand still hold a push for longer, and no period is skipped."""
    told: list[Any] = []
    amplifiers: list[Any] = []
    still = False

    def standing_still(devices: Devices) -> Devices:
        write, (drive,) = devices.amplifiers.write, [devices.amplifiers]

        def held(coil_n: np.ndarray) -> None:
            drive.stale = int(Stale.AMPLIFIERS) if still else 0
            if not still:
                write(coil_n)

        drive.write = held  # type: ignore[method-assign]
        amplifiers.append(drive)
        return devices

    flight = ScriptedLoop(standing_still)
    job_runner = JobRunner(flight.rig, flight.shared, Recorder())  # type: ignore[arg-type]
    job = checked(flight, told)
    pushed = first_push(job)

    def script(n: int) -> None:
        nonlocal still
        # The push changes its sign, and is held.
        still = pushed + 4 * TURN + 8 <= n < pushed + 4 * TURN + 8 + silent
        if n == 300:
            job_runner.begin(job)
        if not n % 10:
            job_runner.tick()

    flight.run(script, pushed + 9 * TURN + 150)
    assert flight.control_words.fault is Fault.NONE, flight.control_words.detail
    assert told[-1]["unjudged_coils"] == shaken


TURN = 82
"""Cycles of one coil's turn at 1 kHz: four times 8 ms, and 50 ms."""


def checked(flight: ScriptedLoop, told: list[Any]) -> Job:
    """Return a lift-off with a check of coils."""
    lift = {"unload_s": 0.2, "ramp_s": 0.5, "settle_s": 0.1, "check_coils": {}}
    job = job_of(flight, told, Step(levitate=lift))
    job.holds = True
    return job


def first_push(job: Job) -> int:
    """Return the cycle of the first push of a job that begins in cycle 300."""
    return 300 + job.plan.cycles - 100 - 9 * TURN


def with_coil_3_reversed(devices: Devices) -> Devices:
    # It carries the others' mean: what it is pushed by itself goes the other way.
    return with_coil_3(devices, lambda mean_n, own_n: 2.0 * mean_n - own_n)


def without_coil_3(devices: Devices) -> Devices:
    # It carries the others' mean: what it pushes itself alone is missing.
    return with_coil_3(devices, lambda mean_n, _: mean_n)


def with_coil_3(devices: Devices, force_n: Callable[[float, float], float]) -> Devices:
    """Let coil 3 give another force than its current says, of which the amplifiers know nothing."""
    write, read = devices.amplifiers.write, devices.amplifiers.read
    hidden_n = deque([0.0, 0.0], maxlen=2)

    def another(coil_n: np.ndarray) -> None:
        given = coil_n.copy()
        given[3] = force_n(np.delete(coil_n, 3).mean(), coil_n[3])
        hidden_n.append(coil_n[3] - given[3])
        write(given)

    def as_commanded(coil_n: np.ndarray) -> None:
        read(coil_n)
        coil_n[3] += hidden_n[0]  # a reading shows the command before the last

    devices.amplifiers.write = another  # type: ignore[method-assign]
    devices.amplifiers.read = as_commanded  # type: ignore[method-assign]
    return devices


def test_longest_check_of_coils_is_judged_however_late() -> None:
    told: list[Any] = []
    flight = ScriptedLoop(before_fault_s=0.1)
    job_runner = JobRunner(flight.rig, flight.shared, Recorder())  # type: ignore[arg-type]
    # Nine turns of 0.344 s are 3.1 s; 5.1 s of rows are kept, and 2 s of those are for the judge.
    lift = {"unload_s": 0.2, "ramp_s": 0.5, "settle_s": 1.0, "check_coils": {"pause_s": 0.312}}
    job = job_of(flight, told, Step(levitate=lift))
    job.holds = True
    pushed = 300 + job.plan.cycles - 1000

    def script(n: int) -> None:
        if n == 300:
            job_runner.begin(job)
        if not n % 10 and not pushed - 50 < n < pushed + 1900:
            job_runner.tick()

    flight.run(script, pushed + 2000)
    assert flight.control_words.fault is Fault.NONE
    assert told[-1]["ok"]
