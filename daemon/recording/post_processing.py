"""Run identification or trace on the logs of a session after landing, in a separate process."""

from __future__ import annotations

import contextlib
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

_STDERR = 2
_CLEANUP_S = 10.0
"""Time in s that an interrupted command has to remove what it has not finished."""


class HandoverError(Exception):
    """Report that identification failed; the logs are unchanged."""


def hand_over(verb: str, records: Sequence[Path], out: Path) -> None:
    """Run `levid VERB` on `records` at low priority with its report in `out`, and wait for it.

    VERB is an entry of `then` in a session. Its output goes to stderr of this process. Raises
    HandoverError if it fails.
    """
    nice = shutil.which("nice")
    child = subprocess.Popen(
        [
            *([nice, "-n", "10"] if nice else []),
            # -P: do not import modules from the working directory.
            *(sys.executable, "-P", "-m", "levid.cli.entry", verb),
            *map(str, records),
            *("--out", str(out)),
        ],
        stdin=subprocess.DEVNULL,
        stdout=_STDERR,
    )
    try:
        code = child.wait()
    except BaseException:  # Ctrl-C: the child gets it too, and removes what it has not finished
        child.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(_CLEANUP_S)
        child.kill()
        raise
    if code != 0:
        raise HandoverError(
            f"levid {verb} of {len(records)} records failed (exit code {code}); "
            f"the logs are in {records[0].parent}"
        )
