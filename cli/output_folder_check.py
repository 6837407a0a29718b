"""Name --out in errors of output folders, and quote paths for printed shell commands."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from ..config.escaping import shell_word

_MOST_NAMED = 3  # logs that a printed command names one by one
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


def logs_in(folder: Path) -> str:
    """Return the shell pattern of all logs in a folder."""
    return f"{shell_word(folder)}/*.mcap"


def quoted(*paths: Path) -> str:
    """Return paths quoted for a shell."""
    return " ".join(map(shell_word, paths))


def repeated(verb: str, logs: Sequence[Path], out: Path, **options: object) -> str:
    """Return the command that repeats a result; options that are None were not given."""
    given = [
        f"--{name.replace('_', '-')} {shell_word(value if isinstance(value, Path) else str(value))}"
        for name, value in options.items()
        if value is not None
    ]
    return " ".join([f"levid {verb} {same_logs(logs)}", *given, f"--out {quoted(out)}"])


def same_logs(logs: Sequence[Path]) -> str:
    """Return logs quoted for a shell; all logs of a folder become one pattern."""
    if len(logs) <= _MOST_NAMED:
        return quoted(*logs)
    words = []
    for folder in dict.fromkeys(log.parent for log in logs):
        own = [log for log in logs if log.parent == folder]
        words.append(logs_in(folder) if set(own) == set(folder.glob("*.mcap")) else quoted(*own))
    return " ".join(words)
