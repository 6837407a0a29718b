"""Files of 21 instruments, imported as a new user does and identified: rate, units, parameters.

Truth: a mass of 1 kg, 2 N s/m, 50 N/m, at 200 Hz. A file that is refused counts as missed.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from rich.table import Table

from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.benchmarks.log.instrument_files import (
    DAMPING_N_S_M,
    EXPORTS,
    MASS_KG,
    RATE_HZ,
    STIFFNESS_N_M,
    motion,
)
from levid.benchmarks.log.new_user_import import MODEL, import_as_new_user

TRUTH = {"m": MASS_KG, "d": DAMPING_N_S_M, "k": STIFFNESS_N_M}
MOST_ERROR = 0.01
"""Largest relative error of a parameter. Files have four digits or more, and the noise is 1e-4 of
the position, which is a tenth of this after 20 s."""
_QUICK = 3
"""Number of files that are identified with --quick; all are imported."""
_TITLE = "Exports of instruments"


class Results:
    """Rows of the printed table."""

    def __init__(self) -> None:
        self.rows: list[tuple[str, ...]] = []

    def measure(self, quick: bool) -> Iterator[Figure]:
        record = motion(2000 if quick else 4000)
        with tempfile.TemporaryDirectory() as folder:
            model = Path(folder) / "model.yaml"
            model.write_text(MODEL)
            for name, export in EXPORTS.items():
                draft, imported = import_as_new_user(Path(folder), name, export(record))
                log = imported.logs[0][0]
                identify = not quick or len(self.rows) < _QUICK
                out = Path(folder) / name
                found = _parameters(log, model, out) if identify else {}
                units = [
                    line.partition("unit: ")[2].partition(",")[0] for line in _lines(draft.text)
                ]
                self.rows.append(
                    (
                        name.replace("_", " "),
                        f"{imported.rate_hz:.6g}",
                        " ".join(units),
                        *(f"{found[key]:.4g}" if found else "" for key in TRUTH),
                        str(len(imported.notes)),
                    )
                )
                yield Figure(
                    f"{name}_rate_error",
                    abs(imported.rate_hz / RATE_HZ - 1.0),
                    "",
                    "",
                    target=Target(most=1e-6),
                )
                if not found:
                    continue
                error = max(abs(found[key] / value - 1.0) for key, value in TRUTH.items())
                yield Figure(
                    f"{name}_parameter_error",
                    error,
                    "",
                    name.replace("_", " "),
                    target=Target(most=MOST_ERROR),
                )

    def tables(self) -> Iterator[Table]:
        table = Table(title="As imported; truth: 200 Hz, m 1, d 2, k 50", title_justify="left")
        for head in ("format", "rate [Hz]", "units in the draft", "m", "d", "k", "notes"):
            table.add_column(head)
        for row in self.rows:
            table.add_row(*row)
        yield table


def _lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("  - {column:")]


def _parameters(log: Path, model: Path, out: Path) -> dict[str, float]:
    """Return the parameters that `levid identify --model` finds."""
    command = [
        sys.executable,
        "-c",
        "import sys; from levid.cli.entry import main; sys.exit(main())",
        "identify",
        str(log),
    ]
    command += ["--model", str(model), "--out", str(out), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    answer = json.loads(done.stdout)
    return {key: float(answer["grey_box"]["parameters"][key]["value"]) for key in TRUTH}


if __name__ == "__main__":
    results = Results()
    arguments = parser(_TITLE).parse_args()
    show(_TITLE, arguments, lambda: results.measure(arguments.quick), results.tables)
