"""Fly the shipped sessions with a commit's code and with this checkout's, and compare every row.

    python benchmarks/daemon/log_rows_vs_commit.py [COMMIT] [--session NAME ...]
        [--ignore-fields NAME ...]

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
from collections.abc import Container, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml

from levid.benchmarks.daemon.log_difference import Comparison, compare_folders
from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.benchmarks.harness.checkout_of_commit import Version, both_versions
from levid.benchmarks.harness.start_and_end_processes import started

QUICK = ("beam", "trace-demo")
ON_ALL_SIMS = "trace-demo"
RIG = "config/rigs/loopback.yaml"


class Flight(NamedTuple):
    """A session on a simulator: that of the rig if `sim` is empty."""

    session: str
    sim: str = ""

    def __str__(self) -> str:
        return f"{self.session} on {self.sim}" if self.sim else self.session


def main() -> None:
    options = parser(__doc__ or "")
    options.add_argument(
        "commit", nargs="?", default="HEAD", metavar="COMMIT", help="commit to compare with (HEAD)"
    )
    options.add_argument(
        "--session", nargs="+", metavar="NAME", help="sessions to fly, instead of all of COMMIT's"
    )
    options.add_argument(
        "--ignore-fields", nargs="+", default=(), metavar="FIELD",
        help="log fields that are not compared, such as one that COMMIT has not",
    )  # fmt: skip
    arguments = options.parse_args()
    arguments.check = True
    names = arguments.session or (QUICK if arguments.quick else ())
    title = f"Rows before and after: {arguments.commit}"
    show(title, arguments, lambda: compare(arguments.commit, names, arguments.ignore_fields))


def compare(commit: str, names: Sequence[str], ignored: Container[str]) -> Iterator[Figure]:
    """Fly sessions of `commit`, all of them unless named, and yield the comparisons."""
    with both_versions(commit) as versions:
        planned = flights(versions[0].folder / "levid" / "config", names, commit)
        found = []
        for number, flight in enumerate(planned, 1):
            with tempfile.TemporaryDirectory() as logs:
                one = fly_both(flight, versions, Path(logs), ignored)
            found.append(one)
            said = f"{one.rows} equal rows, {one.difference or 'equal'}"
            print(f"{number} of {len(planned)}: {flight}: {said}", file=sys.stderr, flush=True)
            key = re.sub(r"\W+", "_", str(flight))
            yield Figure(f"{key}_rows", one.rows, "rows", f"{flight}: equal rows")
            yield Figure(f"{key}_equal", int(not one.difference), "", "")
    differ = sum(bool(one.difference) for one in found)
    yield Figure("rows", sum(one.rows for one in found), "rows", "equal rows")
    yield Figure("flights_that_differ", differ, "", "flights that differ", target=Target(most=0))


def flights(config: Path, names: Sequence[str], commit: str) -> list[Flight]:
    """Return the flights of sessions in a config folder, the rig's own simulator first."""
    sessions = sorted(path.stem for path in (config / "sessions").glob("*.yaml"))
    if unknown := sorted(set(names) - set(sessions)):
        sys.exit(f"{commit} ships no session {', '.join(unknown)}; it has {', '.join(sessions)}")
    rig = yaml.safe_load((config.parent / RIG).read_text(encoding="utf-8"))
    others = sorted(
        {path.stem for path in (config / "sims").glob("*.yaml")} - {Path(rig["sim"]).stem}
    )
    return [
        Flight(name, sim)
        for name in names or sessions
        for sim in ("", *(others if name == ON_ALL_SIMS else ()))
    ]


def fly_both(
    flight: Flight, versions: Sequence[Version], logs: Path, ignored: Container[str] = ()
) -> Comparison:
    """Fly both versions' code at the same time, on the first one's config; compare the logs."""
    config = versions[0].folder / "levid" / "config"
    session = logs / f"{flight.session}.yaml"
    text = (config / "sessions" / session.name).read_text(encoding="utf-8")
    session.write_text(without_then(text), encoding="utf-8")
    command = [sys.executable, "-m", "levid.cli.main", "excite", str(session), "--virtual"]
    command += ["--rig", str(config.parent / RIG)]
    if flight.sim:
        command += ["--sim", str(config / "sims" / f"{flight.sim}.yaml")]
    outs = [logs / version.folder.name for version in versions]
    said = [out.with_suffix(".log") for out in outs]

    with said[0].open("wb") as one, said[1].open("wb") as other:
        flying = [
            started(
                [*command, "--out", str(out)],
                cwd=version.folder,  # before PYTHONPATH on Python's path
                env=version.environment,
                stdout=file,
                stderr=subprocess.STDOUT,
            )
            for out, version, file in zip(outs, versions, (one, other), strict=True)
        ]
        with flying[0] as old, flying[1] as new:
            codes = old.wait(), new.wait()
    found = compare_folders(outs[0], outs[1], ignored)
    if codes[0] == codes[1] and (found.rows or found.difference):
        return found
    last = [(path.read_text(errors="replace").splitlines() or ["no message"])[-1] for path in said]
    ends = [f"exit code {code}, '{line}'" for code, line in zip(codes, last, strict=True)]
    why = f"{found.difference or 'no difference'}; {ends[0]} before; {ends[1]} after"
    return Comparison(found.rows, why)


def without_then(session: str) -> str:
    """Return the text of a session that ends with its landing: what follows would take longer."""
    return re.sub(r"(?m)^then:.*\n?([ \t-].*\n?)*", "", session)


if __name__ == "__main__":
    main()
