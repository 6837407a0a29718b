"""Test where the folder of a flight may be, and which logs are deleted for it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from mcap.writer import MCAP0_MAGIC

from levid.config.daemon_settings import Recording
from levid.daemon.planning.log_folder import make_folder
from levid.daemon.planning.log_retention import delete_old_logs
from levid.daemon.planning.refused_request import RefusedError

DAY_S = 86_400.0
NOW_S = 1.7e9


def flight(root: Path, name: str, age_days: float, size: int = 1_000_000) -> Path:
    """Write a flight of two logs and a report, last written so many days ago."""
    folder = root / name
    folder.mkdir(parents=True)
    for log in ("00-levitate.mcap", "01-noise.mcap"):
        (folder / log).write_bytes(MCAP0_MAGIC + os.urandom(size // 2))
        os.utime(folder / log, (NOW_S - age_days * DAY_S,) * 2)
    return folder


def left(root: Path) -> list[str]:
    return sorted(p.parent.name for p in root.rglob("00-levitate.mcap"))


def test_logs_go_by_age_but_not_the_newest(tmp_path: Path) -> None:
    for name, age in (("a", 40), ("b", 35), ("c", 31), ("d", 2)):
        flight(tmp_path, name, age)
    settings = Recording(root="x", keep_days=30, keep_flights=2)
    deleted = delete_old_logs(tmp_path, settings, 0, NOW_S)
    assert [f.folder.name for f in deleted] == ["a", "b"]
    assert left(tmp_path) == ["c", "d"]  # c is too old, but one of the newest two
    assert not (tmp_path / "a").exists()


def test_logs_go_until_those_to_come_fit_the_quota(tmp_path: Path) -> None:
    for name, age in (("a", 4), ("b", 3), ("c", 2), ("d", 1)):
        flight(tmp_path / "deeper", name, age)
    settings = Recording(root="x", quota_gb=3.1e-3, keep_flights=1)
    deleted = delete_old_logs(tmp_path, settings, 1_000_000, NOW_S)
    assert [f.folder.name for f in deleted] == ["a", "b"]
    # Never the newest, whatever the quota says.
    assert len(delete_old_logs(tmp_path, settings, 10**12, NOW_S)) == 1
    assert left(tmp_path) == ["d"]


def test_only_logs_are_deleted(tmp_path: Path) -> None:
    outside = flight(tmp_path, "outside", 99)
    root = tmp_path / "root"
    old = flight(root, "old", 99)
    (old / "identification").mkdir()
    (old / "notes.mcap").write_text("not a log")
    (old / "linked.mcap").symlink_to(outside / "00-levitate.mcap")
    (root / "elsewhere").symlink_to(outside)
    flight(root, "new", 0)
    settings = Recording(root="x", keep_days=1, keep_flights=1)
    assert [f.folder for f in delete_old_logs(root, settings, 0, NOW_S)] == [old]
    assert sorted(p.name for p in old.iterdir()) == ["identification", "linked.mcap", "notes.mcap"]
    assert len(list(outside.iterdir())) == 2


def test_without_limits_nothing_is_deleted(tmp_path: Path) -> None:
    flight(tmp_path, "a", 4000)
    assert not delete_old_logs(tmp_path, Recording(root="x", keep_flights=1), 10**15, NOW_S)


def test_folder_has_to_be_below_the_root(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    (root / "link").symlink_to(tmp_path)
    assert make_folder(root / "a" / "b", 0, str(root), Recording(root="x")) == ""
    for folder in (tmp_path / "c", root / ".." / "d", root / "link" / "e"):
        with pytest.raises(RefusedError, match=r"expected a folder below .*recording\.root"):
            make_folder(folder, 0, str(root), Recording(root="x"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["root"]


def test_deleted_logs_are_named(tmp_path: Path) -> None:
    for i in range(8):
        flight(tmp_path, f"f{i}", 50 - i)
    settings = Recording(root="x", keep_days=1, keep_flights=1)
    note = make_folder(tmp_path / "new", 0, str(tmp_path), settings)
    assert note.startswith("deleted old logs, 7 MB, of ")
    assert "f4 and 2 more" in note


def test_folder_on_a_full_disk_is_refused(tmp_path: Path) -> None:
    make_folder(tmp_path / "a", 1_000_000)
    with pytest.raises(RefusedError, match=r"disk: .*MB free; the logs take.*--override disk"):
        make_folder(tmp_path / "b", 1 << 60)


@pytest.mark.parametrize("key", ["quota_gb", "keep_days"])
def test_a_limit_needs_the_root_that_it_is_for(key: str) -> None:
    with pytest.raises(ValueError, match=f"{key}: expected the key root beside it"):
        Recording(**{key: 1.0})
