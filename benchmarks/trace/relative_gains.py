"""Calibrate the gains of all coils and sensors, relative to their means, in simulated flights.

Each flight of config/sessions/gains.yaml has coils that differ by 3 % and sensors that differ by
2 % (standard deviations), and a declared model that is 10 % off. The trace starts from
config/models/rig-gains.yaml. Half of the plants have a cubic stiffness beside that no model
declares.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.benchmarks.harness.inaccurate_model import off_by_a_tenth
from levid.benchmarks.harness.virtual_flight import fly_session
from levid.benchmarks.trace.hidden_effect_flight import rig
from levid.config.base import read_mapping
from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.subspace.response_uncertainty import SURE_95
from levid.identification.trace.run_trace import trace
from levid.identification.trace.worker_pool import local_workers
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects

COIL_SD, SENSOR_SD = 0.03, 0.02
CUBIC = {"use": "levid.sim.effects.stiffness:CubicRods", "dof": "z", "k3_n_m3": 3e8}


def main() -> None:
    """Fly, trace and print the figures."""
    options = parser("Calibration of the gains of coils and sensors; --quick: one plant")
    options.add_argument("--seeds", type=int, default=6)
    options.add_argument("--first-seed", type=int, default=620_000)
    arguments = options.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    some = seeds[:1] if arguments.quick else seeds
    show("Relative gains", arguments, lambda: measure(list(some)))


def measure(seeds: list[int]) -> Iterator[Figure]:
    """Yield errors of the gains, coverage of their intervals, and what was named beside them."""
    off: dict[str, list[float]] = {"coil": [], "sensor": []}
    width: dict[str, list[float]] = {"coil": [], "sensor": []}
    inside: list[bool] = []
    found_cubic, others = 0, 0
    for seed in seeds:
        cubic = seed % 2 == 1
        placed, truth = fly_and_trace(seed, cubic)
        for effect in placed:
            kind = effect.effect.key.partition("_")[0]
            if effect.effect.key.endswith(".relative"):
                found = np.array(effect.amplitudes)
                errors = np.array(
                    [effect.standard_errors[q.name] for q in effect.effect.amplitudes]
                )
                off[kind] += list(np.abs(found - truth[kind][:-1]))
                width[kind] += list(SURE_95 * errors)
                inside += list(np.abs(found - truth[kind][:-1]) < SURE_95 * errors)
        named = [p.effect.identity for p in placed if not p.effect.key.endswith(".relative")]
        found_cubic += cubic and "rod_stiffness.cubic@z" in named
        others += len(named) - (cubic and "rod_stiffness.cubic@z" in named)
        print(f"seed {seed}: beside the gains: {', '.join(named) or 'nothing'}", file=sys.stderr)
    for kind, errors_of in off.items():
        yield Figure(f"{kind}_error", float(np.sqrt(np.mean(np.square(errors_of)))), "",
                     f"{kind} gains, RMS error")  # fmt: skip
        yield Figure(f"{kind}_interval", float(np.median(width[kind])), "",
                     f"{kind} gains, half width of 95 % intervals, median")  # fmt: skip
    label = f"intervals with the truth (of {len(inside)})"
    share = 100.0 * float(np.mean(inside))
    yield Figure("coverage_percent", share, "%", label, target=Target(least=90.0))
    count = sum(seed % 2 for seed in seeds)
    yield Figure("cubic", found_cubic, "", f"cubic stiffness found (of {count})",
                 target=Target(least=float(count)))  # fmt: skip
    yield Figure("others", others, "", "other names", target=Target(most=0.0))


def fly_and_trace(seed: int, cubic: bool) -> tuple[tuple[Placed, ...], dict[str, Any]]:
    """Return the effects of the traced model, and the true relative gains of coils and sensors."""
    rng = np.random.default_rng(seed)
    coils, sensors = COIL_SD * rng.standard_normal(9), SENSOR_SD * rng.standard_normal(9)
    effects: list[dict[str, Any]] = [
        {"use": "levid.sim.effects.coils:CoilGain", "coil": i, "excess": float(e)}
        for i, e in enumerate(coils)
    ]
    effects += [
        {"use": "levid.sim.effects.sensors:SensorGain", "sensor": i, "excess": float(e)}
        for i, e in enumerate(sensors)
    ]
    effects += [CUBIC] * cubic
    truth = {
        kind: (e - e.mean()) / (1.0 + e.mean())
        for kind, e in (("coil", coils), ("sensor", sensors))
    }
    gains = load_model(shipped("models/rig-gains.yaml"))
    config = gains.model_copy(update={"parameters": off_by_a_tenth(seed).parameters})
    session = {**read_mapping(shipped("sessions/gains.yaml")), "seed": seed}
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        logs = fly_session(session, Path(folder), effects, rig())
        with local_workers(config) as workers:
            found = trace(logs, config, all_effects, workers, lambda *_: None)
    return found.found.point.placed, truth


if __name__ == "__main__":
    main()
