"""Test that mypy sees the types of the public names."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import levid


def test_public_names_have_types(tmp_path: Path) -> None:
    pytest.importorskip("mypy", reason="`make test` installs it")
    user = tmp_path / "user.py"
    user.write_text(
        "import levid\n"
        "s = levid.load('x')\n"
        "reveal_type(s)\n"
        "reveal_type(s.identify().parameters['m'].interval)\n"
        "reveal_type(s.trace().effects[0].kind)\n"
        "reveal_type(levid.__version__)\n"
    )
    # mypy names modules by folder: the clone may have any name.
    (tmp_path / "levid").symlink_to(Path(levid.__file__).parent)
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--follow-imports=silent", "user.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    shown = [line.partition('"')[2] for line in done.stdout.splitlines() if "Revealed" in line]
    assert shown == [
        'levid.api.session.Session"',
        'tuple[float, float] | None"',
        'str"',
        'str"',
    ], done.stdout
