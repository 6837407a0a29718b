"""Command groups that suggest the command of a misspelt name, and load commands when called."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

_MOST_SUGGESTED = 3
_OTHER = "Other commands"


class SuggestingGroup(click.Group):
    """Name the similar commands if a command does not exist; exit code 2."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return name, command and arguments; raises UsageError."""
        known = self.list_commands(ctx)
        is_option = args[0].startswith("-")
        if args[0] in known or is_option or ctx.resilient_parsing:
            return super().resolve_command(ctx, args)
        raise click.UsageError(unknown_command(args[0], known, ctx.command_path), ctx)


class LazyGroup(SuggestingGroup):
    """Import the module of a command when the command is called, so that help is fast.

    Args:
        verbs: module and attribute (`module:attribute`, in this package) and summary of each
            command.
        sections: titles of the help's sections, and the commands of each.
    """

    verbs: Mapping[str, tuple[str, str]] = {}
    sections: Mapping[str, Iterable[str]] = {}

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Return the names of all commands."""
        return list(self.verbs)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """Import and return a command; None if it does not exist."""
        if cmd_name not in self.verbs:
            return None
        name, _, attribute = self.verbs[cmd_name][0].partition(":")
        module = importlib.import_module(f".{name}", __package__)
        command: click.Command = getattr(module, attribute)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Write the list of commands, one section after the other."""
        sections = {title: list(names) for title, names in self.sections.items()}
        listed = {name for names in sections.values() for name in names}
        sections[_OTHER] = [name for name in self.verbs if name not in listed]
        width = max(map(len, self.verbs))
        for title, names in sections.items():
            if names:
                with formatter.section(title):
                    # Equal widths align the summaries of all sections.
                    formatter.write_dl([(n.ljust(width), self.verbs[n][1]) for n in names])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem[str]]:
        """Return the commands and options that begin with `incomplete`; imports no command."""
        from click.shell_completion import CompletionItem

        commands = [
            CompletionItem(name, help=summary)
            for name, (_, summary) in self.verbs.items()
            if name.startswith(incomplete)
        ]
        return commands + click.Command.shell_complete(self, ctx, incomplete)


def unknown_command(name: str, known: Iterable[str], program: str) -> str:
    """Return the error text for a command that does not exist, with similar names."""
    known = list(known)
    # A name that was not typed to its end is as likely as one with a wrong letter.
    begun = [other for other in known if len(name) > 1 and other.startswith(name)]
    similar = begun or difflib.get_close_matches(name.lower(), known, _MOST_SUGGESTED, 0.6)
    if not similar:
        return f"unknown command '{name}'; `{program} --help` lists all commands"
    *first, last = (f"'{other}'" for other in similar[:_MOST_SUGGESTED])
    alternatives = f"{', '.join(first)} or {last}" if first else last
    return f"unknown command '{name}'; did you mean {alternatives}?"
