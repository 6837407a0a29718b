"""Test the wheel: it contains every file of every package, and nothing else."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile

import pytest
from repository_folders import ROOT

PACKAGES = sorted(path.parent.name for path in ROOT.glob("[a-z]*/__init__.py"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Return the file names of a wheel; it is built from a copy, to keep the checkout clean."""
    pytest.importorskip("setuptools", minversion="77", reason="`make test` installs it")
    copy = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE", "__init__.py", "py.typed"):
        shutil.copy(ROOT / name, copy)
    for name in [*PACKAGES, "tests", "benchmarks"]:
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


def test_wheel_contains_every_file_of_every_package(wheel: set[str]) -> None:
    """Detects subpackages and kinds of data files that pyproject.toml does not list."""
    files = {
        f"levid/{path.relative_to(ROOT).as_posix()}"
        for package in PACKAGES
        for path in (ROOT / package).rglob("[!.]*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert files - wheel == set()


def test_wheel_contains_the_packages_only(wheel: set[str]) -> None:
    """Tests, benchmarks and documentation stay in the repository."""
    top_level = {name.split("/")[1] for name in wheel if name.startswith("levid/")}
    # py.typed makes mypy and editors read the types of the public names.
    assert top_level == {"__init__.py", "py.typed", *PACKAGES}
    assert {name.split("/")[0].rpartition(".")[2] for name in wheel} == {"levid", "dist-info"}
