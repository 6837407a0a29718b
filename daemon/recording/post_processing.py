"""Run identification or trace on the logs of a session after landing, in a separate process."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

_STDERR = 2


class HandoverError(Exception):
    """Report that identification failed; the logs are unchanged."""


def hand_over(verb: str, records: Sequence[Path], out: Path) -> None:
    """Run `levid VERB` on `records` at low priority with its report in `out`, and wait for it.

    VERB is an entry of `then` in a session. Its output goes to stderr of this process. Raises
    HandoverError if it fails.
    """
    nice = shutil.which("nice")
    done = subprocess.run(
        [
            *([nice, "-n", "10"] if nice else []),
            # -P: do not import modules from the working directory.
            *(sys.executable, "-P", "-m", "levid.cli.main", verb),
            *map(str, records),
            *("--out", str(out)),
        ],
        stdin=subprocess.DEVNULL,
        stdout=_STDERR,
        check=False,
    )
    if done.returncode != 0:
        raise HandoverError(
            f"levid {verb} of {len(records)} records failed (exit code {done.returncode}); "
            f"the logs are in {records[0].parent}"
        )
