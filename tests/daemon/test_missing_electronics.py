"""A daemon whose electronics do not run says what to start, and how to go on after that."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from daemon_process import calm, daemon, refused

from levid.config.rig import RigConfig
from levid.config.shipped import shipped
from levid.daemon.client import Client, NoDaemonError


@pytest.mark.parametrize(
    ("bus", "cause"),
    [
        ("serial", "no port {0}/port: start `levid electronics RIG.yaml` in another terminal"),
        ("canlocal", "start `levid electronics RIG.yaml` in another terminal"),
        ("silent", "no answer: start `levid electronics RIG.yaml` in another terminal, or end"),
    ],
)
def test_fault_and_refusals_name_the_remedy(
    rig_in: Callable[..., RigConfig], tmp_path: Path, bus: str, cause: str
) -> None:
    terminals = os.openpty()  # at whose other end nothing answers
    if bus == "silent":
        (tmp_path / "port").symlink_to(os.ttyname(terminals[1]))
    sim = shipped("sims/nominal.yaml")
    rig = calm(rig_in(tmp_path, "serial" if bus == "silent" else bus, 250.0, sim), tmp_path)
    path = tmp_path / "rig.yaml"
    path.write_text(rig.model_dump_json())
    with daemon(rig, path, tmp_path) as running:
        status = running.until(lambda answer: answer["fault"] == "LINK")
        assert cause.format(tmp_path) in status["detail"]
        why = refused(running, "levitate")
        assert "run `levid clear`" in why
        assert cause.format(tmp_path) in refused(running, "clear")
    for terminal in terminals:
        os.close(terminal)


def test_no_daemon(tmp_path: Path) -> None:
    path = tmp_path / "levid.sock"
    with pytest.raises(NoDaemonError) as raised:
        Client(path).__enter__()
    assert str(raised.value) == f"no daemon runs at {path}: start one with `levid run RIG.yaml`"
