"""The wheel holds every room whole, code and data, and nothing of the workshop around them."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile

import pytest
from repository import ROOT

ROOMS = sorted(path.parent.name for path in ROOT.glob("[a-z]*/__init__.py"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Return the names in a wheel built from a copy, so that the checkout stays as it is."""
    pytest.importorskip("setuptools", minversion="77", reason="`make test` installs it")
    copy = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE", "__init__.py"):
        shutil.copy(ROOT / name, copy)
    for name in [*ROOMS, "tests", "benchmarks"]:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    build = "from setuptools.build_meta import build_wheel; build_wheel('dist')"
    done = subprocess.run(
        [sys.executable, "-c", build], cwd=copy, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    (path,) = (copy / "dist").glob("levid-*.whl")
    with zipfile.ZipFile(path) as archive:
        return set(archive.namelist())


def test_the_wheel_holds_every_file_of_every_room(wheel: set[str]) -> None:
    """A subpackage or a kind of data file that pyproject.toml does not list would be missing."""
    files = {
        f"levid/{path.relative_to(ROOT).as_posix()}"
        for room in ROOMS
        for path in (ROOT / room).rglob("[!.]*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert files - wheel == set()


def test_the_wheel_holds_nothing_but_the_rooms(wheel: set[str]) -> None:
    """Tests, benchmarks and documentation stay in the repository."""
    tops = {name.split("/")[1] for name in wheel if name.startswith("levid/")}
    assert tops == {"__init__.py", *ROOMS}
    assert {name.split("/")[0].rpartition(".")[2] for name in wheel} == {"levid", "dist-info"}
