"""Test that files are synced to the disk, and that disk errors are reported."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from levid.daemon.host.fsync_worker import FsyncWorker
from levid.log.signals import cycle_dtype
from levid.log.writer import LogWriter

DTYPE = cycle_dtype(9, 9)


def test_closed_file_and_its_folder_entry_are_synced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = []

    def fsync(descriptor: int) -> None:
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        synced.append((path, path.stat().st_size if path.is_file() else 0))

    monkeypatch.setattr(os, "fsync", fsync)
    syncer, path = FsyncWorker(), tmp_path / "01-z.mcap"
    path.write_bytes(b"x" * 1000)
    syncer.sync_closed(path)
    syncer.finish(30.0)
    assert synced == [(path, 1000), (tmp_path, 0)]
    assert syncer.failures() == []


def test_disk_error_is_reported_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fdatasync", refuse)
    syncer, rows = FsyncWorker(interval_s=0.0), np.zeros(20_000, DTYPE)
    with LogWriter(
        tmp_path / "01-z.mcap", DTYPE, rate_hz=1e3, metadata={"kind": "record"}, attachments={}
    ) as writer:
        for _ in range(3):
            writer.write(rows, np.zeros(len(rows), np.uint64))
            syncer.sync_growing(writer)
            syncer.finish(30.0)
    found = syncer.failures()
    assert [path.name for path, _ in found] == ["01-z.mcap"]
    assert "Input/output error" in found[0][1]
    assert syncer.failures() == []
