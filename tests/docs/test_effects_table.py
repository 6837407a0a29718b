"""Test docs/effects-table.md: it is up to date with the table of candidate effects."""

from __future__ import annotations

import importlib.util

from repository_folders import DOCS


def test_page_is_up_to_date():
    spec = importlib.util.spec_from_file_location(
        "make_effects_table", DOCS / "make_effects_table.py"
    )
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    assert (DOCS / "effects-table.md").read_text(encoding="utf-8") == made.page()
