"""Types of file arguments: each completes, in a shell, to the files of its own kind."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..config.escaping import one_line
from ..config.shipped import KINDS, TEMPLATE, find_file, shipped_file, shipped_names
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
    """A path whose completion offers folders, the files of one kind and the shipped names.

    A shipped name such as loopback becomes the path of that file; a file that exists wins.

    Args:
        suffixes: endings of the files; empty for all files.
        kind: value of the key `levid` in a YAML file, such as rig; empty for all kinds.
        files: whether files are offered at all, not folders only.
        named: kinds of shipped files that a name may mean; default: `kind`.
        folders: whether a folder is a value too, and wins over a name.
    """

    def __init__(
        self,
        *suffixes: str,
        kind: str = "",
        files: bool = True,
        named: tuple[str, ...] = (),
        folders: bool = False,
    ) -> None:
        super().__init__(path_type=Path)
        self.suffixes, self.kind, self.files = suffixes, kind, files
        self.named, self.folders = (kind,) if kind else named, folders
        self.name = "file" if files else "folder"  # as the help shows it

    def convert(
        self,
        value: str | os.PathLike[str],
        param: click.Parameter | None,
        ctx: click.Context | None,
    ) -> Any:
        """Return the path, or that of the shipped file with this name.

        A path whose messages a terminal would show as something else is rejected.
        """
        if _UNPRINTABLE.search(str(value)):
            self.fail(
                "expected a file name without line breaks and control characters, found "
                f"{one_line(str(value))}: rename the file, for example with mv -i",
                param,
                ctx,
            )
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        return find_file(path, *self.named, folders=self.folders) if self.named else path

    def shell_complete(
        self,
        ctx: click.Context,  # noqa: ARG002
        param: click.Parameter,  # noqa: ARG002
        incomplete: str,
    ) -> list[CompletionItem[Any]]:
        """Return the matching files, the folders with a final slash, and the shipped names."""
        from click.shell_completion import CompletionItem

        files = sorted(self._matches(incomplete))
        names = {name: None for kind in self.named for name in shipped_names(kind)}
        return [CompletionItem(text, type="path") for text in files] + [
            CompletionItem(name)
            for name in names
            if name.startswith(incomplete) and name not in files
        ]

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


class ShippedName(click.ParamType):  # type: ignore[type-arg]
    """The name of a shipped file of one kind; completes to these names."""

    name = "name"

    def __init__(self, kind: str) -> None:
        self.kind = kind

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the name; fails for another one and lists similar and known names."""
        if shipped_file(str(value), self.kind) is None:
            known = shipped_names(self.kind)
            near = difflib.get_close_matches(str(value), known)
            meant = f" Did you mean {' or '.join(near)}?" if near else ""
            start = near[0] if near else TEMPLATE[self.kind]
            self.fail(
                f"levid ships the {self.kind}s {', '.join(known)}, found '{value}'.{meant} The new "
                f"file's name follows -o: levid new {self.kind} {start} -o FILE.yaml",
                param,
                ctx,
            )
        return str(value)

    def shell_complete(
        self,
        ctx: click.Context,  # noqa: ARG002
        param: click.Parameter,  # noqa: ARG002
        incomplete: str,
    ) -> list[CompletionItem[Any]]:
        """Return the matching names."""
        from click.shell_completion import CompletionItem

        names = shipped_names(self.kind)
        return [CompletionItem(name) for name in names if name.startswith(incomplete)]


RIG = FilePath(*_YAML, kind="rig")
SESSION = FilePath(*_YAML, kind="session")
SIM = FilePath(*_YAML, kind="sim")
MODEL = FilePath(*_YAML, kind="model")
RESULT = FilePath(*_YAML, kind="model", folders=True)
"""A result of identify or trace: its folder, or its MODEL.yaml."""
SIGNALS = FilePath(*_YAML, kind="signals")
YAML = FilePath(*_YAML)
LOG = FilePath(".mcap")
YAML_OR_LOG = FilePath(*_YAML, ".mcap", named=KINDS)
DATA = FilePath(*FORMAT_OF_SUFFIX)
ANY = FilePath()
FOLDER = FilePath(files=False)
