"""Start the `levid` command; `levid stop` without options imports next to nothing.

The forces must be zero soon after somebody has pressed Enter. Most of the time of a command is the
import of its option parser.
"""

from __future__ import annotations

from .interrupts import leave_at_once

leave_at_once()  # before the imports, so that Ctrl-C during them prints no traceback

import sys  # noqa: E402


def main() -> None:
    """Run the command line."""
    if sys.argv[1:] == ["stop"]:
        sys.exit(stop_at_once())
    from ..config.runtime.environment import prepare_command

    prepare_command()
    from .main import main as all_commands

    all_commands()


def stop_at_once() -> int:
    """Stop the daemon at the default socket; print the outcome and return the exit code."""
    from ..config.escaping import visible
    from ..daemon.client import Client, DaemonError, socket_path

    try:
        with Client(socket_path(None)) as client:
            client.request("stop")
    except DaemonError as error:
        sys.stderr.write(f"error: {visible(str(error))}\n")
        return 1
    sys.stdout.write(f"{STOPPED}\n")
    return 0


STOPPED = "zero force commanded; run 'levid clear' to fly again"
"""What is printed after `levid stop`."""

if __name__ == "__main__":
    main()
