"""Test the wheel: it contains every file of every package, and nothing else."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest
from repository_folders import ROOT

SHIPPED = {
    folder.name: sorted(path.stem for path in folder.glob("*.yaml"))
    for folder in (ROOT / "config").iterdir()
    if any(folder.glob("*.yaml"))
}
PACKAGES = sorted(path.parent.name for path in ROOT.glob("[a-z]*/__init__.py"))


@pytest.fixture(scope="module")
def wheel_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a wheel; it is built from a copy, to keep the checkout clean."""
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
    return path


@pytest.fixture(scope="module")
def wheel(wheel_file: Path) -> set[str]:
    """Return the file names in the wheel."""
    with zipfile.ZipFile(wheel_file) as archive:
        return set(archive.namelist())


@pytest.fixture(scope="module")
def installed(wheel_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the `levid` of an environment with the wheel, and with the packages of this one."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False)
    site = next(folder.glob("lib/python*/site-packages"))
    # Paths in a .pth file are not searched for .pth files: a levid that is installed there to be
    # edited stays unseen.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    python = folder / "bin" / "python"
    command = [sys.executable, "-m", "pip", "--python", str(python), "install", "--no-deps"]
    done = subprocess.run(
        [*command, "--no-index", "--disable-pip-version-check", str(wheel_file)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder / "bin" / "levid"


SESSION = """
levid: session
name: short
steps:
  - levitate: {settle_s: 1.0}
  - record: {name: rest, duration_s: 2, settle_s: 0}
  - land: {}
"""


@pytest.mark.long  # it compiles the loop
def test_installed_levid_knows_shipped_files_by_name(installed: Path, tmp_path: Path) -> None:
    """As after `pip install levid`: outside the repository, without a file of one's own."""
    folder = tmp_path / "my work"
    folder.mkdir()
    (folder / "short.yaml").write_text(SESSION)
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [installed, *words],
            cwd=folder, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip

    names = [name for names in SHIPPED.values() for name in names]
    twice = [f"{f}/{name}" for f in SHIPPED for name in SHIPPED[f] if names.count(name) > 1]
    for words in (
        ("check", *(name for name in names if names.count(name) == 1)),
        ("check", *twice),
        ("new", "rig", "loopback", "-o", "my rig.yaml"),
        ("check", "my rig.yaml"),
        ("layout", "loopback", "--out", "layouts"),
        ("install-service", "can", "--dry-run"),
        # One flight: a fresh environment compiles the loop first.
        (
            *("excite", "short.yaml", "--virtual", "--out", "out"),
            *("--rig", "my rig.yaml", "--sim", "undeclared"),
        ),
    ):  # fmt: skip
        done = run(*words)
        assert done.returncode == 0, f"{words}: {done.stderr}"
        assert str(ROOT) not in done.stdout + done.stderr
    refused = run("excite", "config/sessions/beam.yaml", "--virtual", "--out", "c")
    assert "levid ships a session with the name beam" in refused.stderr


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
