"""Test the commands in README, docs and help: they parse, and name files that exist or are made."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from itertools import pairwise

import click
import pytest
from printed_lines import code_blocks, commands
from repository_folders import DOCS, ROOT

from levid.cli.main import levid as program
from levid.config.shipped import KINDS, shipped_names

PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("examples/*/*.md"))]
_SHIPPED = {name for kind in KINDS for name in shipped_names(kind)}
_CLONE = re.compile(r"config/(rigs|sessions|sims|models|signals)/")
"""Folders of shipped files in a clone; an installed levid has none in the current folder."""


def _groups(group: click.Group, name: str = "levid") -> Iterator[tuple[str, click.Command]]:
    context = click.Context(group)
    for verb in group.list_commands(context):
        command = group.get_command(context, verb)
        assert command is not None
        yield f"{name} {verb}", command
        if isinstance(command, click.Group):
            yield from _groups(command, f"{name} {verb}")


HELP = {name: commands(command.help or "") for name, command in _groups(program)}
PRINTED = {
    **{page.relative_to(ROOT).as_posix(): commands("\n".join(code_blocks(page.read_text())))
       for page in PAGES},
    **HELP,
    "levid": commands(program.help or ""),
}  # fmt: skip


def parse(line: str) -> None:
    """Parse a command line as levid does, without running it."""
    words = [word.strip("[]") for word in shlex.split(line)[1:]]
    command: click.Command = program
    context = click.Context(program)
    while isinstance(command, click.Group):
        name, found, words = command.resolve_command(context, words)
        assert found is not None
        command, context = found, click.Context(found, info_name=name, parent=context)
    command.make_context(command.name, words)


@pytest.mark.parametrize("place", [place for place, lines in PRINTED.items() if lines])
def test_every_printed_command_is_one(place: str) -> None:
    for line in PRINTED[place]:
        assert not _CLONE.search(line), f"{line}: name the shipped file instead"
        try:
            parse(line)
        except click.ClickException as error:
            pytest.fail(f"{place}: {line}: {error.format_message()}")


@pytest.mark.parametrize("place", [place for place, lines in PRINTED.items() if lines])
def test_every_printed_name_without_an_ending_is_shipped(place: str) -> None:
    """`levid run lopback` would parse too."""
    for line in PRINTED[place]:
        words = shlex.split(line)
        named = words[2:3] if words[1] in ("run", "excite", "electronics", "layout") else []
        named += [b for a, b in pairwise(words) if a in ("--rig", "--sim")]
        for name in named:
            own = name.endswith(".yaml") or name.startswith("-")
            assert own or name in _SHIPPED, f"{place}: {line}: levid ships no {name}"
