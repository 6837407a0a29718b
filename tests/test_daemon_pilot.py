"""What whoever asked for a flight is told of it in the end."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from scripted_loop import LIFT, ScriptedLoop

from levid.config.session import Step
from levid.daemon.board import Word
from levid.daemon.faults import Fault
from levid.daemon.pilot import Job, Pilot
from levid.daemon.plan import plan_steps
from levid.daemon.scribe import LogFile


class Recorder:
    """Has every row on disk as soon as it is told to be."""

    def __init__(self) -> None:
        self.files: dict[int, list[Path]] = {}
        self.failed: dict[int, str] = {}

    def forget(self) -> None:
        return

    def hear(self) -> None:
        return

    def define(self, file: LogFile) -> int:
        tag = len(self.files) + 1
        self.files[tag] = [file.path]
        return tag


@pytest.mark.parametrize("cleared_after", [1, 100, None])
def test_a_flight_that_failed_is_not_well_flown_because_somebody_cleared(
    cleared_after: int | None,
) -> None:
    flight, told = ScriptedLoop(), []
    pilot = Pilot(flight.rig, flight.shared, Recorder())  # type: ignore[arg-type]
    reply: Any = SimpleNamespace(
        waiting=True,
        send=lambda _: None,
        refuse=told.append,
        done=lambda **answer: told.append(answer),
    )
    plan = plan_steps([Step(levitate=LIFT), Step(land={})], "x", flight.rig, 0.0, 0.0)
    segments = [(step, step.segments()) for step in plan.steps]
    job = Job(plan, segments, {0: LogFile(Path("a.mcap"), {}, {})}, reply, lambda: None, (500, 200))
    board, ring = flight.board, flight.shared.ring

    def script(n: int) -> None:
        if n == 300:
            pilot.begin(job)
        if n == 1200:
            flight.loop._fail(Fault.GAP, "0.95 mm at sensor 3")
        if cleared_after and n == 1200 + cleared_after:
            pilot.note_fault()  # as the supervisor does before it hands a clear on
            board[Word.CLEAR] += 1
        if n > 3000:
            ring.durable = ring.head
        if not n % 10:
            pilot.tick()

    flight.run(script, 3100)
    assert len(told) == 1
    assert "GAP" in told[0]
    assert "0.95 mm at sensor 3" in told[0]
