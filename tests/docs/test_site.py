"""Test that the documentation site builds without a warning: every link leads somewhere."""

from __future__ import annotations

import subprocess
import sys

from repository_folders import ROOT


def test_site_builds_without_warnings(tmp_path) -> None:
    link = ROOT / "build" / "typecheck" / "levid"
    link.parent.mkdir(parents=True, exist_ok=True)
    if not link.exists():
        link.symlink_to("../..")
    options = ("--fail-on-warning", "--keep-going", "--quiet")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *options, "-d", tmp_path / "trees", "docs", tmp_path],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "index.html").read_text()
    for heading in ("Start here", "Tutorials", "How to", "Reference", "Numerics"):
        assert heading in page
