"""Fly the shipped sessions with a commit's code and with this checkout's, and compare every row.

    python benchmarks/daemon/same_rows.py [COMMIT] [--session NAME ...] [--quick] [--json]

A refactoring must not change what the loop does. In virtual time the same seed, machine and version
give the same bytes: so the rig, the simulators and the sessions of COMMIT (the last commit unless
given) are flown twice, and any difference between the logs is due to the code. Each flight is a
process of its own; each version has a new cache of compiled code. `mcap` reads the logs.

Every session is flown on its rig's simulator, `trace-demo` on all the others too. The first
difference of each flight is printed; the exit code is 1 if there is one or a flight has no rows.
--quick flies `beam` and `trace-demo` alone. On two idle processors it takes 2 minutes, all sessions
10 to 15 minutes (white-noise-10khz more than half of that) and 2 GB of disk.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import yaml
from rich.table import Table

from levid.benchmarks.daemon.log_difference import Comparison, compare_folders
from levid.benchmarks.harness.child_processes import started
from levid.benchmarks.harness.code_of_commit import Version, both_versions
from levid.benchmarks.harness.table import Figure, Target, parser, show

TITLE = "Rows before and after"
QUICK = ("beam", "trace-demo")
ON_ALL_SIMS = "trace-demo"
RIG = "config/rigs/loopback.yaml"


@dataclass(frozen=True)
class Flight:
    """A session on a simulator: that of the rig if `sim` is empty."""

    session: str
    sim: str = ""

    @property
    def name(self) -> str:
        return f"{self.session} on {self.sim}" if self.sim else self.session


def main() -> None:
    options = parser(__doc__ or "")
    options.add_argument(
        "commit", nargs="?", default="HEAD", metavar="COMMIT", help="commit to compare with (HEAD)"
    )
    options.add_argument(
        "--session", nargs="+", metavar="NAME", help="sessions to fly, instead of all of COMMIT's"
    )
    arguments = options.parse_args()
    arguments.check = True
    compared: dict[Flight, Comparison] = {}
    names = arguments.session or (QUICK if arguments.quick else None)

    def measure() -> Iterator[Figure]:
        yield from compare(arguments.commit, names, compared)

    show(f"{TITLE}: {arguments.commit}", arguments, measure, lambda: [table(compared)])


def compare(
    commit: str, names: Sequence[str] | None, compared: dict[Flight, Comparison]
) -> Iterator[Figure]:
    """Fly sessions of `commit`, all of them unless named, and add each comparison to `compared`."""
    with both_versions(commit) as versions:
        config = versions[0].folder / "levid" / "config"
        planned = flights(config, names, commit)
        for number, flight in enumerate(planned, 1):
            _say(f"{number} of {len(planned)}: {flight.name} ...")
            start = time.monotonic()
            with tempfile.TemporaryDirectory() as logs:
                found = fly_both(flight, config, versions, Path(logs))
            compared[flight] = found
            seconds = time.monotonic() - start
            _say(f"    {found.rows} equal rows, {found.difference or 'equal'}, {seconds:.0f} s")
            key = re.sub(r"\W+", "_", flight.name)
            yield Figure(f"{key}_rows", found.rows, "rows", "")
            yield Figure(f"{key}_equal", int(not found.difference), "", "")
    differ = sum(bool(found.difference) for found in compared.values())
    yield Figure("rows", sum(found.rows for found in compared.values()), "rows", "equal rows")
    yield Figure("flights_that_differ", differ, "", "flights that differ", target=Target(most=0))


def flights(config: Path, names: Sequence[str] | None, commit: str) -> list[Flight]:
    """Return the flights of sessions in a config folder, the rig's own simulator first."""
    sessions = sorted(path.stem for path in (config / "sessions").glob("*.yaml"))
    if unknown := sorted(set(names or ()) - set(sessions)):
        sys.exit(f"{commit} ships no session {', '.join(unknown)}; it has {', '.join(sessions)}")
    rig = yaml.safe_load((config.parent / RIG).read_text(encoding="utf-8"))
    own = Path(rig["sim"]).stem
    others = sorted({path.stem for path in (config / "sims").glob("*.yaml")} - {own})
    found = []
    for name in names or sessions:
        found += [Flight(name, sim) for sim in ("", *(others if name == ON_ALL_SIMS else ()))]
    return found


def fly_both(
    flight: Flight, config: Path, versions: tuple[Version, Version], folder: Path
) -> Comparison:
    """Fly with both versions at the same time, and compare their logs."""
    session = folder / f"{flight.session}.yaml"
    text = (config / "sessions" / session.name).read_text(encoding="utf-8")
    session.write_text(without_then(text), encoding="utf-8")
    command = [sys.executable, "-m", "levid.cli.main", "excite", str(session), "--virtual"]
    command += ["--rig", str(config.parent / RIG)]
    if flight.sim:
        command += ["--sim", str(config / "sims" / f"{flight.sim}.yaml")]
    outs = [folder / version.folder.name for version in versions]
    said = [out.with_suffix(".log") for out in outs]
    with (
        said[0].open("wb") as one,
        said[1].open("wb") as other,
        _flown(command, versions[0], outs[0], one) as old,
        _flown(command, versions[1], outs[1], other) as new,
    ):
        codes = old.wait(), new.wait()
    found = compare_folders(*outs)
    if codes[0] == codes[1] and (found.rows or found.difference):
        return found
    ends = [f"exit code {c}, '{_last_line(path)}'" for c, path in zip(codes, said, strict=True)]
    why = f"{found.difference or 'no difference'}; {ends[0]} before; {ends[1]} after"
    return Comparison(found.rows, why)


def without_then(session: str) -> str:
    """Return the text of a session that ends with its landing: what follows would take longer."""
    return re.sub(r"(?m)^then:.*\n?([ \t-].*\n?)*", "", session)


def table(compared: dict[Flight, Comparison]) -> Table:
    """Return the comparisons as a table."""
    found = Table("session", "simulator", "equal rows", "first difference", title=TITLE)
    for flight, one in compared.items():
        found.add_row(
            flight.session, flight.sim or "rig's", f"{one.rows:,}", one.difference or "equal"
        )
    return found


def _flown(
    command: list[str], version: Version, out: Path, said: IO[bytes]
) -> AbstractContextManager[subprocess.Popen[bytes]]:
    return started(
        [*command, "--out", str(out)],
        cwd=version.folder,  # before PYTHONPATH on Python's path
        env=version.environment,
        stdout=said,
        stderr=subprocess.STDOUT,
    )


def _last_line(path: Path) -> str:
    lines = path.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1].strip() if lines else "no message"


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
