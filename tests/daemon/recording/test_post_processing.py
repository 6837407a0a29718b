"""Test that identification or trace runs on the logs after landing, in its own process."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from levid.daemon.recording import post_processing
from levid.daemon.recording.post_processing import HandoverError, hand_over

LOGS = [Path("flown/01-z.mcap"), Path("flown/02-psi.mcap")]


@pytest.fixture
def called(monkeypatch):
    """Command lines that were run, and who ran them: its `code` is how they end."""
    commands: list[list[str]] = []

    def run(command, **_):
        commands.append(command)
        return SimpleNamespace(wait=lambda: run.code)

    run.code = 0
    monkeypatch.setattr(post_processing.subprocess, "Popen", run)
    return commands, run


@pytest.mark.parametrize("verb", ["identify", "trace"])
def test_verb_gets_all_logs_and_the_folder(called, verb: str) -> None:
    commands, _ = called
    hand_over(verb, LOGS, Path("flown/report"))
    (command,) = commands
    at = command.index(verb)
    assert command[at - 3 : at] == ["-P", "-m", "levid.cli.entry"]
    assert command[at + 1 :] == [*map(str, LOGS), "--out", str(Path("flown/report"))]


def test_failure_says_what_failed_and_where_the_logs_are(called) -> None:
    _, run = called
    run.code = 3
    with pytest.raises(HandoverError, match=r"levid trace of 2 records failed .*3.* are in flown"):
        hand_over("trace", LOGS, Path("flown/report"))
