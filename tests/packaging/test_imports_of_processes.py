"""Test that processes of the daemon start without what only takes time to import."""

from __future__ import annotations

import subprocess
import sys

import pytest

SLOW = ("numba", "scipy", "matplotlib")
"""Packages whose import takes 0.3 to 2 s."""


@pytest.mark.parametrize(
    "module",
    [
        "daemon.supervision.supervisor",
        "daemon.recording.recorder_process",
        "daemon.planning.planner_process",
        "daemon.live.live_process",
        "drivers.loopback",
    ],
)
def test_process_starts_without_slow_packages(module: str) -> None:
    script = f"import sys, levid.{module}; print(*(m for m in {SLOW} if m in sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert not done.stdout.strip()
