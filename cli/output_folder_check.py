"""Name --out in errors of output folders."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path

_FILE_TIME_RESOLUTION_S = 0.05


@contextlib.contextmanager
def claimed_folder(
    out: Path, files: Iterable[str] = (), folders: Iterable[str] = ()
) -> Iterator[None]:
    """Claim the folder of --out while the `with` body runs; see api.output_folder.

    Raises:
        ConfigError: it cannot be written, or another command writes into it.
    """
    from ..api import output_folder

    with naming_out(), output_folder.claimed_folder(out, files, folders):
        yield


def writable_folder(out: Path, files: Iterable[str] = (), folders: Iterable[str] = ()) -> None:
    """Check that the folder of --out, and these files and folders in it, can be written.

    Raises:
        ConfigError: one of them cannot.
    """
    from ..api import output_folder

    with naming_out():
        output_folder.writable_folder(out, files, folders)


@contextlib.contextmanager
def naming_out() -> Iterator[None]:
    """Name --out in errors of the output folder."""
    from ..api.output_folder import OutputFolderError
    from ..config.base import ConfigError

    try:
        yield
    except OutputFolderError as error:
        raise ConfigError(f"--out {error}") from None


@contextlib.contextmanager
def naming_options() -> Iterator[None]:
    """Name the option in errors of an argument."""
    from ..api.model import ArgumentError
    from ..identification.records.record import IdentificationError

    try:
        yield
    except ArgumentError as error:
        raise IdentificationError(error.of_option) from None


def older_results(out: Path, names: Iterable[str], began_s: float) -> list[Path]:
    """Return the files in `out` that were last written before `began_s`, in s as time.time()."""
    # The kernel's clock for file times may be one tick behind time.time().
    paths = [out / name for name in names]
    return [
        p for p in paths if p.exists() and p.stat().st_mtime < began_s - _FILE_TIME_RESOLUTION_S
    ]
