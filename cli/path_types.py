"""Types of file arguments: each completes, in a shell, to the files of its own kind."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..config.escaping import one_line
from ..log.importing.data_suffixes import FORMAT_OF_SUFFIX

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

_MOST_FILES = 2000
"""Most entries of a folder that are offered; a listing takes a few ms at most."""
_HEAD_BYTES = 2048
"""First bytes of a YAML file, in which its key `levid` is searched."""
_YAML = (".yaml", ".yml")


_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029]")


class FilePath(click.Path):
    """A path whose completion offers folders and the files of one kind.

    Args:
        suffixes: endings of the files; empty for all files.
        kind: value of the key `levid` in a YAML file, such as rig; empty for all kinds.
        files: whether files are offered at all, not folders only.
    """

    def __init__(self, *suffixes: str, kind: str = "", files: bool = True) -> None:
        super().__init__(path_type=Path)
        self.suffixes, self.kind, self.files = suffixes, kind, files
        self.name = "file" if files else "folder"  # as the help shows it

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; reject one whose messages a terminal would show as something else."""
        if _UNPRINTABLE.search(str(value)):
            self.fail(
                "expected a file name without line breaks and control characters, found "
                f"{one_line(str(value))}: rename the file, for example with mv -i",
                param,
                ctx,
            )
        return super().convert(value, param, ctx)

    def shell_complete(
        self,
        ctx: click.Context,  # noqa: ARG002
        param: click.Parameter,  # noqa: ARG002
        incomplete: str,
    ) -> list[CompletionItem[Any]]:
        """Return the matching files, and the folders with a final slash."""
        from click.shell_completion import CompletionItem

        return [CompletionItem(text, type="path") for text in sorted(self._matches(incomplete))]

    def _matches(self, incomplete: str) -> Iterator[str]:
        folder, start = os.path.split(incomplete)
        written = incomplete[: len(incomplete) - len(start)]
        try:
            entries = os.scandir(Path(folder).expanduser())
        except (OSError, RuntimeError):  # no such folder, no such user
            return
        with entries:
            for number, entry in enumerate(entries):
                hidden = entry.name.startswith(".") and not start.startswith(".")
                if number >= _MOST_FILES or hidden or not entry.name.startswith(start):
                    continue
                try:
                    if entry.is_dir():
                        yield f"{written}{entry.name}/"
                    elif self._accepts(entry):
                        yield f"{written}{entry.name}"
                except OSError:
                    continue

    def _accepts(self, entry: os.DirEntry[str]) -> bool:
        name = entry.name.lower()
        if not self.files or (self.suffixes and not name.endswith(self.suffixes)):
            return False
        if not self.kind or not name.endswith(_YAML) or not entry.is_file():
            return True
        with Path(entry.path).open("rb") as file:
            head = file.read(_HEAD_BYTES)
        words = [line.split() for line in head.splitlines() if line.startswith(b"levid:")]
        return not words or words[0][1:2] == [self.kind.encode()]


RIG = FilePath(*_YAML, kind="rig")
SESSION = FilePath(*_YAML, kind="session")
SIM = FilePath(*_YAML, kind="sim")
MODEL = FilePath(*_YAML, kind="model")
SIGNALS = FilePath(*_YAML, kind="signals")
YAML = FilePath(*_YAML)
LOG = FilePath(".mcap")
YAML_OR_LOG = FilePath(*_YAML, ".mcap")
DATA = FilePath(*FORMAT_OF_SUFFIX)
ANY = FilePath()
FOLDER = FilePath(files=False)
