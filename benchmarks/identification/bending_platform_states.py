"""Identify platforms that bend, and rigid ones, without a declared model: states, and intervals.

The eighty platforms of bending_platform_identification.py, each at one beam position: the order
that the evidence finds, and how often the 95 % interval of the response's magnitude holds the true
one from 1 to 100 Hz. Of a bearing that slips the true response is that of small motions; records of
a larger motion find another one, by 0.01 to 0.04 %, which is more than their noise.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter

import numpy as np
from threadpoolctl import threadpool_limits

from levid.benchmarks.harness.benchmark_runner import Figure, Target, run
from levid.benchmarks.identification.bending_platform import (
    KI,
    KP,
    NOMINAL,
    G,
    Platform,
    drawn,
    flights,
)
from levid.identification.records.record import PiController, Record
from levid.identification.subspace.plant_by_spectra import plant_by_spectra
from levid.identification.subspace.response_uncertainty import SURE_95, response_with_errors

PLANTS, QUICK = 40, 2
BEAMS_M = (-0.1, 0.0, 0.1)
FREQ_HZ = np.geomspace(1.0, 100.0, 100)
RIGID_STATES = 6


@dataclass(frozen=True)
class Outcome:
    """What one plant gave: states, and shares of frequencies with the truth in the interval."""

    seed: int
    bends: bool
    true_states: int
    found_states: int
    doubtful: tuple[int, ...]
    covered: list[list[float]]
    white: bool
    seconds: float


def measure(quick: bool) -> Iterator[Figure]:
    """Yield the figures of all plants."""
    plants = QUICK if quick else PLANTS
    tasks = [(seed, bends) for bends in (True, False) for seed in range(plants)]
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        found = list(pool.map(_identified, tasks))
    Path("build").mkdir(exist_ok=True)
    Path("build/bending_platform_states.json").write_text(
        json.dumps([asdict(o) for o in found], indent=1)
    )
    right = sum(o.true_states == o.found_states for o in found)
    yield Figure(
        "orders", right, "", f"right order, of {len(found)}", target=Target(least=0.9 * len(found))
    )
    yield Figure("doubtful", sum(bool(o.doubtful) for o in found), "", "order stated as uncertain")
    for name, some in {
        "all": found,
        "bending": [o for o in found if o.bends],
        "rigid": [o for o in found if not o.bends],
    }.items():
        shares = np.array([o.covered for o in some])
        target = Target(least=90.0) if name == "all" else Target()
        what = f"{name}: frequencies with the truth in the 95 % interval"
        yield Figure(f"{name}_covered", 100.0 * shares.mean(), "%", what, target=target)
        diagonal = 100.0 * np.einsum("kii->ki", shares).mean(axis=0)
        for axis, share in zip(("psi", "theta", "z"), diagonal, strict=True):
            yield Figure(f"{name}_covered_{axis}", share, "%", f"{name}: of {axis} to {axis}")
    yield Figure("seconds", float(np.median([o.seconds for o in found])), "s", "median time")


def records_of(platform: Platform, seed: int, excitation: str, x_b_m: float) -> list[Record]:
    """Return the records of one beam position."""
    force = G * np.array([0.0, NOMINAL["m_b"] * x_b_m, NOMINAL["m_p"] + NOMINAL["m_b"]])
    found = []
    for e in flights(platform, seed, excitation, beams_m=[x_b_m]):
        assert e.loop is not None
        found.append(
            Record(
                e.name, e.Ts_s, e.loop.v, e.y, ("tau_psi", "tau_theta", "f_z"),
                ("N m", "N m", "N"), ("psi", "theta", "z"), ("rad", "rad", "m"), u=e.u - force,
                beam_m=x_b_m, controller=PiController(KP, KI), delay_cycles=1, at_rest=True,
            )
        )  # fmt: skip
    return found


def _identified(task: tuple[int, bool]) -> Outcome:
    seed, bends = task
    platform = drawn(seed) if bends else Platform()
    x_b_m = BEAMS_M[seed % 3]
    records = records_of(platform, seed, "noise" if seed % 2 == 0 else "multisine", x_b_m)
    lag_pole = float(np.exp(-records[0].Ts_s / NOMINAL["lag"]))
    begin = perf_counter()
    with threadpool_limits(1):
        found = plant_by_spectra(records, None, lag_pole, RIGID_STATES)
    seconds = perf_counter() - begin
    P = response_with_errors(found.plant, found.covariance, FREQ_HZ)
    true = platform.sampled_response(x_b_m, FREQ_HZ, records[0].Ts_s)
    inside = np.abs(np.abs(P.H) - np.abs(true)) < SURE_95 * P.magnitude_deviation
    return Outcome(
        seed, bends, RIGID_STATES + 2 * (len(platform.modes) + (platform.bearing is not None)),
        found.order, found.doubtful_orders, inside.mean(axis=0).tolist(), found.white, seconds,
    )  # fmt: skip


if __name__ == "__main__":
    run("Bending platforms without a declared model", measure)
