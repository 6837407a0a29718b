"""Trace measured data of other rigs by `levid trace`: what is found, missing force, time.

EMPS (each record and both), two levitated magnets by their current with an unknown controller, the
Silverbox (three eighths of its training data), and an inverted pendulum. The trace of imported
records was developed on these data: they show what it says of them, not how well it does on others.
The pendulum's data are in `tests/measured`. The others are no part of the project: `shared/data`
beside the checkout, or --data DIR. Data that are not there are left out.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from levid.benchmarks.harness import silverbox
from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.benchmarks.identification.measured_data import DATA, Case, cases, run_levid
from levid.config.base import read_mapping
from levid.identification.subspace.response_uncertainty import SURE_95

TRACED = ("emps", "emps_pulses", "emps_both", "magnet", "magnet_2", "pendulum")
SILVERBOX_ROWS = ((40_650, 48_841), (65_226, 73_417), (89_802, 97_993))
"""First and last rows of three eighths of the usual training data."""
MINUTE = Target(most=60.0)


def traced_cases() -> dict[str, Case]:
    """Return the cases by key."""
    known = cases()
    signals = read_mapping(silverbox.SIGNALS)
    parts = tuple(
        signals | {"name": f"silverbox-{first}", "rows": {"first": first, "last": last}}
        for first, last in SILVERBOX_ROWS
    )
    files = (f"silverbox/{silverbox.SOURCE.name}",) * len(parts)
    box = Case("Silverbox", files, parts, read_mapping(silverbox.MODEL))
    return {**{key: known[key] for key in TRACED}, "silverbox": box}


def words(effect: dict[str, Any]) -> str:
    """Return an effect with its parameters and their 95 % intervals."""
    values = ", ".join(
        f"{name} {p['value']:.4g}" + ("" if p["se"] is None else f" +- {SURE_95 * p['se']:.2g}")
        for name, p in effect["parameters"].items()
    )
    return effect["name"] if effect["class"] == "unknown" else f"{effect['name']} ({values})"


def main() -> None:
    """Trace every case and print the figures."""
    options = parser("Trace of measured data; --quick: the pendulum alone")
    options.add_argument("--data", type=Path, default=DATA, metavar="DIR")
    options.add_argument("--case", action="append", default=[], choices=traced_cases())
    arguments = options.parse_args()
    names: Sequence[str] = arguments.case or (("pendulum",) if arguments.quick else ())
    table = Table("records", "found")

    def measure() -> Iterator[Figure]:
        for key, case in traced_cases().items():
            there = all((arguments.data / file).exists() for file in case.files)
            if (names and key not in names) or not there:
                continue
            with tempfile.TemporaryDirectory() as folder:
                found, seconds = run_levid("trace", case, arguments.data, Path(folder))
            effects = "; ".join(words(e) for e in found["effects"]) or "nothing confirmed"
            table.add_row(case.label, effects)
            for name, dof in found["validation"]["per_dof"].items():
                for when in ("before", "after"):
                    percent = dof["force_percent"][when]
                    label = f"{case.label}: missing force at {name}, {when}"
                    yield Figure(f"{key}_{name}_{when}", percent, "%", label)
            yield Figure(f"{key}_seconds", seconds, "s", "  time of levid trace", target=MINUTE)

    show("Trace of measured data", arguments, measure, lambda: [table])


if __name__ == "__main__":
    main()
