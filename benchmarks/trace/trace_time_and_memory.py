"""The cost of a trace: time, its growth with the data, and memory.

Twelve records of 60 s at 1 kHz (three of 24 s with --quick) of a plant with two undeclared effects
are traced: a quarter, half and all of them, with a process per core; the declared model is 10 %
off.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from levid.benchmarks.harness.benchmark_runner import Figure, Target, run
from levid.benchmarks.harness.child_measurement import measure_apart
from levid.benchmarks.harness.inaccurate_model import off_by_a_tenth
from levid.benchmarks.harness.virtual_flight import fly_session
from levid.benchmarks.trace.hidden_effect_flight import rig
from levid.config.base import read_mapping
from levid.config.shipped import shipped
from levid.identification.trace.residual.free_run_error import pooled
from levid.identification.trace.run_trace import trace
from levid.identification.trace.worker_pool import local_workers
from levid.model.effects.candidate_effects import all_effects

EFFECTS = {
    "rod_stiffness.cubic@z": {
        "use": "levid.sim.effects.stiffness:CubicRods", "dof": "z", "k3_n_m3": 5e8
    },
    "coil_gain@coil:3": {"use": "levid.sim.effects.coils:CoilGain", "coil": 3, "excess": 0.05},
}  # fmt: skip
"""The undeclared effects by their identity in the table of effects."""
MEMORY_BYTES, TIMEOUT_S = 16_000_000_000, 1800.0
WRENCH = ["psi", "theta", "z"]
SECONDS, GROWTH = Target(most=120.0), Target(most=1.15)
"""For all twelve records. In proportion to the data is 1; the rest allows for a busy machine."""


def measure(quick: bool) -> Iterator[Figure]:
    yield Figure("cores", os.cpu_count() or 1, "", "cores, and processes of a trace")
    duration_s, seconds = 24.0 if quick else 60.0, {}
    with tempfile.TemporaryDirectory() as folder:
        logs = fly_session(session(duration_s, quick), Path(folder), list(EFFECTS.values()), rig())
        for name, part in {"all": 1, **({} if quick else {"half": 2, "quarter": 4})}.items():
            some = logs[: len(logs) // part]
            outcome = measure_apart(found_in, some, timeout_s=TIMEOUT_S, memory_bytes=MEMORY_BYTES)
            if outcome.failed:
                raise SystemExit(f"failed: {outcome.failed}")
            placed, before, after = outcome.value
            seconds[len(some)] = outcome.seconds
            target = SECONDS if name == "all" and not quick else None
            label = f"trace of {len(some)} records of {duration_s:g} s"
            yield Figure(f"{name}_s", outcome.seconds, "s", label, target=target)
            yield Figure(f"{name}_gb", outcome.peak_bytes / 1e9, "GB", "largest process")
            flown = len({*placed} & {*EFFECTS})
            yield Figure(f"{name}_flown", flown, "", f"of {len(EFFECTS)} effects flown are found")
            yield Figure(f"{name}_others", len(placed) - flown, "", "effects found beside them")
            yield Figure(f"{name}_before", before, "x floor", "error of the declared model")
            yield Figure(f"{name}_after", after, "x floor", "error of the model with effects")
    if not quick:
        # The exponent of the number of records that the time is proportional to.
        growth = np.polyfit(np.log(list(seconds)), np.log(list(seconds.values())), 1)[0]
        label = "time grows with the data to the power of"
        yield Figure("growth", float(growth), "", label, target=GROWTH)


def found_in(logs: Sequence[Path]) -> tuple[tuple[str, ...], float, float]:
    """Return the effects that a trace finds, and the error over the floor before and after."""
    config = off_by_a_tenth(1)
    with local_workers(config) as workers:
        found = trace(logs, config, all_effects, workers, lambda *_: None)
    (before, _), (after, floor) = pooled(found.before), pooled(found.after)
    placed = tuple(p.effect.identity for p in found.found.point.placed)
    return placed, before / floor, after / floor


def session(duration_s: float, quick: bool) -> dict[str, object]:
    """Return a session of records of one length, with each kind of record in both halves."""

    def wrench(beam_m: float, scale: float) -> list[dict[str, object]]:
        record = {"excite": WRENCH, "each_s": duration_s / 3, "scale": scale}
        return [{"move": {"beam_m": beam_m}}, {"record": record}]

    def coils(first: int, scale: float) -> dict[str, object]:
        # Whole periods of 4 s: 60 s are 15, five coils have three each.
        names = [f"coil-{i}" for i in range(first, first + 5)]
        return {"record": {"excite": names, "each_s": 12.0, "scale": scale}}

    back_and_forth = [
        {"to_m": to_m, "velocity_m_s": speed, "acceleration_m_s2": 2.0, "dwell_s": 0.5}
        for speed in (0.05, 0.1, 0.2, 0.3)
        for to_m in (0.1, -0.1)
    ]
    sweep = {"duration_s": duration_s, "beam": back_and_forth}
    steps = [{"record": {"duration_s": duration_s}}, *wrench(-0.1, 1.0), *wrench(0.0, 0.5)]
    if not quick:
        steps += [{"record": sweep}, coils(0, 1.0), coils(4, 0.5), *wrench(0.1, 0.5)]
        steps += [*wrench(0.0, 1.0), {"record": {**sweep, "excite": WRENCH, "scale": 0.5}}]
        steps += [coils(4, 1.0), coils(0, 0.5), *wrench(-0.1, 0.5)]
    for number, step in enumerate(steps):
        if "record" in step:
            step["record"] = {"name": f"record-{number}", **step["record"]}
    return {
        **read_mapping(shipped("sessions/trace.yaml")),
        "name": "trace-time",
        "seed": 1,
        "steps": [{"levitate": {}}, *steps, {"move": {"beam_m": 0.0}}, {"land": {}}],
        "then": [],
    }


if __name__ == "__main__":
    run("The cost of a trace", measure)
