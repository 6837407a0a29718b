"""The grey-box fit against the simulator's parameters: errors, coverage of its intervals, time.

The fit starts from a model that is 10 % off and gets the logs only. If the Silverbox data are at
hand, its linear model is fitted to the training part and judged by the simulated test error.
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

from levid.benchmarks.harness import silverbox as silverbox_data
from levid.benchmarks.harness import table
from levid.benchmarks.harness.declared_model import off_by_a_tenth
from levid.benchmarks.harness.table import Figure
from levid.benchmarks.identification.known_plant import (
    BAND_HZ,
    diagonal_ratio,
    fly_white_noise,
    true_response,
    worst,
)
from levid.config.model import ModelConfig, load_model
from levid.config.shipped import shipped
from levid.identification.greybox.discretisation import innovations, motion
from levid.identification.greybox.experiment import Experiment, experiment_from_log
from levid.identification.greybox.fit import fit_model
from levid.identification.greybox.identify_greybox import identify_grey_box
from levid.identification.greybox.prediction_errors import settled
from levid.identification.records.record import IdentificationError
from levid.log.reader import read_log

BEAMS_M = (-0.1, 0.0, 0.1)
# Lag and delay change the response almost alike: the standard error of the lag is 0.4 % after nine
# minutes, and no estimator does better.
HARD = ("lag", "delay")


def measure(quick: bool) -> Iterator[Figure]:
    yield from accuracy(20.0 if quick else 60.0)
    yield from coverage(4 if quick else 100, 8.0)
    yield from silverbox()


def accuracy(duration_s: float) -> Iterator[Figure]:
    """Fit nine records and a moving beam; yield the errors of all parameters."""
    truth, start = load_model(shipped("models/rig.yaml")), off_by_a_tenth(1)
    experiments = flown(start, duration_s, 30.0, seed=1)
    begin = perf_counter()
    grey = identify_grey_box(start, experiments, 0.0)
    seconds = perf_counter() - begin
    still = fit_model(start, [e for e in experiments if not e.moving])
    errors = {n: abs(grey.fit.values[n] - truth.parameters[n].value) for n in grey.fit.free}
    relative = {name: error / size_of(name, truth) for name, error in errors.items()}
    in_se = max(error / grey.fit.standard_errors[name] for name, error in errors.items())
    rest = max(error for name, error in relative.items() if name not in HARD)
    lag_se = grey.fit.standard_errors["lag"] / truth.parameters["lag"].value
    freq_hz = np.geomspace(*BAND_HZ, 100)
    dB, degrees = worst(
        [
            diagonal_ratio(grey.response({"x_b": x}, freq_hz), true_response(x, freq_hz, 1000.0))
            for x in BEAMS_M
        ]
    )
    reported = "z_b" in {lost.name for lost in still.unidentifiable}
    label = f"records of {duration_s:g} s, the last of a beam sweep"
    yield Figure("records", len(experiments), "", label)
    yield Figure("fit_s", seconds, "s", "fit of all parameters to all records")
    yield Figure("worst_in_se", in_se, "SE", "largest parameter error")
    label = "largest parameter error except lag and delay (couplings: of the diagonal)"
    yield Figure("worst_percent", 100 * rest, "%", label)
    yield Figure("lag_percent", 100 * relative["lag"], "%", "error of the lag")
    yield Figure("lag_se_percent", 100 * lag_se, "%", "standard error of the lag")
    yield Figure("response_db", dB, "dB", "largest error of P's diagonal, 1 to 64 Hz")
    yield Figure("response_deg", degrees, "deg", "phase")
    label = "without a moving beam, z_b is reported as unidentifiable"
    yield Figure("z_b_unidentifiable", float(reported), "", label)


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
            fit = fit_model(start, flown(start, duration_s, 12.0, seed))
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


def silverbox() -> Iterator[Figure]:
    """Fit the training part and simulate the test multisine; yield None without the data."""
    config = load_model(silverbox_data.MODEL)
    for hold in ("band_limited", "zoh"):
        held = config.model_copy(update={"input": hold})
        rms = simulated_error(held) if silverbox_data.SOURCE.exists() else None
        mv = None if rms is None else 1e3 * rms
        yield Figure(f"silverbox_{hold}_mv", mv, "mV", f"Silverbox, test multisine, {hold}")


def simulated_error(model: ModelConfig) -> float:
    """Return the rms error in V of a simulation of the Silverbox's test part."""
    with tempfile.TemporaryDirectory() as folder:
        train, test = (
            experiment_from_log(read_log(silverbox_data.imported(rows, Path(folder))), model)
            for rows in (silverbox_data.TRAIN, silverbox_data.TEST)
        )
    fit = fit_model(model, [train])
    at = settled(motion(fit.model, test, model.input), fit.predictions[0].offset)
    error = test.y + innovations(at, np.zeros((1, 2, 1)), np.zeros_like(test.y), np.zeros(2))
    return float(np.sqrt(np.mean(error[silverbox_data.FIRST_ROWS :] ** 2)))


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
    table.run("The grey-box fit", measure)
