"""Test the default coil check at the first lift-off after a start or a fault."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from daemon_process import Daemon, calm, daemon

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.log.reader import read_log

RIG_FILE = shipped("rigs/loopback.yaml")
LIFT = {"unload_s": 0.2, "ramp_s": 0.4, "settle_s": 0.3}
SESSION = """
levid: session
name: short
steps:
  - levitate: {unload_s: 0.2, ramp_s: 0.4, settle_s: 0.3}
  - record: {name: still, duration_s: 0.5, settle_s: 0, fade_s: 0.1}
  - land: {ramp_s: 0.3, release_s: 0.2}
"""


def pushed(file: Path) -> int:
    """Return how many coils were pushed in a log."""
    return int(read_log(file).rows["coil_excitation_n"].any(axis=0).sum())


def by_hand(running: Daemon, out: Path, **more: Any) -> int:
    """Lift off and land; return how many coils were pushed."""
    land = {"ramp_s": 0.3, "release_s": 0.2}
    running.ask("levitate", levitate={**LIFT, **more}, land=land, out=str(out))
    running.ask("land")
    running.until(lambda s: s["state"] == "IDLE" and s["session"] is None)
    return pushed(out / "flight.mcap")


@pytest.mark.real_time
def test_coils_are_pushed_until_they_are_known(tmp_path: Path) -> None:
    with daemon(calm(load_rig(RIG_FILE), tmp_path), RIG_FILE, tmp_path) as running:
        unknown = running.supervisor.job_runner
        assert by_hand(running, tmp_path / "refused", check_coils=False) == 0
        assert not unknown.coils_are_known
        answer = running.ask("excite", session=SESSION, out=str(tmp_path / "first"))
        assert pushed(tmp_path / "first" / "00-levitate.mcap") == 9
        assert pushed(tmp_path / "first" / "01-still.mcap") == 0  # it is over before any record
        known = 0 if not answer["unjudged_coils"] else 9
        assert by_hand(running, tmp_path / "second") == known
        assert by_hand(running, tmp_path / "asked for", check_coils={}) == 9
        running.ask("stop")
        running.ask("clear")
        assert by_hand(running, tmp_path / "cleared") == 9


def test_rig_whose_coils_cannot_be_pushed_flies_without_and_says_so(tmp_path: Path) -> None:
    rig = calm(load_rig(RIG_FILE), tmp_path, limits={"coil_n": 8.5, "beam_m": 0.02})
    with daemon(rig, RIG_FILE, tmp_path) as running:
        assert by_hand(running, tmp_path / "weak") == 0
        assert any("coil check after lift-off skipped: levitate" in said for said in running.said)
