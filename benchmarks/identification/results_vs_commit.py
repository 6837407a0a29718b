"""Identify and trace one flight with a commit's code and with this checkout's; compare all numbers.

    python benchmarks/identification/results_vs_commit.py [COMMIT] [--session NAME] [--quick]
        [--json]

COMMIT (the last commit unless given) flies its own shipped session in virtual time. Then both
versions run `levid identify --json` and `levid trace --json` on these logs, in processes of their
own. Every number of COMMIT's answers must be in this checkout's, equal to 1e-9 of its size; new
keys are allowed. The largest difference is printed with its place. --quick identifies alone, on
the session `multisine-1khz`.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from levid.benchmarks.daemon.log_rows_vs_commit import without_then
from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.benchmarks.harness.checkout_of_commit import Version, both_versions

LIMIT = 1e-9
SESSION, QUICK_SESSION = "trace-demo", "multisine-1khz"


def main() -> None:
    options = parser(__doc__ or "")
    options.add_argument(
        "commit", nargs="?", default="HEAD", metavar="COMMIT", help="commit to compare with (HEAD)"
    )
    options.add_argument("--session", metavar="NAME", help=f"session to fly ({SESSION})")
    arguments = options.parse_args()
    arguments.check = True
    session = arguments.session or (QUICK_SESSION if arguments.quick else SESSION)
    verbs = ("identify",) if arguments.quick else ("identify", "trace")
    show(
        f"Results before and after: {arguments.commit}",
        arguments,
        lambda: compare(arguments.commit, session, verbs),
    )


def compare(commit: str, session: str, verbs: tuple[str, ...]) -> Iterator[Figure]:
    """Yield for each verb how many numbers there are and how far they differ, and new texts."""
    with both_versions(commit) as (before, after), tempfile.TemporaryDirectory() as folder:
        logs = _fly(before, session, Path(folder))
        for verb in verbs:
            answers = []
            for version in (before, after):
                out = Path(folder) / f"{verb}-{version.folder.name}"
                said = version.levid(verb, *logs, "--out", str(out), "--json")
                answers.append(json.loads(said))
            found = Comparison()
            found.compare(*answers)
            yield Figure(f"{verb}_numbers", found.numbers, "", f"{verb}: numbers compared")
            label = f"{verb}: largest relative difference"
            label += f", at {found.place}" if found.difference else ""
            yield Figure(f"{verb}_difference", found.difference, "", label, target=Target(LIMIT))
            yield Figure(f"{verb}_texts", len(found.texts), "", f"{verb}: texts with new words")
            for text in found.texts:
                print(text, file=sys.stderr)


@dataclass
class Comparison:
    """What two answers differ in: the largest relative difference of a number, and texts."""

    numbers: int = 0
    difference: float = 0.0
    place: str = ""
    texts: list[str] = field(default_factory=list)

    def compare(self, before: Any, after: Any, place: str = "") -> None:
        """Compare all that `before` has; what `after` lacks differs infinitely.

        Paths are not compared.
        """
        if isinstance(before, dict) and isinstance(after, dict):
            for key in before:
                self.compare(before[key], after.get(key), f"{place}.{key}")
        elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
            for i, (one, other) in enumerate(zip(before, after, strict=True)):
                self.compare(one, other, f"{place}[{i}]")
        elif isinstance(before, str) and isinstance(after, str):
            if before != after and "/" not in before:
                self.texts.append(f"{place}: {before!r} is now {after!r}")
        elif _is_number(before) and _is_number(after):
            self.numbers += 1
            size = max(abs(before), abs(after))
            self._differ(abs(before - after) / size if size else 0.0, place)
        elif before != after:
            self._differ(math.inf, place)

    def _differ(self, difference: float, place: str) -> None:
        if difference > self.difference:
            self.difference, self.place = difference, place


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _fly(version: Version, session: str, folder: Path) -> list[str]:
    """Fly a shipped session of this version in virtual time; return the paths of its logs."""
    shipped = version.folder / "levid" / "config"
    plan, logs = folder / f"{session}.yaml", folder / "logs"
    plan.write_text(without_then((shipped / "sessions" / plan.name).read_text(encoding="utf-8")))
    flown = ["excite", str(plan), "--virtual", "--out", str(logs)]
    flown += ["--rig", str(shipped / "rigs" / "loopback.yaml")]
    version.levid(*flown, "--sim", str(shipped / "sims" / "undeclared.yaml"))
    return [str(path) for path in sorted(logs.glob("*.mcap"))]


if __name__ == "__main__":
    main()
