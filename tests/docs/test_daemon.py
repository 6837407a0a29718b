"""Test docs/daemon.md and README.md: answers of the daemon, table of verbs, links."""

from __future__ import annotations

import re

import pytest
from daemon_process import calm, daemon
from repository_folders import ROOT

from levid.cli.main import levid
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.client import Client

DOC = (ROOT / "docs" / "daemon.md").read_text()
(SNIPPET,) = re.findall(r"```python\n(.*?)```", DOC, re.DOTALL)
_TABLE = DOC[DOC.index("| `op` | more keys | answer |") :].partition("\n\n")[0]
REQUESTS = {
    cells[0].strip("` "): set(re.findall(r"`(\w+)`", cells[2]))
    for cells in (row.split("|")[1:] for row in re.findall(r"^\| `[a-z]+` \| .*\|$", _TABLE, re.M))
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
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # folder of the default socket
    rig_file = shipped("rigs/loopback.yaml")
    with daemon(calm(load_rig(rig_file), tmp_path), rig_file, tmp_path) as running:
        yield running.socket


def test_answers_have_the_documented_keys(socket_file, tmp_path, capsys):
    exec(compile(SNIPPET, "daemon.md", "exec"), {})
    assert capsys.readouterr().out == "NONE\n"
    out = str(tmp_path / "logs")
    quick = {"levitate": {"unload_s": 0.2, "ramp_s": 0.4, "settle_s": 0}}
    requests = [
        ("status", {}),
        ("excite", {"session": SESSION, "out": out}),
        ("levitate", quick),
        ("move", {"move": {"beam_m": 0.001, "settle_s": 0}}),
        ("land", {}),
        ("stop", {}),
        ("clear", {}),
    ]
    assert {op for op, _ in requests} | {"watch"} == set(REQUESTS)
    for op, arguments in requests:
        with Client(socket_file) as client:
            answer = client.request(op, **arguments)
        keys = REQUESTS[op]
        if keys == {"excite"}:  # the page refers to excite
            keys = REQUESTS["excite"]
        # The page also mentions the value NONE.
        assert set(answer) - {"ok"} == keys - {"NONE"}, op


def test_watch_gives_the_keys_of_status(socket_file):
    class StopWatching(Exception):  # noqa: N818
        pass

    def look(line):
        assert set(line) == REQUESTS["status"]
        raise StopWatching

    with Client(socket_file) as client, pytest.raises(StopWatching):
        client.request("watch", look, every_s=0.1)


def test_readme_lists_every_verb():
    text = (ROOT / "README.md").read_text()
    named = re.findall(r"^\| `levid ([a-z-]+)", text, re.MULTILINE)
    assert sorted(set(named)) == sorted(levid.list_commands(None))


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))], ids=lambda p: p.name
)
def test_links_refer_to_existing_files(page):
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
        assert target.startswith("https://") or (page.parent / target).is_file(), target
