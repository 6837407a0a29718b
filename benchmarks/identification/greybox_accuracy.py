"""The grey-box fit against the simulator's parameters: errors, coverage of its intervals, time.

The fit starts from a model that is 10 % off and gets the logs only.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter

import numpy as np
from threadpoolctl import threadpool_limits

from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure
from levid.benchmarks.harness.inaccurate_model import off_by_a_tenth
from levid.benchmarks.identification.simulated_flight_and_truth import (
    BAND_HZ,
    diagonal_ratio,
    fly_white_noise,
    true_response,
    worst,
)
from levid.config.model import ModelConfig, load_model
from levid.config.shipped import shipped
from levid.identification.greybox.experiment.experiment_from_log import (
    Experiment,
    experiment_from_log,
)
from levid.identification.greybox.fit_in_loop import fit_in_loop
from levid.identification.greybox.identify_greybox import identify_grey_box
from levid.identification.records.record import IdentificationError
from levid.log.reader import read_log

BEAMS_M = (-0.1, 0.0, 0.1)
# Lag and delay change the response almost alike: the standard error of the lag is 0.4 % after nine
# minutes, and no estimator does better.
HARD = ("lag", "delay")


def measure(quick: bool) -> Iterator[Figure]:
    yield from accuracy(20.0 if quick else 60.0)
    yield from coverage(4 if quick else 100, 8.0)


def accuracy(duration_s: float) -> Iterator[Figure]:
    """Fit nine records and a moving beam; yield the errors of all parameters."""
    truth, start = load_model(shipped("models/rig.yaml")), off_by_a_tenth(1)
    experiments = flown(start, duration_s, 30.0, seed=1)
    begin = perf_counter()
    grey = identify_grey_box(start, experiments, 0.0)
    seconds = perf_counter() - begin
    errors = {n: abs(grey.fit.values[n] - truth.parameters[n].value) for n in grey.fit.free}
    in_se = max(error / grey.fit.standard_errors[name] for name, error in errors.items())
    rest = max(error / size_of(name, truth) for name, error in errors.items() if name not in HARD)
    lag_s = truth.parameters["lag"].value
    freq_hz = np.geomspace(*BAND_HZ, 100)
    found = [grey.response({"x_b": beam_m}, freq_hz) for beam_m in BEAMS_M]
    true = [true_response(beam_m, freq_hz, 1000.0) for beam_m in BEAMS_M]
    dB, degrees = worst([diagonal_ratio(*P) for P in zip(found, true, strict=True)])
    label = f"fit of {len(experiments)} records of {duration_s:g} s, the last of a beam sweep"
    yield Figure("fit_s", seconds, "s", label)
    yield Figure("worst_in_se", in_se, "SE", "largest parameter error")
    label = "largest parameter error except lag and delay (couplings: of the diagonal)"
    yield Figure("worst_percent", 100 * rest, "%", label)
    yield Figure("lag_percent", 100 * errors["lag"] / lag_s, "%", "error of the lag")
    yield Figure("response_db", dB, "dB", "largest error of P's diagonal, 1 to 64 Hz")
    yield Figure("response_deg", degrees, "deg", "phase")


def coverage(seeds: int, duration_s: float) -> Iterator[Figure]:
    """Yield how often 95 % intervals contain the truth, all parameters, and the rms error.

    A flight or fit that fails is a miss of all its parameters.
    """
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        task = partial(errors_in_se, duration_s=duration_s)
        flights = list(pool.map(task, range(100, 100 + seeds)))
    z = [value for flight in flights for value in flight]
    inside = sum(abs(value) < 1.96 for value in z) / max(seeds * max(map(len, flights)), 1)
    spread = math.sqrt(np.mean(np.square(z))) if z else None
    failed = sum(not flight for flight in flights)
    yield Figure("coverage_seeds", seeds, "", f"flights of nine records of {duration_s:g} s")
    yield Figure("coverage_percent", 100 * inside, "%", "of 95 % intervals contain the truth")
    yield Figure("coverage_failed", failed, "", "of them without a fit, counted as misses")
    yield Figure("spread", spread, "SE", "rms error of the others (1: the Cramer-Rao bound)")


def errors_in_se(seed: int, duration_s: float) -> list[float]:
    """Return each parameter's error in standard errors for a flight; empty if the fit fails."""
    truth, start = load_model(shipped("models/rig.yaml")), off_by_a_tenth(seed)
    try:
        with threadpool_limits(1):
            fit, _ = fit_in_loop(start, flown(start, duration_s, 12.0, seed), (), None)
    except IdentificationError as error:
        print(f"seed {seed}: {error}", file=sys.stderr)
        return []
    return [
        float(fit.values[name] - truth.parameters[name].value) / fit.standard_errors[name]
        for name in fit.free
    ]


def flown(start: ModelConfig, duration_s: float, sweep_s: float, seed: int) -> list[Experiment]:
    """Fly white noise at each input at three beam positions, and a beam sweep."""
    with tempfile.TemporaryDirectory() as folder:
        logs = fly_white_noise(Path(folder), 1000, BEAMS_M, duration_s, seed, sweep_s)
        return [experiment_from_log(read_log(path), start) for path in logs]


def size_of(name: str, truth: ModelConfig) -> float:
    """Return the unit of a relative error: the value; for couplings sqrt(K_ii K_jj), M alike."""
    v = {key: p.value for key, p in truth.parameters.items()}
    tilt = v["m_b"] * v["z_b"] ** 2
    return {
        "k_psitheta": math.sqrt(v["k_psi"] * v["k_theta"]),
        "k_psiz": math.sqrt(v["k_psi"] * v["k_z"]),
        "k_thetaz": math.sqrt(v["k_theta"] * v["k_z"]),
        "J_psitheta": math.sqrt((v["J_psi"] + tilt) * (v["J_theta"] + tilt)),
        "delay": v["lag"],
    }.get(name, abs(v[name]))


if __name__ == "__main__":
    benchmark_runner.run("The grey-box fit", measure)
