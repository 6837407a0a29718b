"""What users without the right to a service's folders and socket are told."""

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

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")
_STRANGER = 65_534


@contextmanager
def stranger() -> Iterator[None]:
    os.seteuid(_STRANGER)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.fixture
def shut(tmp_path: Path) -> Path:
    folder = tmp_path / "state"
    folder.mkdir(mode=0o770)
    return folder


def test_folder_that_only_the_daemon_sees_is_left_to_it(shut: Path) -> None:
    with stranger():
        refuse_used_folder(shut / "today")


def test_stranger_is_not_told_to_start_a_daemon(shut: Path) -> None:
    path = shut / "levid.sock"
    with socket.socket(socket.AF_UNIX) as daemon:
        daemon.bind(str(path))
        daemon.listen()
        with stranger(), pytest.raises(DaemonError, match="may not ask it") as raised:
            Client(path).__enter__()
    assert not isinstance(raised.value, NoDaemonError)


def test_wrong_rig_has_an_exit_code_of_its_own(levid: Callable[..., Any], tmp_path: Path) -> None:
    wrong = tmp_path / "rig.yaml"
    wrong.write_text(shipped("rigs/loopback.yaml").read_text().replace("rate_hz:", "rate:"))
    outcome = levid("run", wrong)
    assert outcome.code == EXIT_CONFIG
    assert f"{wrong}" in outcome.err
    assert f"RestartPreventExitStatus={EXIT_CONFIG}" in shipped("levid.service").read_text()
