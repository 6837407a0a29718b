"""Test which socket clients use, and which modules `levid stop` imports."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from levid.config.daemon_settings import Service
from levid.daemon.api import socket_paths
from levid.daemon.api.control_server import Server
from levid.daemon.client import Client, NoDaemonError
from levid.daemon.host.peer_credentials import Access


def test_a_stop_waits_for_no_library() -> None:
    """numpy and scipy take a second or two to load; the platform may be falling."""
    code = (
        "import sys, levid.cli.daemon_requests, levid.daemon.client, levid.daemon.api.socket_paths;"
        "print(*(m for m in ('numpy', 'scipy', 'pydantic', 'numba') if m in sys.modules))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == []


def test_what_a_killed_daemon_left_behind_hides_no_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = tmp_path / "service.sock"
    monkeypatch.setattr(socket_paths, "_SERVICE", service)
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    own = tmp_path / "levid.sock"
    assert socket_paths.socket_path(None) == own
    with socket.socket(socket.AF_UNIX) as flying, socket.socket(socket.AF_UNIX) as killed:
        flying.bind(str(service))
        flying.listen()
        assert socket_paths.socket_path(None) == service  # there is none of this user's
        killed.bind(str(own))
        killed.listen()
        assert socket_paths.socket_path(None) == own
        killed.close()
        assert own.exists()
        assert socket_paths.socket_path(None) == service


def test_stop_without_options_imports_next_to_nothing() -> None:
    """A check of CPU time would depend on the machine; the option parser alone doubles it."""
    code = (
        "import sys; sys.argv = ['levid', 'stop']\nfrom levid.cli.entry import main\n"
        "try: main()\nexcept SystemExit as end: print(end.code, *sys.modules)"
    )
    environment = {**os.environ, "XDG_RUNTIME_DIR": "/nonexistent"}
    environment.pop("RUNTIME_DIRECTORY", None)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    )
    number, *modules = done.stdout.split()
    assert number == "1"
    assert done.stderr.startswith("error: no daemon runs at")
    assert not {"click", "numpy", "yaml", "pydantic", "importlib.metadata"} & set(modules)


def test_a_folder_that_others_may_write_to_is_not_trusted() -> None:
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        path = Path(name) / "levid.sock"
        Path(name).chmod(0o777)
        with pytest.raises(NoDaemonError, match="only this user"), Client(path):
            pass
        Path(name).chmod(0o700)
        with pytest.raises(NoDaemonError, match="levid run"), Client(path):
            pass


def test_who_watches_seldom_is_patient_for_longer(tmp_path: Path) -> None:
    server = Server(
        tmp_path / "levid.sock", {"watch": lambda _, reply: reply.done()}, Access(Service())
    )
    server.start()
    try:
        with Client(tmp_path / "levid.sock") as client:
            for every_s in (0.05, 600.0):
                client.request("watch", every_s=every_s)
                patience_s = client._socket.gettimeout()
                assert patience_s is not None
                assert patience_s >= every_s + 30.0
    finally:
        server.close()
