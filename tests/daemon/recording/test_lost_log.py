"""A log that is deleted, moved or cut off in flight is reported at once, and saved if it can be."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from daemon_process import calm, daemon
from recorder_in_thread import Recording
from waiting import wait_until

from levid.cli.status_text import status_lines
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.client import Client
from levid.daemon.host.lost_log import Loss, find_loss
from levid.daemon.ipc.shared_status_words import Word
from levid.log.errors import LogError
from levid.log.reader import read_log

ROWS, WRITTEN = 200, 128
"""The first chunks of a log have 32, 32 and 64 rows: the last 72 rows are not in the file yet."""


@pytest.fixture
def recording(tmp_path: Path) -> Iterator[Recording]:
    made = Recording(tmp_path / "out")
    made.folder.mkdir()
    yield made
    made.close()


def _begin(recording: Recording) -> Path:
    """Write rows, and return their log when it is on the disk."""
    recording.define(1)
    recording.shared.control_words[Word.LOG] = 1  # it goes on until it is NO_LOG
    recording.write(*[1] * ROWS)
    recording.start()
    path = recording.folder / "1.mcap"
    wait_until(lambda: recording.shared.ring.durable == WRITTEN)
    return path


def _deleted(path: Path) -> None:
    path.unlink()


def _folder_deleted(path: Path) -> None:
    shutil.rmtree(path.parent)


@pytest.mark.parametrize("happens", [_deleted, _folder_deleted])
def test_deleted_log_is_reported_in_flight_and_all_rows_are_kept(
    happens: Callable[[Path], None], recording: Recording
) -> None:
    path = _begin(recording)
    happens(path)
    # No row is written meanwhile: the report does not wait for one.
    wait_until(lambda: recording.event("deleted", log=1, path=str(path)))
    wait_until(lambda: recording.event("restored", log=1, path=str(path), why=""))
    recording.write(*[1] * ROWS)
    recording.finish()
    assert not recording.event("failed")
    assert recording.cycles("1.mcap") == list(range(ROWS))
    assert recording.cycles("1.2.mcap") == list(range(ROWS, 2 * ROWS))
    assert read_log(path).complete


def test_log_deleted_just_before_its_end_is_restored(recording: Recording) -> None:
    path = _begin(recording)
    path.unlink()
    recording.finish()
    assert recording.event("restored", log=1, path=str(path), why="")
    assert recording.cycles("1.mcap") == list(range(ROWS))


def test_file_that_took_the_place_of_a_deleted_log_stays(recording: Recording) -> None:
    path = _begin(recording)
    path.unlink()
    path.write_text("another file")
    wait_until(lambda: recording.event("restored", log=1))
    recording.finish()
    assert path.read_text() == "another file"
    assert recording.cycles("1.recovered.mcap") == list(range(ROWS))


def test_deleted_log_that_cannot_be_restored_is_reported(recording: Recording) -> None:
    path = _begin(recording)
    shutil.rmtree(path.parent)
    path.parent.write_text("a file where the folder was")
    wait_until(lambda: recording.event("restored", log=1, why="Not a directory"))


def test_moved_log_is_reported_once_and_recorded_on(recording: Recording) -> None:
    path = _begin(recording)
    moved = path.with_name("moved.mcap")
    path.rename(moved)
    wait_until(lambda: recording.event("lost", log=1, path=str(path)))
    recording.write(*[1] * ROWS)
    recording.finish()
    assert sum(event["event"] == "lost" for event in recording.events) == 1
    assert "moved in flight, or its disk was unmounted" in str(recording.events)
    assert recording.cycles("moved.mcap") == list(range(2 * ROWS))


def test_log_that_is_cut_off_is_reported_and_continues_in_the_next_part(
    recording: Recording,
) -> None:
    path = _begin(recording)
    os.truncate(path, 100)
    wait_until(lambda: recording.event("lost", log=1, path=str(path)))
    assert "was cut off in flight, to 100 of" in str(recording.events)
    recording.write(*[1] * ROWS)
    recording.finish()
    assert recording.cycles("1.2.mcap") == list(range(ROWS, 2 * ROWS))
    with pytest.raises(LogError):
        read_log(path)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a disk")
def test_disk_that_is_unmounted_or_becomes_read_only_is_reported(recording: Recording) -> None:
    def mount(*words: str) -> bool:
        return subprocess.run(["mount", *words], check=False, capture_output=True).returncode == 0

    folder = str(recording.folder)
    if not mount("-t", "tmpfs", "tmpfs", folder):
        pytest.skip("this machine lets nobody mount a disk")
    try:
        path = _begin(recording)
        subprocess.run(["umount", "--lazy", folder], check=True)
        wait_until(lambda: recording.event("lost", log=1, path=str(path)))
    finally:
        subprocess.run(["umount", "--lazy", folder], check=False, capture_output=True)


def test_log_in_place_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(bytes(100))
    with path.open("rb") as file:
        assert find_loss(path, file.fileno(), 100) is None
        path.with_name("link").hardlink_to(path)
        assert find_loss(path, file.fileno(), 100) is None
        path.unlink()
        found = find_loss(path, file.fileno(), 100)
        assert found is not None
        assert found.loss is Loss.MOVED  # by its other name it is still there


SESSION = """
levid: session
name: short
steps:
  - levitate: {unload_s: 0.2, ramp_s: 0.5, settle_s: 0.1}
  - record: {name: still, duration_s: 5, fade_s: 0.1}
  - land: {ramp_s: 0.5, release_s: 0.2}
"""


def test_client_and_status_of_a_daemon_say_at_once_that_a_log_was_deleted(tmp_path: Path) -> None:
    rig_file, out, warnings = shipped("rigs/loopback.yaml"), tmp_path / "out", list[str]()
    deleted = out / "01-still.mcap"
    states: list[tuple[str, float]] = []
    with daemon(calm(load_rig(rig_file), tmp_path), rig_file, tmp_path) as running:

        def report(step: str, share: float) -> None:
            before = [step for step, _ in states]
            states.append((step, share))
            if step == "still" and "still" not in before:
                deleted.unlink()

        def warn(text: str) -> None:
            warnings.append(text)
            states.append(("warned", 0.0))
            status = running.ask("status")
            assert "01-still.mcap: was deleted in flight" in status["log_lost"]
            assert any("was deleted in flight" in line for line in running.said)
            assert "01-still.mcap: was deleted" in "\n".join(status_lines(status))

        with Client(running.socket) as client:
            result = client.excite(SESSION, out, report, warn=warn)
    assert len(warnings) == 1
    steps = [step for step, _ in states]
    assert "still" in steps[steps.index("warned") + 1 :], "while it was still being recorded"
    names = ["00-levitate.mcap", "01-still.mcap", "01-still.2.mcap", "02-land.mcap"]
    assert [path.name for path in result.logs] == names
    rows = [read_log(path).rows for path in result.logs]
    cycles, skipped = (np.concatenate([r[name] for r in rows]) for name in ("cycle", "skipped"))
    assert np.array_equal(np.diff(cycles), 1 + skipped[1:].astype(np.int64)), "no row is lost"
