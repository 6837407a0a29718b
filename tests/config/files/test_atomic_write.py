"""Files appear complete or not at all, and through no link."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from levid.config.files.atomic_write import (
    atomic_file,
    empty_file,
    open_new,
    replace_link,
    write_file,
)


@pytest.fixture(params=["unnamed", "named", "named_without_hard_links"])
def _file_system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the file system lack what network shares and FAT lack."""
    if request.param == "unnamed":
        return
    real_open, real_link = os.open, os.link

    def without_unnamed(path: str, flags: int, *rest: int, **more: int) -> int:
        if flags & os.O_TMPFILE == os.O_TMPFILE:
            raise OSError(errno.EOPNOTSUPP, "Operation not supported")
        return real_open(path, flags, *rest, **more)

    def no_link(*_: object, **__: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "open", without_unnamed)
    monkeypatch.setattr(os, "link", real_link if request.param == "named" else no_link)


@pytest.mark.usefixtures("_file_system")
def test_file_is_written_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    write_file(path, "old")
    write_file(path, "new \udce9")  # half a character of a file name
    assert path.read_text() == "new \\udce9"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.usefixtures("_file_system")
def test_existing_file_and_dangling_link_stay_if_they_may_not_be_replaced(tmp_path: Path) -> None:
    path, link, target = tmp_path / "log.mcap", tmp_path / "link.mcap", tmp_path / "target"
    link.symlink_to(target)
    write_file(path, "first", replace=False)
    for name in (path, link):
        with pytest.raises(FileExistsError) as error:
            write_file(name, "second", replace=False)
        assert error.value.filename == str(name)
    assert path.read_text() == "first"
    assert not target.exists()
    assert sorted(tmp_path.iterdir()) == [link, path]


@pytest.mark.usefixtures("_file_system")
def test_file_that_another_process_creates_meanwhile_stays(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with pytest.raises(FileExistsError), atomic_file(path, replace=False):
        path.write_text("theirs")
    assert path.read_text() == "theirs"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.usefixtures("_file_system")
@pytest.mark.parametrize("kind", [OSError, KeyboardInterrupt])
def test_interrupted_file_leaves_the_old_one_alone(
    tmp_path: Path, kind: type[BaseException]
) -> None:
    path = tmp_path / "model.yaml"
    write_file(path, "old")

    def half() -> None:
        with atomic_file(path) as file:
            file.write(b"half")
            raise kind(errno.ENOSPC, "No space left")

    with pytest.raises(kind) as raised:
        half()
    if isinstance(raised.value, OSError):
        assert raised.value.filename == str(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.usefixtures("_file_system")
@pytest.mark.parametrize("failing", ["fsync", "rename"])
def test_error_while_the_file_takes_its_place_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    path = tmp_path / "model.yaml"
    write_file(path, "old")

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, failing, interrupted)
    if failing == "rename" and os.link.__name__ == "no_link":
        pytest.skip("the name is given by rename alone")
    with pytest.raises(KeyboardInterrupt):
        write_file(path, "new")
    monkeypatch.undo()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_killed_process_leaves_no_file(tmp_path: Path) -> None:
    program = (
        "import os, sys\nfrom levid.config.files.atomic_write import atomic_file\n"
        "with atomic_file(sys.argv[1]) as file:\n"
        "    file.write(bytes(100_000)); file.flush(); os.kill(os.getpid(), 9)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path / "x")], check=False, timeout=60)
    assert list(tmp_path.iterdir()) == []


def test_link_in_place_of_the_file_is_replaced_and_its_target_stays(tmp_path: Path) -> None:
    victim, path = tmp_path / "victim", tmp_path / "result.json"
    victim.write_text("precious")
    path.symlink_to(victim)
    write_file(path, "result")
    assert victim.read_text() == "precious"
    assert path.read_text() == "result"
    assert not path.is_symlink()


def test_hard_link_in_place_of_the_file_is_replaced(tmp_path: Path) -> None:
    victim, path = tmp_path / "victim", tmp_path / "result.json"
    victim.write_text("precious")
    path.hardlink_to(victim)
    write_file(path, "result")
    assert victim.read_text() == "precious"


def test_permissions_follow_the_umask_or_the_replaced_file(tmp_path: Path) -> None:
    def mode(path: Path) -> int:
        return stat.S_IMODE(path.stat().st_mode)

    path, secret = tmp_path / "a", tmp_path / "token"
    before = os.umask(0o027)
    try:
        write_file(path, "")
        assert mode(path) == 0o640
        path.chmod(0o604)
        write_file(path, "")
        assert mode(path) == 0o604
        write_file(secret, "", mode=0o600)
        assert mode(secret) == 0o600
        new = tmp_path / "log"
        os.close(open_new(new))
        assert mode(new) == 0o640
    finally:
        os.umask(before)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_permissions_of_the_file_of_another_user_do_not_count(tmp_path: Path) -> None:
    path = tmp_path / "planted"
    path.write_text("")
    path.chmod(0o666)
    os.chown(path, 65534, 65534)
    write_file(path, "result")
    assert path.stat().st_uid == 0
    assert not path.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _folder(path: Path) -> None:
    path.mkdir()


def _pipe(path: Path) -> None:
    os.mkfifo(path)


@pytest.mark.parametrize("make", [_folder, _pipe])
def test_only_a_file_is_replaced(tmp_path: Path, make: Callable[[Path], None]) -> None:
    path = tmp_path / "out.csv"
    make(path)
    with pytest.raises(OSError, match=r"directory|expected a file, found a device, pipe") as error:
        write_file(path, "")
    assert error.value.filename == str(path)


def test_new_file_for_a_log_in_flight_follows_no_link(tmp_path: Path) -> None:
    path, target = tmp_path / "01-noise.mcap", tmp_path / "target"
    path.symlink_to(target)
    with pytest.raises(FileExistsError) as error:
        open_new(path)
    assert error.value.filename == str(path)
    assert not target.exists()


def test_link_to_a_terminal_is_replaced_at_once(tmp_path: Path) -> None:
    path = tmp_path / "port"
    replace_link(path, "/dev/pts/1")
    replace_link(path, "/dev/pts/2")
    assert path.readlink() == Path("/dev/pts/2")
    assert list(tmp_path.iterdir()) == [path]


def test_error_names_the_file(tmp_path: Path) -> None:
    for path in (tmp_path / "none" / "x", tmp_path / ("n" * 300)):
        with pytest.raises(OSError) as error:  # noqa: PT011 - its file is checked
            write_file(path, "")
        assert error.value.filename in (str(path), str(path.parent))


@pytest.mark.usefixtures("_file_system")
def test_temporary_name_is_never_the_same(tmp_path: Path) -> None:
    """Who knows the name could put a link there."""
    names: list[str] = []
    for _ in range(2):
        with atomic_file(tmp_path / "x"):
            names += [path.name for path in tmp_path.iterdir() if path.name != "x"]
    assert len(set(names)) == len(names)


def test_file_is_emptied_in_its_place_but_not_through_a_second_name(tmp_path: Path) -> None:
    path, victim = tmp_path / "heat.json", tmp_path / "victim"
    path.write_text("old")
    empty_file(path)
    assert path.read_bytes() == b""
    victim.write_text("precious")
    for plant in (Path.symlink_to, Path.hardlink_to):
        path.unlink()
        plant(path, victim)
        with pytest.raises(OSError, match=r"symbolic links|one name"):
            empty_file(path)
    assert victim.read_text() == "precious"
