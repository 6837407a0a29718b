"""Time `levid trace` of a commit and of this checkout on the same logs, one after the other.

    python benchmarks/trace/trace_time_vs_commit.py [COMMIT] [--quick] [--json]

Twelve records of 60 s at 1 kHz (three of 24 s with --quick) of a plant with two undeclared effects
are traced with a model that is 10 % off, by both versions in turn, twice. A short trace before
that compiles the code of each. The ratio of the times is that of the medians.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.benchmarks.harness.checkout_of_commit import Version, both_versions
from levid.benchmarks.trace.trace_time_and_memory import EFFECTS, session

COMMIT, REPEATS = "da9bfb8", 2
OFF = 0.1


def main() -> None:
    options = parser(__doc__ or "")
    options.add_argument("commit", nargs="?", default=COMMIT, help=f"commit to compare ({COMMIT})")
    arguments = options.parse_args()
    show(
        f"Time of a trace: {arguments.commit} and this checkout",
        arguments,
        lambda: compare(arguments.commit, arguments.quick),
    )


def compare(commit: str, quick: bool) -> Iterator[Figure]:
    """Yield the median times of both versions, their ratio, and what each found."""
    with both_versions(commit) as versions, tempfile.TemporaryDirectory() as folder:
        logs = _flown(versions[0], session(24.0 if quick else 60.0, quick), Path(folder))
        models = {v.name: _model(v, Path(folder)) for v in versions}
        for version in versions:
            _traced(version, logs[: len(logs) // 2], models[version.name], Path(folder))
        seconds: dict[str, list[float]] = {v.name: [] for v in versions}
        for _ in range(REPEATS):
            for version in versions:
                taken, said = _traced(version, logs, models[version.name], Path(folder))
                seconds[version.name].append(taken)
                named = [f"{e['class']} at {', '.join(e['where'])}" for e in said["effects"]]
                print(f"{version.name}: {taken:.0f} s: {'; '.join(named)}", file=sys.stderr)
        before, after = (statistics.median(seconds[v.name]) for v in versions)
        yield Figure("before_s", before, "s", f"{len(logs)} records, {commit}")
        yield Figure("after_s", after, "s", f"{len(logs)} records, this checkout")
        target = None if quick else Target(most=0.4)
        yield Figure("ratio", after / before, "", "time over that of the commit", target=target)


def _flown(version: Version, plan: dict[str, object], folder: Path) -> list[Path]:
    """Fly a session with a commit's code, whose logs this checkout can read; return the logs."""
    shipped = version.folder / "levid" / "config"
    sim = yaml.safe_load((shipped / "sims" / "nominal.yaml").read_text(encoding="utf-8"))
    files = {"session": plan, "sim": {**sim, "effects": list(EFFECTS.values())}}
    for name, content in files.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    flown = ["excite", str(folder / "session.yaml"), "--virtual"]
    flown += ["--sim", str(folder / "sim.yaml"), "--out", str(folder / "logs")]
    version.levid(*flown, "--rig", str(shipped / "rigs" / "loopback.yaml"))
    return sorted((folder / "logs").glob("*record-*.mcap"))


def _model(version: Version, folder: Path) -> Path:
    """Write the version's model of the rig, its free parameters off by a random 10 %."""
    shipped = version.folder / "levid" / "config" / "models" / "rig.yaml"
    model = yaml.safe_load(shipped.read_text(encoding="utf-8"))
    rng = np.random.default_rng(1)
    for parameter in model["parameters"].values():
        if not parameter.get("fixed"):
            value = parameter["value"] * (1.0 + OFF * rng.standard_normal())
            parameter["value"] = float(value) if parameter["value"] else 2e-5
    file = folder / f"{version.name}.yaml"
    file.write_text(yaml.safe_dump(model, sort_keys=False))
    return file


def _traced(
    version: Version, logs: Sequence[Path], model: Path, folder: Path
) -> tuple[float, dict[str, list[dict[str, Any]]]]:
    """Return the time of a trace in s, start and report included, and what it printed."""
    options = ["--model", str(model), "--json", "--out", str(folder / "found")]
    begin = time.perf_counter()
    said = version.levid("trace", *map(str, logs), *options)
    return time.perf_counter() - begin, json.loads(said)


if __name__ == "__main__":
    main()
