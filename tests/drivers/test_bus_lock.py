"""Test who can hold the lock of a bus, and whom the refusal names."""

from __future__ import annotations

import os
import pwd
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from levid.drivers import bus_lock
from levid.drivers.base import LinkError
from levid.drivers.bus_lock import BusLock

HOLD = """
import os, sys
from pathlib import Path
from levid.drivers import bus_lock
for group in sys.argv[2:]:  # here, not before: another user may not start this Python
    os.setgroups([int(group)])
    os.setresgid(65534, 65534, 65534)
    os.setresuid(65534, 65534, 65534)
bus_lock.SERVICE_STATE = Path(sys.argv[1])
bus_lock.temporary_folder = lambda: Path(sys.argv[1]).with_name("own")
print(bus_lock.BusLock("can0").acquire(), flush=True)
sys.stdin.read()
"""
ROOT_ONLY = pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
NOBODY = 65534


@pytest.fixture
def state(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return the service's state folder, as systemd makes it: for owner and group."""
    # Folders of pytest are closed to other users.
    with tempfile.TemporaryDirectory(prefix="levid-test-") as parent:
        Path(parent).chmod(0o1777)
        folder = Path(parent) / "state"
        folder.mkdir()
        folder.chmod(0o2770)
        monkeypatch.setattr(bus_lock, "SERVICE_STATE", folder)
        yield folder


@contextmanager
def process(state: Path, group: int | None = None) -> Iterator[tuple[int, bool]]:
    """Try to hold a lock in another process; yields its id and whether it does.

    With `group` it is a process of the user nobody that is in this group.
    """
    child = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(state), *([] if group is None else [str(group)])],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert child.stdout is not None
    assert child.stdin is not None
    try:
        yield child.pid, child.stdout.readline() == "True\n"
    finally:
        child.stdin.close()
        child.wait()
        child.stdout.close()


def test_refusal_names_the_process_and_its_user(state: Path) -> None:
    lock = BusLock("can0")
    with process(state) as (pid, held):
        assert held
        user = pwd.getpwuid(os.geteuid()).pw_name
        with pytest.raises(LinkError, match=rf"process {pid} \(python.*\) of user {user};"):
            lock.require("can main")
    lock.require("can main")  # it ended
    lock.release()


@ROOT_ONLY
def test_users_of_the_group_exclude_each_other(state: Path) -> None:
    os.chown(state, 0, 4242)
    state.chmod(0o2770)
    with process(state, 4242) as (pid, held):
        assert held
        with pytest.raises(LinkError, match=rf"process {pid} .*of user nobody"):
            BusLock("can0").require("can main")
    lock = BusLock("can0")
    lock.require("can main")
    with process(state, 4242) as (_, held):
        assert not held
    lock.release()


@ROOT_ONLY
def test_user_without_rights_cannot_take_the_lock(state: Path) -> None:
    os.chown(state, 0, 4242)
    state.chmod(0o2770)
    with process(state, 65534):
        lock = BusLock("can0")
        lock.require("can main")  # whatever that process holds
        lock.release()


@ROOT_ONLY
def test_folder_that_another_user_made_before_is_reported(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without service and account, that folder is in /tmp."""
    state.rmdir()
    taken = tmp_path / "levid-0"
    taken.mkdir()
    os.chown(taken, NOBODY, -1)
    monkeypatch.setattr(bus_lock, "account_home", lambda: None)
    monkeypatch.setattr(bus_lock, "RUN", Path("/dev/null"))
    monkeypatch.setattr(bus_lock, "temporary_folder", lambda: taken)
    with pytest.raises(LinkError, match=r"cannot be locked: .*remove it.*levid-0"):
        BusLock("can0").require("can main")


def test_lock_file_that_is_a_link_is_refused(state: Path, tmp_path: Path) -> None:
    lock = BusLock("can0")
    assert lock.acquire()
    lock.release()
    (file,) = (state / "locks").iterdir()
    file.unlink()
    (tmp_path / "other").touch()
    file.symlink_to(tmp_path / "other")
    with pytest.raises(LinkError, match="cannot be locked"):
        lock.require("can main")
