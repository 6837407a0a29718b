"""A minute of sessions in real time: what half an hour of `benchmarks/daemon/soak.py` looks for.

What is asserted is memory, files and rows. When things happen is the machine's business: heartbeats
have bounds for one of any load, and late cycles are none of this.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType

import numpy as np
import pytest

from levid.benchmarks.daemon import soak
from levid.daemon.client import DaemonError

WHOLE_S, RECORD_S = 60.0, 1.5
LEAST_SESSIONS = 4  # of the eight that there is time for; two are for caches to fill


@pytest.mark.real_time
def test_a_minute_of_sessions_takes_no_memory_and_loses_no_row() -> None:
    flown = soak.Soak()
    soak.fly_sessions(flown, WHOLE_S, RECORD_S, {"supervisor_s": 30.0, "loop_s": 30.0})
    figures = {figure.key: figure for figure in soak.figures(flown)}
    assert not flown.failed
    assert len(flown.at_h) >= LEAST_SESSIONS
    judged = {key for key, figure in figures.items() if figure.met == "met"}
    assert {"missing_rows", "wrong_rows", "restarted", "cleared"} <= judged
    for process in soak.PROCESSES:
        # Half a minute cannot show 1 MB/h; what it can show are rows of a session that are kept.
        assert {f"{process}_grown_mb", f"{process}_files"} <= judged, figures
    assert not [key for key, figure in figures.items() if figure.met == "missed"]


def grown(soak: ModuleType, mb: Sequence[float], minutes: float) -> dict[str, str]:
    """Return what is said of a supervisor of these sizes, one a session of so many minutes."""
    flown = soak.Soak([i * minutes / 60 for i in range(len(mb))])
    for process in soak.PROCESSES:
        flown.sizes[process] = [soak.Size(50.0, 7)] * len(mb)
    flown.sizes["supervisor"] = [soak.Size(size, 7) for size in mb]
    return {figure.key: str(figure.met) for figure in soak.figures(flown) if figure.met}


def test_a_minute_shows_what_is_kept_and_half_an_hour_what_creeps() -> None:
    rng = np.random.default_rng(1)
    still, n = 50.0 + 0.05 * rng.standard_normal(30), np.arange(30)
    found = grown(soak, still[:8], 0.1)
    assert (found["supervisor_grown_mb"], found["supervisor_mb_h_95"]) == ("met", "not asked")
    assert grown(soak, still[:8] + 1.4 * n[:8], 0.1)["supervisor_grown_mb"] == "missed"
    # Caches fill in the first two.
    assert grown(soak, still[:8] + 9.0 * (n[:8] >= 2), 0.1)["supervisor_grown_mb"] == "met"
    found = grown(soak, still, 1.0)
    assert (found["supervisor_grown_mb"], found["supervisor_mb_h_95"]) == ("not asked", "met")
    assert grown(soak, still + n * 1.5 / 60, 1.0)["supervisor_mb_h_95"] == "missed"


def test_a_soak_that_fails_tells_what_it_has_seen(monkeypatch) -> None:

    def fails(soaked: object, *_: object) -> None:
        soaked.at_h.append(0.1)
        raise KeyboardInterrupt

    monkeypatch.setattr(soak, "fly_sessions", fails)
    figures = soak.measure(True)
    first = next(figures)
    assert (first.key, first.value) == ("sessions", 1)
    with pytest.raises(KeyboardInterrupt):
        list(figures)


def test_a_session_that_fails_ends_a_soak_and_is_told(monkeypatch) -> None:

    @contextmanager
    def running(*_: object) -> Iterator[None]:
        raise DaemonError("in fault LATE: x")
        yield

    monkeypatch.setattr(soak, "running", running)
    found = soak.Soak()
    soak.fly_sessions(found, 1.0, 1.0)
    (figure,) = (figure for figure in soak.figures(found) if figure.key == "failed")
    assert (figure.value, figure.met) == (1, "missed")
    assert "in fault LATE" in figure.label
