"""A trace from logs to proof: how long it takes, how that grows with the data, and its memory.

Flies twelve records of 60 s at 1 kHz (three of 24 s with --quick) of a plant with two effects that
nobody declared, and traces half of them and all of them, with a process a core.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from _flight import fly_session
from _isolated import Outcome, measure_apart
from _table import Figure, run

from levid.config.base import read_mapping
from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.trace.metric import pooled
from levid.identification.trace.study import trace
from levid.identification.trace.workers import local_workers
from levid.model.effects.table import all_effects

EFFECTS = (
    {"use": "levid.sim.effects.stiffness:CubicRods", "dof": "z", "k3_n_m3": 5e8},
    {"use": "levid.sim.effects.coils:CoilGain", "coil": 3, "excess": 0.05},
)
MEMORY_BYTES, TIMEOUT_S = 16_000_000_000, 1800.0
WRENCH = ["psi", "theta", "z"]
COILS = [f"coil-{i}" for i in range(9)]


def measure(quick: bool) -> Sequence[Figure]:
    duration_s = 24.0 if quick else 60.0
    with tempfile.TemporaryDirectory() as folder:
        logs = fly_session(_session(duration_s, quick), Path(folder), EFFECTS)
        sets = {"all": logs} if quick else {"half": logs[:6], "all": logs}
        found = {name: _apart(some) for name, some in sets.items()}
    figures = []
    for name, outcome in found.items():
        rounds, effects, before, after, floor = outcome.value
        what = f"{len(sets[name])} records of {duration_s:g} s"
        figures += [
            Figure(f"{name}_s", outcome.seconds, "s", f"trace of {what}"),
            Figure(f"{name}_effects", effects, "", "effects found (2 are there)"),
            Figure(f"{name}_rounds", rounds, "", "rounds of the search"),
            Figure(f"{name}_before", before / floor, "x floor", "error of the declared model"),
            Figure(f"{name}_after", after / floor, "x floor", "error of the model with effects"),
            Figure(f"{name}_gb", outcome.peak_bytes / 1e9, "GB", "largest process"),
        ]
    if not quick:
        figures.append(Figure("growth", figures[6].value, "s", "time for twice the data", "half_s"))
    return figures


def to_effects(logs: Sequence[Path]) -> tuple[int, int, float, float, float]:
    """Return rounds, effects, error before and after, and floor of a trace.

    Its progress is not told: what is measured is what `levid trace` does before its report.
    """
    config = load_model(shipped("models/rig.yaml"))
    with local_workers(config) as workers:
        found = trace(logs, config, all_effects, workers, lambda *_: None)
    (before, _), (after, floor) = pooled(found.before), pooled(found.after)
    return len(found.found.rounds), len(found.found.point.placed), before, after, floor


def _apart(logs: Sequence[Path]) -> Outcome:
    outcome = measure_apart(to_effects, logs, timeout_s=TIMEOUT_S, memory_bytes=MEMORY_BYTES)
    if outcome.failed:
        raise SystemExit(f"failed: {outcome.failed}")
    return outcome


def _session(duration_s: float, quick: bool) -> dict[str, object]:
    """Return a session of records of one length, every kind of record in either half."""
    each_s = duration_s / 3
    back_and_forth = [
        {"to_m": to_m, "velocity_m_s": speed, "acceleration_m_s2": 2.0, "dwell_s": 0.5}
        for speed in (0.05, 0.1, 0.2, 0.3)
        for to_m in (0.1, -0.1)
    ]
    moving = {"duration_s": duration_s, "beam": back_and_forth}

    def wrench(name: str, beam_m: float, scale: float) -> list[dict[str, object]]:
        record = {"name": name, "excite": WRENCH, "each_s": each_s, "scale": scale}
        return [{"move": {"beam_m": beam_m}}, {"record": record}]

    def coils(name: str, some: Sequence[str], scale: float) -> dict[str, object]:
        # Whole periods of 4 s: 60 s are 15, five coils have three each.
        return {"record": {"name": name, "excite": list(some), "each_s": 12.0, "scale": scale}}

    still = {"record": {"name": "still", "duration_s": duration_s}}
    if quick:
        steps = [still, *wrench("left", -0.1, 1.0), *wrench("middle", 0.0, 0.5)]
    else:
        steps = [
            still,
            *wrench("left-full", -0.1, 1.0),
            *wrench("middle-half", 0.0, 0.5),
            {"record": {"name": "sweep", **moving}},
            coils("coils-a-full", COILS[:5], 1.0),
            coils("coils-b-half", COILS[4:], 0.5),
            *wrench("right-half", 0.1, 0.5),
            *wrench("middle-full", 0.0, 1.0),
            {"record": {"name": "sweep-excited", "excite": WRENCH, "scale": 0.5, **moving}},
            coils("coils-b-full", COILS[4:], 1.0),
            coils("coils-a-half", COILS[:5], 0.5),
            *wrench("left-half", -0.1, 0.5),
        ]
    return {
        **read_mapping(shipped("sessions/trace.yaml")),
        "name": "trace-time",
        "seed": 1,
        "steps": [{"levitate": {}}, *steps, {"move": {"beam_m": 0.0}}, {"land": {}}],
        "then": [],
    }


if __name__ == "__main__":
    run("Trace", measure)
