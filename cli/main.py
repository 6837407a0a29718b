"""The `levid` command: its verbs, loaded when called, and one place for errors a user can cause."""

from __future__ import annotations

import importlib
import io
import sys

import click

from .. import __version__

# verb: module and attribute, what it does (shown without loading the module)
_VERBS = {
    "check": ("check:command", "Check configuration and log files without touching a device."),
    "run": ("run:command", "Run the daemon on a rig, in real time, until it is stopped."),
    "electronics": (
        "electronics:command",
        "Play a rig's electronics on its buses, with the simulated plant behind.",
    ),
    "excite": ("excite:command", "Fly an excitation session and log it."),
    "status": ("daemon_requests:status", "Say what the daemon is doing."),
    "watch": ("daemon_requests:watch", "Say what the daemon is doing, again and again."),
    "levitate": ("daemon_requests:levitate", "Lift off and hold until told to land."),
    "move": ("daemon_requests:move", "Move beam and rotor while levitating."),
    "land": ("daemon_requests:land", "End the daemon's session at hand: land at once."),
    "stop": ("daemon_requests:stop", "Zero force at once, whatever the daemon is doing."),
    "clear": ("daemon_requests:clear", "Clear the daemon's fault, once its cause is gone."),
    "install-service": (
        "install_service:command",
        "Make the daemon a service of systemd: unit, user, network, devices.",
    ),
    "identify": ("identify:command", "Identify the plant from logs."),
    "trace": ("trace:command", "Trace what a model lacks to physical effects, with proof."),
    "import": ("import_data:command", "Turn measured data of others into a log."),
    "demo": ("demo:command", "Fly, log, identify and trace the simulated rig, and show pictures."),
}

EXIT_FAILED = 1
EXIT_INTERRUPTED = 130


class _Verbs(click.Group):
    """Loads a verb's module only when that verb is called: `levid --help` stays quick."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        return list(_VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        if cmd_name not in _VERBS:
            return None
        name, _, attribute = _VERBS[cmd_name][0].partition(":")
        module = importlib.import_module(f".{name}", __package__)
        command: click.Command = getattr(module, attribute)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        with formatter.section("Commands"):
            formatter.write_dl([(verb, about) for verb, (_, about) in _VERBS.items()])


@click.group(cls=_Verbs, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="levid")
def levid() -> None:
    """Fly, excite, log and identify a magnetically levitated platform, and trace what it lacks.

    \b
    Examples:
      levid demo
      levid check config/rigs/loopback.yaml
      levid excite config/sessions/white-noise-1khz.yaml --virtual --out out/first
      levid identify out/first/*.mcap --out out/first/identification
      levid trace out/trace/*.mcap --out out/trace/found
    """


def main() -> None:
    """Run the command line; what a user can get wrong ends in one line and exit code 1."""
    for stream in (sys.stdout, sys.stderr):  # names of files need not be text in any encoding
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        code = levid(standalone_mode=False)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        click.echo("interrupted", err=True)
        sys.exit(EXIT_INTERRUPTED)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(EXIT_FAILED)
    except Exception as error:
        if not _user_error(error):
            raise
        click.echo(f"error: {error}", err=True)
        sys.exit(EXIT_FAILED)
    sys.exit(code if isinstance(code, int) else 0)


def _user_error(error: Exception) -> bool:
    """Tell errors with a message for the user from those that need a traceback."""
    return isinstance(error, OSError) or any(
        kind.__module__.startswith("levid.") for kind in type(error).__mro__
    )


if __name__ == "__main__":
    main()
