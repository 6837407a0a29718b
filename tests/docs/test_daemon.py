"""docs/daemon.md and README.md say what the daemon answers, and name every verb."""

from __future__ import annotations

import re

import pytest
from daemon_process import calm, daemon
from repository import ROOT

from levid.cli.main import levid
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.client import Client

DOC = (ROOT / "docs" / "daemon.md").read_text()
(SNIPPET,) = re.findall(r"```python\n(.*?)```", DOC, re.DOTALL)
REQUESTS = {
    cells[0].strip("` "): set(re.findall(r"`(\w+)`", cells[2]))
    for cells in (row.split("|")[1:] for row in re.findall(r"^\| `[a-z]+` \| .*\|$", DOC, re.M))
    if len(cells) == 4 and cells[0].strip("` ") != "op"
}
SESSION = """
levid: session
name: short
steps:
  - levitate: {unload_s: 0.2, ramp_s: 0.4, settle_s: 0}
  - land: {ramp_s: 0.4, release_s: 0.2}
"""


@pytest.fixture
def socket_file(tmp_path, monkeypatch):
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # where the default socket lies
    rig_file = shipped("rigs/loopback.yaml")
    with daemon(calm(load_rig(rig_file), tmp_path), rig_file, tmp_path) as running:
        yield running.socket


def test_requests_are_answered_with_the_keys_of_the_page(socket_file, tmp_path, capsys):
    exec(compile(SNIPPET, "daemon.md", "exec"), {})
    assert capsys.readouterr().out == "NONE\n"
    out = str(tmp_path / "logs")
    quick = {"levitate": {"unload_s": 0.2, "ramp_s": 0.4, "settle_s": 0}}
    asked = [
        ("status", {}),
        ("excite", {"session": SESSION, "out": out}),
        ("levitate", quick),
        ("move", {"move": {"beam_m": 0.001, "settle_s": 0}}),
        ("land", {}),
        ("stop", {}),
        ("clear", {}),
    ]
    assert {op for op, _ in asked} | {"watch"} == set(REQUESTS)
    for op, more in asked:
        with Client(socket_file) as client:
            answer = client.request(op, **more)
        keys = REQUESTS[op]
        if keys == {"excite"}:  # the page says: as excite
            keys = REQUESTS["excite"]
        # The page also names NONE, a value.
        assert set(answer) - {"ok"} == keys - {"NONE"}, op


def test_watching_gives_the_keys_of_status(socket_file):
    class Enough(Exception):  # noqa: N818
        pass

    def look(line):
        assert set(line) == REQUESTS["status"]
        raise Enough

    with Client(socket_file) as client, pytest.raises(Enough):
        client.request("watch", look, every_s=0.1)


def test_readme_has_every_verb():
    text = (ROOT / "README.md").read_text()
    named = re.findall(r"^\| `levid ([a-z-]+)", text, re.MULTILINE)
    assert sorted(named) == sorted(levid.list_commands(None))


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))], ids=lambda p: p.name
)
def test_links_lead_to_files_that_exist(page):
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
        assert target.startswith("https://") or (page.parent / target).is_file(), target
