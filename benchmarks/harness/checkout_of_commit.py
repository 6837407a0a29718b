"""Run the code of a commit beside the code of this checkout, each in processes of its own."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Version:
    """Code of one version: a folder that holds it as `levid`, and its cache of compiled code."""

    name: str
    folder: Path

    @property
    def environment(self) -> dict[str, str]:
        """Environment of a process that runs this code.

        The cache is new in each run: numba does not notice that a function changed which another
        module's compiled function calls.
        """
        own = {
            "PYTHONPATH": str(self.folder),
            "NUMBA_CACHE_DIR": str(self.folder / "numba"),
            "XDG_STATE_HOME": str(self.folder / "state"),
            "MPLBACKEND": "agg",
        }
        # Where Python is forbidden to keep bytecode, every worker would compile all packages anew.
        inherited = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
        return inherited | own

    def levid(self, *arguments: str) -> str:
        """Return what a command of this version prints; exits with its message if it fails."""
        print(f"{self.name}: levid {arguments[0]} ...", file=sys.stderr, flush=True)
        done = subprocess.run(
            [sys.executable, "-m", "levid.cli.main", *arguments],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            sys.exit(
                f"{self.name}: levid {arguments[0]} ended with {done.returncode}: {done.stderr}"
            )
        return done.stdout


@contextmanager
def both_versions(commit: str) -> Iterator[tuple[Version, Version]]:
    """Yield the code of `commit` and that of this checkout; exit with a message if there is none.

    Both folders are deleted at the end. What a benchmark writes beside them goes with them.
    """
    with tempfile.TemporaryDirectory(prefix="levid-versions-") as temporary:
        folder = Path(temporary)
        before, after = Version(commit, folder / "before"), Version("checkout", folder / "after")
        for version in (before, after):
            version.folder.mkdir()
        checkout = _checkout()
        _extract(checkout, commit, before.folder / "levid")
        (after.folder / "levid").symlink_to(checkout)
        for version in (before, after):
            _check_import(version)
        yield before, after


def _checkout() -> Path:
    """Return the folder of this checkout, wherever in it this file is."""
    found = _git(Path(__file__).parent, "rev-parse", "--show-toplevel")
    return Path(os.fsdecode(found).rstrip("\n"))


def _extract(checkout: Path, commit: str, folder: Path) -> None:
    """Write the files of a commit into a new folder."""
    content = _git(checkout, "archive", "--format=tar", commit)
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        archive.extractall(folder, filter="data")


def _git(folder: Path, *arguments: str) -> bytes:
    try:
        done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, check=True)
    except FileNotFoundError:
        sys.exit("expected git, which has the code of COMMIT, found no such program: install git")
    except subprocess.CalledProcessError as error:
        said = error.stderr.decode(errors="replace").strip()
        sys.exit(f"git {' '.join(arguments)} in {folder}: {said}")
    return done.stdout


def _check_import(version: Version) -> None:
    """Exit unless a process of this version imports its own code, not another that is installed."""
    code = "import levid.cli.main as m; print(m.__file__)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=version.folder,
        env=version.environment,
        capture_output=True,
        text=True,
        check=False,
    )
    found = done.stdout.strip() or done.stderr.strip()
    if not found.startswith(f"{version.folder}{os.sep}"):
        sys.exit(f"{version.name}: expected code from {version.folder}, found {found}")
