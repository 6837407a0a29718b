"""Define the `levid` command: load a subcommand when it is called and print user errors."""

from __future__ import annotations

import io
import os
import re
import sys

import click

from ..config.escaping import visible_output
from ..config.runtime.environment import prepare_command
from ..config.version import __version__
from . import interrupts
from .command_group import LazyGroup

# verb: module and attribute, summary for `levid --help` (shown without loading the module)
_VERBS = {
    "check": ("check:command", "Check configuration and log files; no device is accessed."),
    "commission": (
        "commission:command",
        "Find order, sign and scale of a rig's channels with small forces.",
    ),
    "run": ("run:command", "Run the daemon on a rig in real time."),
    "electronics": (
        "electronics:command",
        "Emulate a rig's electronics on its buses, with the simulated plant.",
    ),
    "excite": ("excite:command", "Fly an excitation session and log it."),
    "status": ("daemon_requests:status", "Print the daemon's state, pose, coils and gaps."),
    "watch": ("watch.command:watch", "Show live what the daemon does; keys stop and land."),
    "levitate": ("daemon_requests:levitate", "Lift off and levitate until `levid land`."),
    "move": ("daemon_requests:move", "Move beam and rotor while levitating."),
    "land": ("daemon_requests:land", "End the running session and land."),
    "stop": ("daemon_requests:stop", "Set all coil forces to zero immediately."),
    "clear": ("daemon_requests:clear", "Clear a fault after its cause is removed."),
    "install-service": (
        "install_service:command",
        "Install the daemon as a systemd service: unit, user, network, devices.",
    ),
    "identify": ("identify:command", "Identify the plant from logs."),
    "trace": ("trace:command", "Find the physical effects that the model lacks, from logs."),
    "compare": ("compare:command", "Compare two results of `levid identify` or `levid trace`."),
    "list": ("list_runs:command", "List the flights below a folder, and their results."),
    "info": ("info:command", "Describe logs and results: rig, date, length, faults."),
    "plot": ("plot:command", "Draw signals of logs over time, or their spectra."),
    "export": ("export:command", "Write logs as CSV, Parquet, MAT or NPZ tables."),
    "layout": ("layout:command", "Write layouts of Foxglove and PlotJuggler for a rig."),
    "new": ("new_files:group", "Write a draft of a YAML file, such as SIGNALS.yaml."),
    "import": ("import_data:command", "Convert measured data (CSV, text, NPZ, MAT) to a log."),
    "salvage": ("salvage:command", "Recover the rows of damaged logs."),
    "demo": ("demo:command", "Fly, log, identify and trace the simulated rig; write reports."),
    "completion": ("completion:command", "Print the script for the Tab key in bash, zsh or fish."),
}

_SECTIONS = {
    "Start": (
        "demo",
        "new",
        "check",
    ),
    "Run the rig": (
        "run",
        "electronics",
        "commission",
        "install-service",
    ),
    "Fly": (
        "excite",
        "levitate",
        "move",
        "land",
        "stop",
        "clear",
        "status",
        "watch",
    ),
    "Identify": (
        "identify",
        "trace",
        "compare",
    ),
    "Logs and data": (
        "list",
        "info",
        "plot",
        "export",
        "import",
        "salvage",
        "layout",
    ),
    "Shell": ("completion",),
}
"""Sections of `levid --help`. A command of no section is listed under "Other commands"."""

_PLAIN = (
    (r"is not a valid float(?: range)?\b", "is not a number"),
    (r"is not a valid integer(?: range)?\b", "is not a whole number"),
    (r"is not in the range x>=(\S+?)\.?$", r"is not at least \1."),
    (r"is not in the range x>(\S+?)\.?$", r"is not greater than \1."),
    (r"is not in the range x<=(\S+?)\.?$", r"is not at most \1."),
    (r"is not in the range (\S+?)<=x<=(\S+?)\.?$", r"is not between \1 and \2."),
    (r"does not match the formats? .*$", "is not a date such as 2026-11-26 or 2026-11-26T14:30."),
)
"""Messages of click about numbers and dates, and words for them."""
EXIT_FAILED = 1
_COMPLETE = "_LEVID_COMPLETE"
"""Environment variable with which the shell's completion script calls levid."""


class _Verbs(LazyGroup):
    verbs, sections = _VERBS, _SECTIONS


@click.group(cls=_Verbs, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="levid")
def levid() -> None:
    """Fly, excite, log and identify a magnetically levitated platform.

    `levid VERB --help` describes one command.

    \b
    Examples:
      levid demo
      levid check loopback
      levid excite white-noise-1khz --virtual --out out/first
      levid identify out/first/*.mcap --out out/first/identification
      levid trace out/trace/*.mcap --out out/trace/found
    """


def main() -> None:
    """Run the command line; print a user's error without traceback and exit with code 1."""
    sys.stdout, sys.stderr = visible_output(sys.stdout), visible_output(sys.stderr)
    if _COMPLETE in os.environ:
        from .completion import register

        register()
    interrupts.raise_once()
    try:
        code = levid(prog_name="levid", complete_var=_COMPLETE, standalone_mode=False)
    except BaseException as error:  # noqa: BLE001 - see below; others are raised again
        interrupts.finishing()
        # Ctrl-C may arrive as any exception: libraries replace KeyboardInterrupt by their own.
        if interrupts.interrupted() or isinstance(error, click.Abort | KeyboardInterrupt):
            click.echo("interrupted", err=True)
            sys.exit(interrupts.EXIT_INTERRUPTED)
        sys.exit(_report(error))
    interrupts.finishing()
    sys.exit(code if isinstance(code, int) else 0)


def _report(error: BaseException) -> int:
    """Print an error that is the user's, and return the exit code; raises any other again."""
    if isinstance(error, click.ClickException):
        text = io.StringIO()
        error.show(text)
        click.echo(plain(text.getvalue()), err=True, nl=False)
        return error.exit_code
    if isinstance(error, BrokenPipeError):
        sys.stderr.close()
        return EXIT_FAILED
    if not isinstance(error, Exception) or not _user_error(error):
        raise error
    click.echo(f"error: {_words(error)}", err=True)
    return EXIT_FAILED


def _words(error: Exception) -> str:
    """Return the message of a user's error; that of the operating system with file and remedy."""
    if not isinstance(error, OSError) or error.errno is None:
        return str(error)
    from ..log.errors import reason

    files = " and ".join(str(file) for file in (error.filename, error.filename2) if file)
    return f"{files}: {reason(error)}" if files else reason(error)


def plain(usage: str) -> str:
    """Return a message of the option parser without the types of its language."""
    for pattern, words in _PLAIN:
        usage = re.sub(pattern, words, usage, flags=re.M)
    return usage


def _user_error(error: Exception) -> bool:
    """Return whether the error's message is written for the user; others need a traceback."""
    return isinstance(error, OSError) or any(
        kind.__module__.startswith("levid.") for kind in type(error).__mro__
    )


if __name__ == "__main__":
    interrupts.leave_at_once()
    prepare_command()
    main()
