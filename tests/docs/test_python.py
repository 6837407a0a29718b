"""Test docs/python.md and the notebooks as files: code runs, outputs are not committed."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest
from repository_folders import DOCS

import levid

TEXT = (DOCS / "python.md").read_text()
BOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


def test_examples_run_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("xarray", reason="levid[data] is not installed")
    pytest.importorskip("pyarrow", reason="levid[data] is not installed")
    monkeypatch.chdir(tmp_path)
    if "control" not in sys.modules:
        pytest.importorskip("pandas", reason="levid[data] is not installed")
    variables: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL):
        exec(compile(block, "python.md", "exec"), variables)
    assert isinstance(variables["found"], levid.Identification)


def test_every_public_name_is_on_the_page() -> None:
    for name in levid.__all__:
        assert f"`levid.{name}" in TEXT or f"`{name}" in TEXT, name


@pytest.mark.parametrize("path", BOOKS, ids=lambda path: path.stem)
def test_notebook_is_committed_without_outputs_and_linked(path: Path) -> None:
    book = json.loads(path.read_text())
    assert book["nbformat"] == 4
    assert path.stat().st_size < 20_000
    code = [cell for cell in book["cells"] if cell["cell_type"] == "code"]
    assert not any(cell["outputs"] or cell["execution_count"] for cell in code)
    assert f"notebooks/{path.name}" in TEXT
    texts = ["".join(c["source"]) for c in book["cells"] if c["cell_type"] == "markdown"]
    for link in re.findall(r"\]\((\.\./[^)#]*)", "\n".join(texts)):
        assert (path.parent / link).exists(), link
