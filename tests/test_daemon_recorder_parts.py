"""A recorder that follows a dead one begins a part that is nobody's, and leaves no empty ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from levid.daemon.recorder_process import without_empty_part
from levid.daemon.scribe import LogFile
from levid.log.signals import cycle_dtype
from levid.log.writer import LogWriter

METADATA = {"kind": "record", "name": "z"}


def log(path: Path, rows: int) -> None:
    dtype = cycle_dtype(9, 9)
    with LogWriter(path, dtype, rate_hz=1e3, metadata=METADATA, attachments={}) as writer:
        if rows:
            writer.write(np.zeros(rows, dtype), np.arange(rows, dtype=np.uint64))


@pytest.mark.parametrize("cut", ["whole", "in its head", "before its first byte"])
def test_part_that_nobody_was_told_of_is_taken_up_again(tmp_path: Path, cut: str) -> None:
    path = tmp_path / "01-z.mcap"
    log(path, 0)
    size = {"whole": path.stat().st_size, "in its head": 20, "before its first byte": 0}[cut]
    with path.open("r+b") as file:
        file.truncate(size)
    assert without_empty_part(LogFile(path, METADATA, {})).part == 1
    assert not path.exists()


def test_part_with_rows_stays(tmp_path: Path) -> None:
    path = tmp_path / "01-z.mcap"
    log(path, 10)
    assert without_empty_part(LogFile(path, METADATA, {})).part == 2
    assert without_empty_part(LogFile(path, METADATA, {}, part=2)).part == 2
    assert path.exists()


def test_part_before_without_rows_goes(tmp_path: Path) -> None:
    file = LogFile(tmp_path / "01-z.mcap", METADATA, {}, part=3)
    log(file.path, 10)
    log(file.path_of(2), 0)
    assert without_empty_part(file).part == 2
    assert not file.path_of(2).exists()
