"""Test docs/configuration.md, a rig of your own: its files, edits and commands, as printed."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from printed_lines import commands, expanded
from repository_folders import DOCS


def _merged(text: str, edit: str) -> str:
    """Return a YAML file with some keys replaced, as the page asks the reader to edit it."""
    whole, changed = yaml.safe_load(text), yaml.safe_load(edit)
    for key, value in changed.items():
        both = isinstance(value, dict) and isinstance(whole.get(key), dict)
        whole[key] = {**whole[key], **value} if both else value
    return yaml.safe_dump(whole, sort_keys=False)


@pytest.mark.usefixtures("unwritten_figures")
def test_a_rig_of_your_own_as_the_page_prints_it(
    levid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page's files, edits and commands in their order, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    page = (DOCS / "configuration.md").read_text()
    start = page.index("```yaml\nlevid: rig")
    part = page[start : page.index("<!-- table: rig -->")]
    name, lines, kind = "", [], ""
    ran = []
    for line in part.splitlines():
        if line.startswith("```") and not kind:
            kind, _, name = line.removeprefix("```yaml").strip().partition("=")
            kind, name, lines = kind or "file", name or "triangle.yaml", []
        elif line == "```":
            path, text = Path(name), "\n".join(lines) + "\n"
            path.write_text(_merged(path.read_text(), text) if kind == "edit" else text)
            kind = ""
        elif kind:
            lines.append(line.replace("duration_s: 20", "duration_s: 5"))
        elif found := commands(line) if line.startswith("    ") else []:
            outcome = levid(*expanded(found[0], tmp_path))
            assert outcome.code == 0, f"{found[0]}\n{outcome.err}"
            ran.append((found[0], outcome))
    assert len(ran) == 7
    assert " k_z = " in ran[-1][1].out  # 2600 N/m, which the fit starts from too
    outcome = levid("trace", *sorted(Path("out/triangle").glob("*.mcap")), "--out", "out/trace")
    assert outcome.code == 1
    assert "levid new model rig -o MODEL.yaml" in outcome.err
