"""Test that clock steps are distinguished from normal progress."""

from __future__ import annotations

import pytest

from levid.daemon.host.wall_clock_jumps import ClockWatch

MODULE = "levid.daemon.host.wall_clock_jumps"


def test_steps_are_noticed_once_and_summed(monkeypatch: pytest.MonkeyPatch) -> None:
    now = {"day": 1.7e9, "monotonic": 100.0}
    monkeypatch.setattr(f"{MODULE}.time.time", lambda: now["day"])
    monkeypatch.setattr(f"{MODULE}.time.monotonic", lambda: now["monotonic"])
    watch = ClockWatch()

    def passes(seconds: float, step: float = 0.0) -> float:
        now["monotonic"] += seconds
        now["day"] += seconds + step
        return watch.poll()

    assert passes(0.01) == 0.0
    assert passes(10.0, step=0.005) == 0.0  # slewed by ntpd, at its most
    assert passes(0.01, step=3600.0) == pytest.approx(3600.0, abs=1e-3)
    assert passes(0.01) == 0.0
    assert passes(0.01, step=-7200.0) == pytest.approx(-7200.0, abs=1e-3)
    assert watch.stepped_s == pytest.approx(-3600.0, abs=1e-2)
