"""The terminal begins with the answer of the page, for identify and trace."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from mass_on_spring_logs import MASS, imported, moved

Command = Callable[..., tuple[int, str, str]]


@pytest.mark.parametrize("verb", ["identify", "trace"])
@pytest.mark.usefixtures("unwritten_figures")
def test_terminal_begins_with_the_answer_of_the_page(
    verb: str, tmp_path: Path, levid: Command
) -> None:
    log, model = imported(tmp_path, "mass", moved(2000)), tmp_path / "model.yaml"
    model.write_text(MASS.model_dump_json())
    code, out, _ = levid(verb, log, "--model", model, "--out", tmp_path / "out")
    assert code == 0
    first = out.splitlines()[0]
    assert len(first) > 40  # a sentence
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    body = page[page.index("<body") :]
    text = " ".join(html.unescape(re.sub("<[^>]*>", " ", body)).split())
    where = text.find(first)
    assert 0 <= where < 1000, first  # behind the title, before the evidence
