"""Test the root package: names, lazy imports, types that mypy sees."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import levid

HEAVY = ("numpy", "scipy", "matplotlib", "pandas", "yaml", "pydantic")


def test_import_of_levid_imports_nothing_heavy() -> None:
    script = f"import sys, levid; dir(levid); print(*(m for m in {HEAVY} if m in sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert not done.stdout.strip()


@pytest.mark.parametrize("name", levid.__all__)
def test_every_public_name_exists_and_is_documented(name: str) -> None:
    assert getattr(levid, name).__doc__
    assert name in dir(levid)


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'lode'"):
        levid.lode  # noqa: B018


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
