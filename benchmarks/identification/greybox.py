"""The grey-box fit against the simulator's truth: errors, coverage of its intervals, time.

The records are flown anew for every seed; the fit starts from a model file that is off by 10 % and
sees the logs alone. The Silverbox (measured data) is judged by its simulated error where
its files are given.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter

import numpy as np
from threadpoolctl import threadpool_limits

from levid.benchmarks.harness import silverbox as silverbox_data
from levid.benchmarks.harness import table, virtual_flight
from levid.benchmarks.harness.code_version import FLYING, code_version
from levid.benchmarks.harness.declared_model import off_by_a_tenth
from levid.benchmarks.harness.table import Figure
from levid.benchmarks.harness.virtual_flight import fly_session
from levid.config.base import load_yaml
from levid.config.model import ModelConfig, load_model
from levid.config.shipped import shipped
from levid.config.sim import SimConfig
from levid.identification.greybox.discretisation import innovations, motion
from levid.identification.greybox.experiment import experiment_from_log
from levid.identification.greybox.fit import Fit, fit_model
from levid.identification.greybox.identify_greybox import identify_grey_box
from levid.identification.greybox.prediction_errors import settled
from levid.identification.records.record import IdentificationError
from levid.log.reader import read_log
from levid.sim.true_response import frequency_response

KEPT = Path(__file__).resolve().parents[2] / "build" / "greybox"
# Lag and delay move the response almost alike: what a record can tell of either is in its standard
# error, some 0.4 % of the lag after nine minutes, and no estimator does better.
HARD = ("lag", "delay")


def measure(quick: bool) -> list[Figure]:
    figures = accuracy(20.0 if quick else 60.0)
    figures += coverage(4 if quick else 100, 8.0)
    return figures + silverbox()


def accuracy(duration_s: float) -> list[Figure]:
    """Nine records and a moving beam: every parameter against the truth."""
    truth, start = load_model(shipped("models/rig.yaml")), off_by_a_tenth(1)
    with tempfile.TemporaryDirectory() as folder:
        logs = fly(Path(folder) / "logs", duration_s, 30.0, seed=1, rate_hz=1000.0)
        experiments = [experiment_from_log(read_log(path), start) for path in logs]
    begin = perf_counter()
    grey = identify_grey_box(start, experiments, 0.0)
    seconds = perf_counter() - begin
    still = fit_model(start, [e for e in experiments if not e.moving])
    in_se, relative = {}, {}
    for name in grey.fit.free:
        error = grey.fit.values[name] - truth.parameters[name].value
        in_se[name] = abs(error) / grey.fit.standard_errors[name]
        relative[name] = abs(error) / size_of(name, truth)
    dB, degrees = response_error(grey)
    said = "z_b" in {lost.name for lost in still.unidentifiable}
    return [
        Figure(
            "records", len(experiments), "", f"records of {duration_s:g} s, one more of a sweep"
        ),
        Figure("fit_s", seconds, "s", "fit of all parameters to all records"),
        Figure("worst_in_se", max(in_se.values()), "SE", "worst error of a parameter"),
        Figure(
            "worst_percent",
            100 * max(v for k, v in relative.items() if k not in HARD),
            "%",
            "worst error but of lag and delay (couplings: of the diagonal)",
        ),
        Figure("lag_percent", 100 * relative["lag"], "%", "error of the lag"),
        Figure(
            "lag_se_percent",
            100 * grey.fit.standard_errors["lag"] / truth.parameters["lag"].value,
            "%",
            "standard error of the lag",
        ),
        Figure("response_db", dB, "dB", "worst on the diagonal of P, 1 to 64 Hz"),
        Figure("response_deg", degrees, "deg", "worst on the diagonal of P, 1 to 64 Hz"),
        Figure(
            "z_b_said_singular", float(said), "", "z_b is said to be lost without a moving beam"
        ),
    ]


def coverage(seeds: int, duration_s: float) -> list[Figure]:
    """How often 95 % intervals hold the truth, all parameters together; how wide errors spread.

    Seeds are kept as they come, so that a run that was stopped carries on; results of other code
    do not count. A fit that fails gives no interval that holds anything.
    """
    kept = KEPT / f"coverage-{duration_s:g}s-{version()}.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    known: dict[int, list[float]] = {}
    if kept.exists():
        known = {r["seed"]: r["z"] for r in map(json.loads, kept.read_text().splitlines())}
    missing = [seed for seed in range(100, 100 + seeds) if seed not in known]
    with (
        ProcessPoolExecutor(mp_context=get_context("forkserver")) as pool,
        kept.open("a") as out,
    ):
        futures = {pool.submit(errors_in_se, seed, duration_s): seed for seed in missing}
        for done in as_completed(futures):
            known[futures[done]] = z = _errors(futures[done], done)
            out.write(json.dumps({"seed": futures[done], "z": z}) + "\n")
            out.flush()
    flights = [known[seed] for seed in range(100, 100 + seeds)]
    failed = sum(not z for z in flights)
    z = [value for flight in flights for value in flight]
    of = seeds * max(map(len, flights))  # no parameter of a failed fit is in its interval
    inside = float(np.sum(np.abs(z) < 1.96)) / max(of, 1)
    spread = float(np.sqrt(np.mean(np.square(z)))) if z else math.nan
    return [
        Figure("coverage_seeds", seeds, "", f"flights of nine records of {duration_s:g} s"),
        Figure("coverage_percent", 100 * inside, "%", "of 95 % intervals hold the truth"),
        Figure("coverage_failed", failed, "", "of them could not be flown or fitted: a miss each"),
        Figure("spread", spread, "SE", "rms error (1: the bound) of the others"),
    ]


def _errors(seed: int, done: Future[list[float]]) -> list[float]:
    """Return the errors of a seed, none where it failed; raises where this machine did."""
    error = done.exception()
    if error is None:
        return done.result()
    machine = isinstance(error, BrokenExecutor | OSError | MemoryError)
    if machine or not isinstance(error, Exception):
        raise error
    print(f"seed {seed}: {type(error).__name__}: {error}", file=sys.stderr)
    return []


def version() -> str:
    """Return a digest of what decides an error: flights, the way from a log to a fit, the model."""
    fitting = ("identification/greybox/identify_greybox.py", "identification/greybox/experiment.py")
    here = (Path(__file__), Path(virtual_flight.__file__))
    settings = (virtual_flight.RIG, virtual_flight.SIM, shipped("models/rig.yaml"))
    return code_version((*FLYING, *fitting, "log/reader.py"), here, settings)


def errors_in_se(seed: int, duration_s: float) -> list[float]:
    """Return each parameter's error in its standard errors, of a fit to a flight of this seed."""
    truth, start = load_model(shipped("models/rig.yaml")), off_by_a_tenth(seed)
    with tempfile.TemporaryDirectory() as folder:
        logs = fly(Path(folder) / "logs", duration_s, 12.0, seed, 1000.0)
        experiments = [experiment_from_log(read_log(path), start) for path in logs]
    with threadpool_limits(1):
        fit = fit_model(start, experiments)
    return [
        float(fit.values[name] - truth.parameters[name].value) / fit.standard_errors[name]
        for name in fit.free
    ]


def silverbox() -> list[Figure]:
    """Train on the official part, simulate the multisine: the linear part of a measured Duffing."""
    if not silverbox_data.SOURCE.exists():
        return []
    config = load_model(silverbox_data.MODEL)
    with tempfile.TemporaryDirectory() as folder:
        train, test = (
            experiment_from_log(read_log(silverbox_data.imported(rows, Path(folder))), config)
            for rows in (silverbox_data.TRAIN, silverbox_data.TEST)
        )
    figures = []
    for hold in ("band_limited", "zoh"):
        held = config.model_copy(update={"input": hold})
        fit: Fit = fit_model(held, [train])
        at = settled(motion(fit.model, test, held.input), fit.predictions[0].offset)
        gain = np.zeros((1, 2, 1))
        error = test.y + innovations(at, gain, np.zeros_like(test.y), np.zeros(2))
        rms = float(np.sqrt(np.mean(error[silverbox_data.FIRST_ROWS :] ** 2)))
        figures.append(
            Figure(f"silverbox_{hold}_mv", 1e3 * rms, "mV", f"Silverbox, test multisine, {hold}")
        )
    return figures


def fly(out: Path, duration_s: float, sweep_s: float, seed: int, rate_hz: float) -> list[Path]:
    """Fly white noise at each input at three beam positions, and a sweep; return the records."""
    steps: list[dict[str, object]] = [{"levitate": {"settle_s": 2.0}}]
    for name, beam_m in (("left", -0.1), ("middle", 0.0), ("right", 0.1)):
        steps.append({"move": {"beam_m": beam_m, "settle_s": 2.0}})
        steps += [
            {"record": {"name": f"{name}-{i}", "duration_s": duration_s, "excite": [i]}}
            for i in ("psi", "theta", "z")
        ]
    waypoints = [{"to_m": 0.08, "dwell_s": 0.5}, {"to_m": -0.08, "dwell_s": 0.5}]
    steps.append({"record": {"name": "sweep", "duration_s": sweep_s, "beam": waypoints}})
    steps.append({"land": {}})
    levels = {"psi": {"rms_n_m": 0.1}, "theta": {"rms_n_m": 0.1}, "z": {"rms_n": 1.3}}
    session = {
        "levid": "session",
        "name": "grey-box",
        "rate_hz": rate_hz,
        "seed": seed,
        "excitations": {name: {"input": name, **level} for name, level in levels.items()},
        "steps": steps,
    }
    return list(fly_session(session, out))


def size_of(name: str, truth: ModelConfig) -> float:
    """Return what an error is measured by: the value, for couplings sqrt(K_ii K_jj), M alike."""
    v = {key: p.value for key, p in truth.parameters.items()}
    tilt = v["m_b"] * v["z_b"] ** 2
    return {
        "k_psitheta": math.sqrt(v["k_psi"] * v["k_theta"]),
        "k_psiz": math.sqrt(v["k_psi"] * v["k_z"]),
        "k_thetaz": math.sqrt(v["k_theta"] * v["k_z"]),
        "J_psitheta": math.sqrt((v["J_psi"] + tilt) * (v["J_theta"] + tilt)),
        "delay": v["lag"],
    }.get(name, abs(v[name]))


def response_error(grey: object) -> tuple[float, float]:
    """Return the worst error of P's diagonal in dB and degrees over the three positions."""
    freq_hz = np.geomspace(1.0, 64.0, 100)
    config = load_yaml(shipped("sims/nominal.yaml"), SimConfig)
    worst = np.zeros(2)
    for beam_m in (-0.1, 0.0, 0.1):
        fitted = grey.response({"x_b": beam_m}, freq_hz)  # type: ignore[attr-defined]
        truth = frequency_response(config, beam_m, freq_hz, 1000.0)
        ratio = np.einsum("fii->fi", fitted) / np.einsum("fii->fi", truth)
        error = [np.abs(20 * np.log10(np.abs(ratio))).max(), np.abs(np.angle(ratio, True)).max()]
        worst = np.maximum(worst, error)
    return float(worst[0]), float(worst[1])


if __name__ == "__main__":
    try:
        table.run("The grey-box fit", measure)
    except IdentificationError as error:
        raise SystemExit(f"error: {error}") from None
