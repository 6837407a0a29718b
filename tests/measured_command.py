"""Measure memory and processor time of a `levid` command."""

from __future__ import annotations

import json
import subprocess
import sys

# A process's peak memory includes that of its parent at the fork, so the parent is a small one.
MEASURED = """
import json, os, subprocess, sys
process = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
text = process.stderr.read().decode()
_, status, used = os.wait4(process.pid, 0)
print(json.dumps([os.waitstatus_to_exitcode(status), text, 1024 * used.ru_maxrss,
                  used.ru_utime + used.ru_stime]))
"""


def levid(*arguments):
    """Return exit code, error text, peak memory in bytes and processor time in s of a command."""
    command = [sys.executable, "-m", "levid.cli.main", *map(str, arguments)]
    done = subprocess.run(
        [sys.executable, "-c", MEASURED, *command], stdout=subprocess.PIPE, check=True
    )
    return json.loads(done.stdout)
