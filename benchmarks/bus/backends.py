"""Cost of a cycle on each backend, its parts, how punctual 1 kHz on it is, and what flights give.

Parts: _bus_codecs, _bus_transaction, _bus_cycles; how punctual it is: _bus_lateness; the paper's
session flown in real time, identified and compared with loopback's: _bus_flights. The full run
takes two hours, an hour and a quarter of it for punctuality, and more where flights have to be
flown again; --quick five minutes. What was measured is kept as it comes: a run that was stopped
carries on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from levid.benchmarks.bus.bus_rigs import TIMED
from levid.benchmarks.bus.codecs import codec_figures
from levid.benchmarks.bus.cycle_cost import cycle_figures, interface_figures
from levid.benchmarks.bus.flights import flight_figures
from levid.benchmarks.bus.lateness import lateness_figures
from levid.benchmarks.bus.serial_transaction import serial_figures
from levid.benchmarks.harness import table
from levid.benchmarks.harness.code_version import ROOT, code_version
from levid.benchmarks.harness.kept_results import Parts
from levid.benchmarks.harness.table import Figure
from levid.config.shipped import shipped

KEPT = Path(__file__).resolve().parents[2] / "build" / "backends"
ROUNDS = {"canfd": 16, "canfd_udp": 4, "serial": 16}
"""Of a minute each. Where one cycle in 8000 is late, as on a virtual machine of 2 processors, so
many tell in nine of ten runs that a loop is late at most 1.5 times as often as an empty one, if it
is no more so; ten told in seven. By udp_multicast twenty times as many are late."""


def measure(quick: bool) -> list[Figure]:
    length = "quick" if quick else "full"
    kept = Parts(KEPT / f"{length}-{version()}.jsonl")
    few, many = (500, 5_000) if quick else (5_000, 50_000)
    stretch_s, rounds = (2.0, dict.fromkeys(TIMED, 2)) if quick else (60.0, ROUNDS)

    def part(key: str, figures: Callable[[], Sequence[Figure]]) -> list[Figure]:
        return list(map(Figure.of, kept.part(key, lambda: [figure.plain for figure in figures()])))

    found = [
        *part("codecs", lambda: codec_figures(many)),
        *part("serial", lambda: serial_figures(few)),
        *part("interfaces", lambda: interface_figures(few)),
        *part("cycles", lambda: cycle_figures(few)),
        *lateness_figures(stretch_s, rounds, kept),
        *flight_figures(quick, kept),
    ]
    kept.finish()
    return found


def version() -> str:
    """Return a digest of what decides a figure: both ends of the buses, daemon, identification."""
    roots = ("cli/run.py", "cli/electronics.py", "daemon", "drivers", "sim/electronics")
    sources = (*sorted((ROOT / "wire").rglob("*.py")), *sorted(Path(__file__).parent.glob("*.py")))
    settings = [shipped(f"{name}.yaml") for name in ("rigs/loopback", "sims/nominal")]
    return code_version(
        (
            *roots,
            "identification/subspace/ho_kalman.py",
            "identification/nonparametric/frequency_response.py",
        ),
        sources,
        (*settings, shipped("sessions/white-noise-1khz.yaml")),
    )


if __name__ == "__main__":
    table.run("Backends", measure)
