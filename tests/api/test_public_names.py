"""Test the root package: public names, and lazy imports."""

from __future__ import annotations

import subprocess
import sys

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
