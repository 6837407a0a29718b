"""Test commands of users without access to the service's folders and socket."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from levid.cli.excite import refuse_used_folder
from levid.cli.run import EXIT_CONFIG
from levid.config.shipped import shipped
from levid.daemon.client import Client, DaemonError, NoDaemonError

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="only root can change its user")
_NOBODY = 65_534


@contextmanager
def other_user() -> Iterator[None]:
    os.seteuid(_NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.fixture
def closed_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "state"
    folder.mkdir(mode=0o770)
    return folder


def test_folder_that_only_the_daemon_can_read_is_not_checked(closed_folder: Path) -> None:
    with other_user():
        refuse_used_folder(closed_folder / "today")


def test_error_without_access_does_not_suggest_to_start_a_daemon(closed_folder: Path) -> None:
    path = closed_folder / "levid.sock"
    with socket.socket(socket.AF_UNIX) as daemon:
        daemon.bind(str(path))
        daemon.listen()
        with other_user(), pytest.raises(DaemonError, match="has no access") as raised:
            Client(path).__enter__()
    assert not isinstance(raised.value, NoDaemonError)


def test_wrong_rig_ends_with_exit_code_78(levid: Callable[..., Any], tmp_path: Path) -> None:
    wrong = tmp_path / "rig.yaml"
    wrong.write_text(shipped("rigs/loopback.yaml").read_text().replace("rate_hz:", "rate:"))
    outcome = levid("run", wrong)
    assert outcome.code == EXIT_CONFIG
    assert f"{wrong}" in outcome.err
    assert f"RestartPreventExitStatus={EXIT_CONFIG}" in shipped("levid.service").read_text()
