"""levid against its peers on the same records in the same run: error, time and memory of P.

Flies white noise at each input in turn, with the beam off the middle, so that theta and z couple,
and has every contender (contenders.py) identify P from those logs, each in a process of its own.
Beside them stands the multisine method, which needs multisines: flown for the same time. The grey
box starts from a declared model that is 10 % off. The truth is the simulator's. Several flights
differ in seed; the medians over them are shown. `pip install levid[peers]` brings the other
packages; what is missing or fails says so in the table.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich import box
from rich.table import Table

from levid.benchmarks.harness.declared_model import off_by_a_tenth
from levid.benchmarks.harness.isolated import Outcome, measure_apart
from levid.benchmarks.harness.multisine_records import fly_multisines
from levid.benchmarks.harness.table import Figure, parser, show
from levid.benchmarks.harness.virtual_flight import truth
from levid.benchmarks.harness.white_noise_records import fly
from levid.benchmarks.identification.contenders import (
    CONTENDERS,
    Array,
    Complex,
    Contender,
    Declared,
    Flight,
)
from levid.identification.greybox.experiment import experiment_from_log
from levid.identification.nonparametric.robust_multisine import best_linear_approximation
from levid.identification.records.from_log import from_log
from levid.identification.records.periodic_records import periodic_record
from levid.log.reader import read_log
from levid.sim.true_response import frequency_response

RATE_HZ = 1000
BEAM_M = 0.1
BAND_HZ = (1.0, 64.0)
FREQ_HZ = np.unique(np.round(np.geomspace(*BAND_HZ, 100), 1))  # bins of spectra over 10 s
COMPARABLE, NO_WORSE = 2.0, 1.1
"""Errors up to this many times another count as comparable to it, or as no worse."""
ALIKE = "levid_subspace"
"""What the peers are compared with: it knows as little as they do."""
MEMORY_BYTES = 8_000_000_000
CAPTION = (
    "largest errors in dB and degrees, rms relative error; time from records to P, peak memory of "
    "the process; levid: how many times as fast is its fastest method that is no worse (in "
    "brackets: there is none, its most accurate one); *: own excitation, same time, at its lines"
)


@dataclass(frozen=True)
class Score:
    """Medians over the flights of one contender; `failed` says why there are none."""

    contender: Contender
    error_db: float = np.nan
    error_deg: float = np.nan
    error_percent: float = np.nan
    seconds: float = np.nan
    peak_mb: float = np.nan
    failed: str = ""


def main() -> None:
    options = parser("levid against its peers; --quick: one flight of 20 s an input")
    options.add_argument("--only", nargs="+", metavar="KEY", help="some of the contenders")
    arguments = options.parse_args()
    chosen = [c for c in CONTENDERS if arguments.only is None or c.key in arguments.only]
    if arguments.quick:
        seeds, duration_s, timeout_s = [1], 20.0, 60.0
    else:
        seeds, duration_s, timeout_s = [1, 2, 3], 60.0, 300.0
    scores: list[Score] = []

    def measured() -> list[Figure]:
        scores.extend(measure(chosen, seeds, duration_s, timeout_s))
        return told(scores)

    title = f"P's diagonal, 1 to 64 Hz, from 3 x {duration_s:g} s"
    show("levid against its peers", arguments, measured, lambda: [table(scores, title)])


def measure(
    contenders: Sequence[Contender], seeds: Sequence[int], duration_s: float, timeout_s: float
) -> list[Score]:
    """Return the scores of all contenders; they take turns on every flight."""
    outcomes: dict[str, list[Outcome]] = {c.key: [] for c in contenders}
    ratios: dict[str, list[Complex]] = {c.key: [] for c in contenders}
    for seed in seeds:
        flight = fly_all(duration_s, seed)
        for contender in contenders:
            known = outcomes[contender.key]
            if any(o.failed for o in known):
                continue
            freq_hz = lines(flight) if contender.takes == "multisines" else FREQ_HZ
            packages = [contender.package] if contender.package else []
            outcome = measure_apart(
                contender.identify, getattr(flight, contender.takes), freq_hz, packages=packages,
                timeout_s=timeout_s, memory_bytes=MEMORY_BYTES,
            )  # fmt: skip
            known.append(outcome)
            if not outcome.failed:
                true = frequency_response(truth(), BEAM_M, freq_hz, RATE_HZ)
                ratios[contender.key].append(diagonal(outcome.value) / diagonal(true))
    return [score(c, outcomes[c.key], ratios[c.key]) for c in contenders]


def fly_all(duration_s: float, seed: int) -> Flight:
    with tempfile.TemporaryDirectory() as folder:
        logs = fly(Path(folder) / "noise", RATE_HZ, [BEAM_M], duration_s, seed)
        read = [read_log(path) for path in logs]
        (log,) = fly_multisines(Path(folder) / "multisines", [BEAM_M], duration_s, seed)
        model = off_by_a_tenth(seed)
        return Flight(
            tuple(from_log(log) for log in read),
            Declared(tuple(experiment_from_log(log, model) for log in read), model, BEAM_M),
            periodic_record(read_log(log)),
        )


def lines(flight: Flight) -> Array:
    """Return the excited lines of the multisines within the band."""
    freq_hz = best_linear_approximation([flight.multisines]).freq_hz
    return freq_hz[(freq_hz >= BAND_HZ[0]) & (freq_hz <= BAND_HZ[1])]


def diagonal(P: Complex) -> Complex:
    return np.asarray(np.einsum("fii->fi", P))


def score(contender: Contender, outcomes: Sequence[Outcome], ratios: Sequence[Complex]) -> Score:
    """Return the medians over flights of the largest and the rms relative errors, and the cost."""
    for outcome in outcomes:
        if outcome.failed:
            return Score(contender, failed=outcome.failed)
    return Score(
        contender,
        _median([np.abs(20 * np.log10(np.abs(r))).max() for r in ratios]),
        _median([np.abs(np.angle(r, deg=True)).max() for r in ratios]),
        _median([100 * np.sqrt(np.mean(np.abs(r - 1) ** 2)) for r in ratios]),
        _median([o.seconds for o in outcomes]),
        _median([o.peak_bytes / 1e6 for o in outcomes]),
    )


def figures(scores: Sequence[Score]) -> dict[str, float]:
    """Return every number by name; of a contender that failed only failed_KEY = 1.

    diverged_KEY = 1 says that its P is no number somewhere in the band, or zero.
    """
    out: dict[str, float] = {}
    for s in scores:
        key = s.contender.key
        out[f"failed_{key}"] = float(bool(s.failed))
        if not s.failed:
            errors = (s.error_db, s.error_deg, s.error_percent)
            out[f"diverged_{key}"] = float(not np.all(np.isfinite(errors)))
            out[f"error_{key}_db"] = s.error_db
            out[f"error_{key}_deg"] = s.error_deg
            out[f"error_{key}_percent"] = s.error_percent
            out[f"time_{key}_s"] = s.seconds
            out[f"memory_{key}_mb"] = s.peak_mb
    ours = equals(scores)
    peers = [s for s in scores if not s.contender.is_levid and not s.failed]
    if ours and peers:
        least = min(s.error_percent for s in peers)
        out["lead_error"] = least / min(s.error_percent for s in ours)
        # Of like with like: a peer knows no declared model either.
        alike = next((s.error_percent for s in ours if s.contender.key == ALIKE), np.nan)
        out["lead_error_subspace"] = least / alike
        comparable = [s for s in peers if s.error_percent <= COMPARABLE * alike]
        leads = [time_lead(s, ours) for s in comparable]
        if leads:
            out["lead_time"] = min(leads)
    return {key: value for key, value in out.items() if np.isfinite(value)}


def told(scores: Sequence[Score]) -> list[Figure]:
    """Return all figures; those that say by how much levid leads have a label."""
    found = figures(scores)
    leads = [Figure(key, found.pop(key, None), "x", label) for key, label in _LEADS.items()]
    return [*leads, *(Figure(key, value, "", "") for key, value in found.items())]


_LEADS = {
    "lead_error": "least error of a peer over levid's least",
    "lead_error_subspace": "least error of a peer over that of levid's subspace method",
    "lead_time": "least lead in time over a peer of a comparable error",
}


def equals(scores: Sequence[Score]) -> list[Score]:
    """Return levid's own that saw the same records as the peers, and did not fail."""
    ours = [s for s in scores if s.contender.is_levid and s.contender.on_equal_data]
    return [s for s in ours if not s.failed]


def time_lead(peer: Score, ours: Sequence[Score]) -> float:
    """Return how many times as fast levid's fastest method is of those no worse than the peer.

    Where every one of levid's is worse, its most accurate one is compared.
    """
    enough = max(NO_WORSE * peer.error_percent, min(s.error_percent for s in ours))
    return peer.seconds / min(s.seconds for s in ours if s.error_percent <= enough)


def table(scores: Sequence[Score], title: str) -> Table:
    """Return the errors (largest in dB and degrees, rms in percent), the cost and levid's lead."""
    grid = Table(title=title, title_justify="left", box=box.SIMPLE, caption=CAPTION)
    grid.caption_justify = "left"
    grid.add_column("contender", no_wrap=True)
    for column in ("dB", "deg", "%", "s", "MB", "levid"):
        grid.add_column(column, justify="right", no_wrap=True)
    ours = equals(scores)
    for s in scores:
        if s.failed:
            grid.add_row(f"{s.contender.label}\n  failed: {s.failed}")
            continue
        lead = "" if s.contender.is_levid or not ours else f"{time_lead(s, ours):.2g} x"
        if lead and NO_WORSE * s.error_percent < min(o.error_percent for o in ours):
            lead = f"({lead})"
        numbers = f"{s.error_db:.3f}", f"{s.error_deg:.2f}", f"{s.error_percent:.3f}"
        grid.add_row(s.contender.label, *numbers, f"{s.seconds:.2f}", f"{s.peak_mb:.0f}", lead)
    return grid


def _median(values: Iterable[float]) -> float:
    return float(statistics.median(values))


if __name__ == "__main__":
    main()
