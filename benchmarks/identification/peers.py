"""levid against other packages on the same records: error, time and memory of the identified plant.

White noise is flown at each input in turn, with the beam off the middle, so that theta and z
couple. Each contender (contenders.py) identifies P from these logs in a process of its own. The
multisine method gets multisines, flown for the same time. Medians over several flights. `pip
install 'levid[peers]'` installs the other packages; the table reports those that are missing or
fail.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from levid.benchmarks.harness.declared_model import off_by_a_tenth
from levid.benchmarks.harness.isolated import Outcome, measure_apart
from levid.benchmarks.harness.table import Figure, run
from levid.benchmarks.identification.contenders import CONTENDERS, Contender, Declared, Flight
from levid.benchmarks.identification.known_plant import (
    BAND_HZ,
    Array,
    Complex,
    diagonal_ratio,
    fly_multisines,
    fly_white_noise,
    true_response,
    worst,
)
from levid.identification.greybox.experiment import experiment_from_log
from levid.identification.nonparametric.robust_multisine import best_linear_approximation
from levid.identification.records.from_log import from_log
from levid.identification.records.periodic_records import periodic_record
from levid.log.reader import read_log

RATE_HZ = 1000
BEAM_M = 0.1
FREQ_HZ = np.unique(np.round(np.geomspace(*BAND_HZ, 100), 1))  # bins of spectra over 10 s
COMPARABLE, NO_WORSE = 2.0, 1.1
"""Errors up to this many times another are comparable to it, or no worse."""
ALIKE = "levid_subspace"
"""The peers are compared with this one: it knows no declared model either."""
MEMORY_BYTES = 8_000_000_000


@dataclass(frozen=True)
class Score:
    """Medians over the flights of one contender; `failed` is the reason if there are none.

    error_db and error_deg are the largest of P's diagonal, error_percent is the rms of both.
    """

    contender: Contender
    error_db: float = np.nan
    error_deg: float = np.nan
    error_percent: float = np.nan
    seconds: float = np.nan
    peak_mb: float = np.nan
    failed: str = ""


def measure(quick: bool) -> Iterator[Figure]:
    seeds, duration_s, timeout_s = ([1], 20.0, 60.0) if quick else ([1, 2, 3], 60.0, 300.0)
    yield from figures(scores(seeds, duration_s, timeout_s))


def scores(seeds: Sequence[int], duration_s: float, timeout_s: float) -> list[Score]:
    """Return the scores of all contenders; they take turns on each flight."""
    outcomes: dict[str, list[Outcome]] = {c.key: [] for c in CONTENDERS}
    ratios: dict[str, list[Complex]] = {c.key: [] for c in CONTENDERS}
    for seed in seeds:
        flight = fly(duration_s, seed)
        for contender in CONTENDERS:
            known = outcomes[contender.key]
            if any(o.failed for o in known):
                continue
            freq_hz = lines(flight) if contender.takes == "multisines" else FREQ_HZ
            outcome = measure_apart(
                contender.identify, getattr(flight, contender.takes), freq_hz,
                packages=[contender.package] if contender.package else [],
                timeout_s=timeout_s, memory_bytes=MEMORY_BYTES,
            )  # fmt: skip
            known.append(outcome)
            if not outcome.failed:
                true = true_response(BEAM_M, freq_hz, RATE_HZ)
                ratios[contender.key].append(diagonal_ratio(outcome.value, true))
    return [score(c, outcomes[c.key], ratios[c.key]) for c in CONTENDERS]


def fly(duration_s: float, seed: int) -> Flight:
    """Fly white noise and multisines at BEAM_M; the declared model is 10 % off."""
    with tempfile.TemporaryDirectory() as folder:
        logs = fly_white_noise(Path(folder, "noise"), RATE_HZ, [BEAM_M], duration_s, seed)
        read = [read_log(path) for path in logs]
        (log,) = fly_multisines(Path(folder, "multisines"), [BEAM_M], duration_s, seed)
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


def score(contender: Contender, outcomes: Sequence[Outcome], ratios: Sequence[Complex]) -> Score:
    """Return the medians over flights of the errors and the cost."""
    for outcome in outcomes:
        if outcome.failed:
            return Score(contender, failed=outcome.failed)
    errors = [worst([ratio]) for ratio in ratios]
    percent = [100 * float(np.sqrt(np.mean(np.abs(r - 1) ** 2))) for r in ratios]
    return Score(
        contender,
        statistics.median(dB for dB, _ in errors),
        statistics.median(degrees for _, degrees in errors),
        statistics.median(percent),
        statistics.median(o.seconds for o in outcomes),
        statistics.median(o.peak_bytes / 1e6 for o in outcomes),
    )


def figures(scores: Sequence[Score]) -> Iterator[Figure]:
    """Yield levid's leads, then all errors and costs; None if a contender failed or diverged."""
    ours = equals(scores)
    # A response that is not finite or zero somewhere in the band is no result.
    peers = [s for s in scores if not s.contender.is_levid and np.isfinite(s.error_db)]
    least = min((s.error_percent for s in peers), default=None)
    alike = next((s.error_percent for s in ours if s.contender.key == ALIKE), None)
    lead = least and ours and least / min(s.error_percent for s in ours)
    yield Figure("lead_error", lead or None, "x", "least error of a peer over levid's least")
    lead = least and alike and least / alike
    label = "least error of a peer over that of levid's subspace method"
    yield Figure("lead_error_subspace", lead, "x", label)
    leads = [time_lead(s, ours) for s in peers if alike and s.error_percent <= COMPARABLE * alike]
    label = "least lead in time over a peer of a comparable error"
    yield Figure("lead_time", min(leads, default=None), "x", label)
    for s in scores:
        key, label = s.contender.key, s.contender.label
        for name, value, unit, what in (
            (f"error_{key}_percent", s.error_percent, "%", s.failed or "rms error"),
            (f"error_{key}_db", s.error_db, "dB", "largest error"),
            (f"error_{key}_deg", s.error_deg, "deg", "phase"),
            (f"time_{key}_s", s.seconds, "s", "from records to P"),
            (f"memory_{key}_mb", s.peak_mb, "MB", "peak memory"),
        ):
            finite = value if np.isfinite(value) else None
            shown = what in (s.failed, "rms error", "from records to P")
            yield Figure(name, finite, unit, f"{label}: {what}" if shown else "")


def equals(scores: Sequence[Score]) -> list[Score]:
    """Return levid's methods that used the same records as the peers and did not fail."""
    return [
        s
        for s in scores
        if s.contender.is_levid and s.contender.takes != "multisines" and np.isfinite(s.error_db)
    ]


def time_lead(peer: Score, ours: Sequence[Score]) -> float:
    """Return the peer's time over that of levid's fastest method that is no worse.

    If all of levid's are worse, its most accurate one is compared.
    """
    enough = max(NO_WORSE * peer.error_percent, min(s.error_percent for s in ours))
    return peer.seconds / min(s.seconds for s in ours if s.error_percent <= enough)


if __name__ == "__main__":
    run("levid against its peers, P's diagonal", measure)
