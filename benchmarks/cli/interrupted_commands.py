"""Interrupt every command by Ctrl-C at random instants, and look at what is left.

Each command is started in a process group of its own, which gets SIGINT, as from a terminal, at an
instant between the first line of cli/entry.py and the command's end. Afterwards:

- the exit code is 130, or that of the whole command, if it was done before;
- stderr has no traceback and no message of Python;
- no process of the command is left, and nothing is new in /dev/shm;
- no temporary file is left, and each file that the command wrote is whole: it reads as that of a
  run without interrupt, or a reader says that it was cut off.

--quick: 4 instants each, otherwise 40, which takes an hour.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.io
import yaml

from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure, Target
from levid.log.reader import read_log

_RUN = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
number = int(sys.argv.pop(1))
from levid.cli.entry import main
os.write(number, b".")
os.close(number)
main()
"""
_SERVING = ("run", "electronics")
"""Commands that end with exit code 0 after Ctrl-C, once they serve."""
_SERVED_S = 8.0
_ENDS_S = 60.0
_EXIT_S, _EXIT_SHARE = 0.5, 0.1
"""Time of Python's own exit, in which a command is done and Ctrl-C changes nothing: in s, and as a
share of the whole run, which a busy machine makes longer."""
_SESSION = """
levid: session
name: short
rate_hz: 1000
excitations:
  psi: {input: psi, rms_n_m: 0.3}
  z: {input: z, rms_n: 2.0}
steps:
  - levitate: {}
  - record: {name: first, excite: [psi], duration_s: 20}
  - record: {name: second, excite: [z], duration_s: 20}
  - land: {}
"""
_SIGNALS = """
levid: signals
rate_hz: 100
columns:
  force: {role: input, unit: N}
  position: {role: output, unit: m}
"""


@dataclass(frozen=True)
class Command:
    """A command by its arguments; OUT in them is a folder that is empty before each run."""

    name: str
    arguments: tuple[str, ...]


@dataclass
class Outcome:
    """What a command left: exit code, stderr, and what is wrong with the rest."""

    code: int
    seconds: float
    err: str
    wrong: list[str]


def commands(folder: Path) -> list[Command]:
    """Prepare what the commands read, and return one command for each verb that can be tried."""
    (folder / "session.yaml").write_text(_SESSION)
    (folder / "signals.yaml").write_text(_SIGNALS)
    rng = np.random.default_rng(1)
    force = rng.standard_normal(40_000)
    table = np.column_stack([force, np.cumsum(np.cumsum(force)) * 1e-8])
    np.savetxt(folder / "data.csv", table, delimiter=",", header="force,position", comments="")
    rig = Path("config/rigs")
    root = Path(__file__).resolve().parents[2]
    flown, result = str(folder / "flown"), str(folder / "flown" / "identification")
    _levid("excite", str(folder / "session.yaml"), "--virtual", "--out", flown)
    logs = sorted(map(str, (folder / "flown").glob("*.mcap")))
    _levid("identify", *logs, "--out", result)
    first = logs[1]
    cut = folder / "cut.mcap"
    cut.write_bytes(Path(first).read_bytes()[:-50_000])
    return [
        Command("check", ("check", str(root / rig / "canfd.yaml"), *logs)),
        Command("excite", ("excite", str(folder / "session.yaml"), "--virtual", "--out", "OUT/a")),
        Command("identify", ("identify", *logs, "--out", "OUT/a")),
        Command("trace", ("trace", *logs, "--out", "OUT/a")),
        Command("demo", ("demo", "--out", "OUT/a")),
        Command("info", ("info", flown)),
        Command("list", ("list", str(folder))),
        Command("plot", ("plot", first, "-o", "OUT/a.svg")),
        Command("export csv", ("export", first, "-o", "OUT/a.csv")),
        Command("export mat", ("export", first, "-o", "OUT/a.mat")),
        Command("export parquet", ("export", first, "-o", "OUT/a.parquet")),
        Command("export npz", ("export", *logs, "--format", "npz", "-o", "OUT/a")),
        Command("compare", ("compare", result, result, "--out", "OUT/a")),
        Command("salvage", ("salvage", str(cut), "--out", "OUT/a")),
        Command("layout", ("layout", str(root / rig / "loopback.yaml"), "--out", "OUT/a")),
        Command("new", ("new", "signals", str(folder / "data.csv"), "-o", "OUT/a.yaml")),
        Command(
            "import",
            (
                *("import", str(folder / "data.csv"), "--signals", str(folder / "signals.yaml")),
                *("-o", "OUT/a.mcap"),
            ),
        ),
        Command("completion", ("completion", "bash")),
        Command("status", ("status",)),
        Command("stop", ("stop",)),
        Command("stop rig", ("stop", "--rig", str(root / rig / "serial.yaml"))),
        Command("move", ("move", "--beam-m", "0.01")),
        *(Command(verb, (verb,)) for verb in ("levitate", "land", "clear")),
        Command("watch", ("watch", "--lines")),
        Command(
            "commission", ("commission", str(root / rig / "loopback.yaml"), "--out", "OUT/a.yaml")
        ),
        Command(
            "install-service", ("install-service", str(root / rig / "can.yaml"), "--root", "OUT")
        ),
        Command("run", ("run", str(root / rig / "loopback.yaml"))),
        Command("electronics", ("electronics", str(root / rig / "serial.yaml"))),
    ]


def _levid(*arguments: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "levid.cli.main", *arguments], check=False, capture_output=True
    )
    if done.returncode:
        sys.exit(f"levid {' '.join(arguments)}: {done.stderr.decode()}")


def run_interrupted(
    command: Command, out: Path, after_s: float | None, environment: dict[str, str]
) -> Outcome:
    """Run a command, interrupted `after_s` after its first line; None: not interrupted."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    before = _shared_memory()
    begun, ready = os.pipe()
    arguments = [argument.replace("OUT", str(out)) for argument in command.arguments]
    with tempfile.TemporaryFile() as err:
        process = subprocess.Popen(
            [sys.executable, "-c", _RUN, str(ready), *arguments],
            pass_fds=(ready,), process_group=0, env=environment, cwd=out.parent,
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=err,
        )  # fmt: skip
        os.close(ready)
        os.read(begun, 1)
        os.close(begun)
        started_s = time.monotonic()
        if after_s is not None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(after_s)
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGINT)
        wrong = []
        try:
            process.wait(_ENDS_S if after_s is not None else None)
        except subprocess.TimeoutExpired:
            wrong.append(f"still runs {_ENDS_S:.0f} s after Ctrl-C")
        seconds = time.monotonic() - started_s
        wrong += _left_over(process.pid, before)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        code = process.wait()
        err.seek(0)
        text = err.read().decode(errors="replace")
    for sign in ("Traceback", "Exception ignored", "resource_tracker", "Fatal"):
        if sign in text:
            wrong.append(f"stderr: {sign}")
    return Outcome(code, seconds, text, wrong)


def _shared_memory() -> set[str]:
    return {path.name for path in Path("/dev/shm").iterdir()}


def _left_over(group: int, before: set[str]) -> list[str]:
    """Return the processes of a group and the shared memory that are left, after a grace time."""
    deadline_s = time.monotonic() + 5.0
    while True:
        left = [f"process left: {name}" for name in _processes(group)]
        left += [f"/dev/shm/{name} left" for name in sorted(_shared_memory() - before)]
        if not left or time.monotonic() > deadline_s:
            return left
        time.sleep(0.05)


def _processes(group: int) -> list[str]:
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        with suppress(OSError, IndexError, ValueError):
            state, _, of = (entry / "stat").read_text().rpartition(")")[2].split()[:3]
            if int(of) == group and state != "Z":
                found.append((entry / "cmdline").read_text().replace("\0", " ")[:200])
    return found


def sizes(out: Path) -> dict[str, object]:
    """Return for each file below a folder a number or a text that a whole file has."""
    found: dict[str, object] = {}
    for path in sorted(out.rglob("*")):
        if path.is_file():
            name = str(path.relative_to(out))
            try:
                found[name] = _size(path)
            except Exception as error:  # noqa: BLE001 - whatever its reader says
                found[name] = f"{type(error).__name__}: {error}"
    return found


def _size(path: Path) -> object:
    reader = _READERS.get(path.suffix)
    return path.stat().st_size if reader is None else reader(path)


def _rows_of_log(path: Path) -> int | None:
    """Return the rows of a log; None if its reader says that it was cut off."""
    log = read_log(path)
    return log.rows.size if log.complete else None


def _arrays(path: Path) -> dict[str, tuple[int, ...]]:
    with np.load(path) as arrays:
        return {name: arrays[name].shape for name in arrays.files}


def _rows_of_parquet(path: Path) -> int:
    import pyarrow.parquet

    rows: int = pyarrow.parquet.read_metadata(path).num_rows
    return rows


def _closed(path: Path) -> bool:
    return path.read_text().rstrip().endswith(f"</{path.suffix[1:]}>")


def _filled(path: Path) -> bool:
    return path.stat().st_size > 0


_READERS: dict[str, Callable[[Path], object]] = {
    ".mcap": _rows_of_log,
    ".csv": lambda path: len(path.read_bytes().splitlines()),
    ".npz": _arrays,
    ".mat": scipy.io.whosmat,
    ".parquet": _rows_of_parquet,
    ".html": _closed,
    ".svg": _closed,
    ".json": lambda path: sorted(json.loads(path.read_text())),
    ".jsonl": lambda path: all(map(json.loads, path.read_text().splitlines())),
    ".yaml": lambda path: sorted(yaml.safe_load(path.read_text())),
    **dict.fromkeys((".npy", ".png", ".pdf", ".xml", ".txt", ".md", ""), _filled),
}


def compare(now: dict[str, object], whole: dict[str, object]) -> Iterator[str]:
    """Yield what is wrong with the files of an interrupted command."""
    for name, size in now.items():
        hidden = Path(name).name.startswith(".") or name.endswith((".part", ".tmp"))
        if hidden and name not in whole:
            yield f"temporary file left: {name}"
        elif size is not None and size != whole.get(name, size):
            yield f"{name} looks whole: {size}, a whole one has {whole[name]}"


def trials(
    command: Command, folder: Path, instants: int, environment: dict[str, str], seed: int
) -> Iterator[str]:
    """Yield for each instant what went wrong, empty if nothing did."""
    out = folder / "out"
    serves = command.name in _SERVING
    if serves:
        whole = run_interrupted(command, out, _SERVED_S, environment)
    else:
        whole = run_interrupted(command, out, None, environment)
    expected = sizes(out)
    rng = random.Random(seed)
    for number in range(instants):
        # Half of the instants lie in the first second, when modules are imported.
        longest_s = min(whole.seconds, 1.0) if number % 2 else 1.02 * whole.seconds
        after_s = rng.uniform(0.0, longest_s)
        found = run_interrupted(command, out, after_s, environment)
        wrong = found.wrong
        ends_s = after_s + _EXIT_S + _EXIT_SHARE * whole.seconds
        if found.code != 130 and not (
            found.code == whole.code and (serves or found.seconds <= ends_s)
        ):
            wrong.append(f"exit code {found.code}")
        wrong += compare(sizes(out), expected)
        if wrong:
            sys.stderr.write(
                f"levid {command.name} after {after_s:.3f} of {whole.seconds:.3f} s: "
                f"{'; '.join(wrong)}\n{found.err[-2000:]}\n"
            )
        yield "; ".join(wrong)


def measure(quick: bool, only: Sequence[str] = ()) -> Iterator[Figure]:
    """Interrupt each command at 4 or 40 instants; yield the trials that left something."""
    with tempfile.TemporaryDirectory(prefix="levid-interrupted-") as name:
        folder = Path(name)
        environment = {
            **os.environ,
            "XDG_RUNTIME_DIR": str(folder),  # the sockets of this benchmark's daemons
            "XDG_STATE_HOME": str(folder),
            "OPENBLAS_NUM_THREADS": "1",
        }
        for seed, command in enumerate(commands(folder)):
            if only and command.name not in only:
                continue
            done = list(trials(command, folder, 4 if quick else 40, environment, seed))
            key = command.name.replace(" ", "_")
            label = f"levid {command.name}: trials of {len(done)} that left something"
            yield Figure(f"wrong_{key}", sum(map(bool, done)), "", label, target=Target(most=0))


if __name__ == "__main__":
    parser = benchmark_runner.parser(__doc__ or "")
    parser.add_argument("--only", nargs="*", default=(), help="names of commands")
    given = parser.parse_args()
    benchmark_runner.show(
        "Commands interrupted by Ctrl-C", given, lambda: measure(given.quick, given.only)
    )
