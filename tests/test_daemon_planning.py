"""Whoever waits for a long session to be planned hears that it is, and does not give up."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.board import Word
from levid.daemon.faults import Fault
from levid.daemon.pilot import RefusedError
from levid.daemon.requests import Requests
from levid.daemon.states import State


class Board(dict[Word, int]):
    fault, state = Fault.NONE, State.IDLE


def test_planning_that_takes_long_is_told_now_and_then() -> None:
    began, go_on, refused = threading.Event(), threading.Event(), threading.Event()
    sent: list[dict[str, Any]] = []
    reply: Any = SimpleNamespace(send=sent.append, refuse=lambda _: refused.set())
    board = Board({Word.LAND: 0, Word.CLEAR: 0, Word.LOOPS: 1})
    requests = Requests(SimpleNamespace(board=board))  # type: ignore[arg-type]

    def planner(*_: object) -> Any:
        began.set()
        go_on.wait(60.0)
        raise ValueError("enough")

    requests.start()
    requests._plan(planner, {}, reply)
    assert began.wait(60.0)
    assert requests._turn is not None
    begin_s = requests._turn.told_s
    for passed_s in (1.0, 6.0, 7.0, 12.0):
        requests.tick(begin_s + passed_s, dict)
    assert sent == [{"step": "planning", "share": 0.0}] * 2
    go_on.set()
    assert refused.wait(60.0)
    requests.tick(begin_s + 100.0, dict)
    assert len(sent) == 2


def test_planning_that_never_ends_is_given_up_and_the_next_is_planned() -> None:
    go_on, planned = threading.Event(), threading.Event()
    told: list[str] = []
    posted: list[Any] = []
    board = Board({Word.LAND: 0, Word.CLEAR: 0, Word.LOOPS: 1})
    supervisor: Any = SimpleNamespace(board=board, post=posted.append)
    requests = Requests(supervisor)

    def reply(name: str) -> Any:
        return SimpleNamespace(
            waiting=True, send=lambda _: None, refuse=lambda why: told.append(f"{name}: {why}")
        )

    def dead_mount(*_: object) -> Any:
        planned.set()
        assert go_on.wait(60.0)
        return "the first job"

    def quick(*_: object) -> Any:
        planned.set()
        return "the second job"

    def wait_for(happened: Callable[[], object]) -> None:
        give_up_s = time.monotonic() + 30.0
        while not happened():
            assert time.monotonic() < give_up_s
            time.sleep(0.001)

    requests.start()
    requests._plan(dead_mount, {}, reply("first"))
    wait_for(planned.is_set)
    now_s = time.monotonic()
    requests.tick(now_s + 590.0, dict)
    with pytest.raises(RefusedError, match="is being flown, or is about to be"):
        requests._plan(quick, {}, reply("second"))
    threads = threading.active_count()
    requests.tick(now_s + 610.0, dict)
    assert len(told) == 1
    assert told[0].startswith("first: planning took longer than 600 s and is given up")
    requests._plan(quick, {}, reply("second"))
    wait_for(lambda: posted)
    second = requests._turn
    go_on.set()  # it comes to its end after all, and nobody wants it
    wait_for(lambda: threading.active_count() == threads)
    assert [begin.args[0] for begin in posted] == ["the second job"]
    assert requests._turn is second is not None
    assert len(told) == 1


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
    """A thousand records of 50 minutes each would be planned for hours."""
    monkeypatch.setattr("levid.daemon.requests.plan_session", lambda *_, **__: 1 / 0)
    rig = load_rig(shipped("rigs/loopback.yaml"))
    supervisor: Any = SimpleNamespace(board=Board(), rig=rig)
    multisine = {"signal": "multisine", "period_s": 2.0, "band_hz": [1, 40]}
    records = [{"record": {"name": f"r{i}", "fade_s": 0.0, **length}} for i in range(1000)]
    session = {
        "levid": "session",
        "name": "long",
        "excitations": {
            "psi": {"input": "psi", "rms_n_m": 0.05, **multisine},
            "z": {"input": "z", "rms_n": 0.05, **multisine},
        },
        "steps": [{"levitate": {}}, *records, {"land": {}}],
    }
    reply: Any = None
    with pytest.raises(RefusedError, match=r"expected at most 30000 s in all .* found 3\.00"):
        Requests(supervisor)._session({"session": yaml.safe_dump(session), "out": "x"}, reply)
