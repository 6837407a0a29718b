"""Run several commands as the console script does, in one process: imports take seconds."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

_SCRIPT = """
import json, os, sys
os.umask(int(sys.argv[1], 8))
commands, outcome = json.loads(sys.argv[2]), sys.argv[3]
from levid.cli.entry import main
codes = []
for command in commands:
    sys.argv = ["levid", *command]
    try:
        main()
    except SystemExit as end:
        codes.append(end.code)
    with open(outcome, "w") as file:
        json.dump(codes, file)
"""


class Outcome(NamedTuple):
    """Exit codes of the commands, and what all of them printed."""

    codes: list[int]
    stdout: str
    stderr: str


def run_commands(
    commands: Sequence[Sequence[str]],
    cwd: Path,
    environment: Mapping[str, str],
    scratch: Path,
    umask: int = 0o022,
) -> Outcome:
    """Run commands in a folder and nothing but this environment."""
    # As a file beside nothing else: `python -c` would put the working directory on the search path.
    script, codes = scratch / "run_commands.py", scratch / "codes.json"
    script.write_text(_SCRIPT)
    lines = [list(map(str, command)) for command in commands]
    done = subprocess.run(
        [sys.executable, str(script), f"{umask:o}", json.dumps(lines), str(codes)],
        cwd=cwd, env=dict(environment), capture_output=True, check=False,
    )  # fmt: skip
    stdout, stderr = (
        text.decode("utf-8", "backslashreplace") for text in (done.stdout, done.stderr)
    )
    assert codes.exists(), stderr
    return Outcome(json.loads(codes.read_text()), stdout, stderr)


def plain_environment() -> dict[str, str]:
    """Return what a command needs of this environment: little."""
    kept = ("PATH", "HOME", "NUMBA_CACHE_DIR", "PYTHONPATH", "OPENBLAS_NUM_THREADS")
    return {name: os.environ[name] for name in kept if name in os.environ}
