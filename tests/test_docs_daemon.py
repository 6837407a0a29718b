"""docs/daemon.md and README.md say what the daemon answers, and name every verb."""

from __future__ import annotations

import re
import threading
from pathlib import Path

import pytest

from levid.cli.main import levid
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.client import Client, socket_path
from levid.daemon.service import Service

ROOT = Path(__file__).parents[1]
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
def daemon(tmp_path, monkeypatch):
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    rig_file = shipped("rigs/loopback.yaml")
    rig = load_rig(rig_file).model_copy(update={"rate_hz": 250.0})  # any machine keeps up
    service = Service(rig, rig_file, socket_path(rig))
    thread = threading.Thread(target=service.run)
    thread.start()
    while not (tmp_path / "levid.sock").exists():
        assert thread.is_alive()
    yield tmp_path / "levid.sock"
    service.stop()
    thread.join()


def test_requests_are_answered_with_the_keys_of_the_page(daemon, tmp_path, capsys):
    exec(compile(SNIPPET, "daemon.md", "exec"), {})
    assert capsys.readouterr().out == "NONE\n"
    more = {"excite": {"session": SESSION, "out": str(tmp_path / "logs")}}
    assert set(REQUESTS) == {"status", "excite", "land", "clear"}
    for op, keys in REQUESTS.items():
        with Client(daemon) as client:
            answer = client.request(op, **more.get(op, {}))
        # The page also names NONE, a value.
        assert set(answer) - {"ok"} == keys - {"NONE"}, op


def test_readme_has_every_verb():
    text = (ROOT / "README.md").read_text()
    headings = " ".join(re.findall(r"^### (.*)$", text, re.MULTILINE))
    for verb in levid.list_commands(None):
        assert f"levid {verb}" in headings


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))], ids=lambda p: p.name
)
def test_links_lead_to_files_that_exist(page):
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
        assert target.startswith("https://") or (page.parent / target).is_file(), target
