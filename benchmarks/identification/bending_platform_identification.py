"""Identify platforms that bend, and rigid ones: coverage of all intervals, modes, band, noise.

Forty platforms are drawn around the paper's kind (`bending_platform.drawn`), forty are rigid; half
are excited by noise, half by multisines; nine records of 20 s, declared values up to 20 % off.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from levid.benchmarks.harness.benchmark_runner import Figure, Target, run
from levid.benchmarks.identification.bending_platform import (
    COIL_NOISE_N,
    COILS,
    NOMINAL,
    SENSOR_NOISE_M,
    SENSOR_STEP_M,
    STEP_S,
    Platform,
    T,
    drawn,
    flights,
)
from levid.config.model import ModelConfig, load_model
from levid.config.shipped import shipped
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.fit import linearised
from levid.identification.greybox.fit_in_loop import FittedLoop, fit_in_loop
from levid.identification.greybox.modes.identify_in_loop import LoopFit
from levid.identification.greybox.prediction.noise_model import Noise
from levid.identification.subspace.response_uncertainty import SURE_95

Array = NDArray[np.float64]

PLANTS, QUICK = 40, 1
OFF = 0.2
DELAY_OFF_S = 2e-5
NEAR = 0.03
"""Relative distance within which a mode that is found is the true one."""
COVERED = Target(least=90.0, most=98.0)
BOUND = Target(most=1.1)


@dataclass(frozen=True)
class Outcome:
    """What one plant's identification gave: errors over standard errors, relative errors, modes."""

    seed: int
    bends: bool
    excitation: str
    z: dict[str, float]
    relative: dict[str, float]
    true_modes: int
    found_modes: int
    mode_z: list[float]
    mode_widths: list[float]
    band_ratio: float
    over_noise: float
    noise_ratio: list[float]
    over_bound: list[float]
    shape_z: list[float]
    shape_se: list[float]
    white: bool
    seconds: float


def measure(quick: bool) -> Iterator[Figure]:
    """Yield the figures of all plants."""
    plants = QUICK if quick else PLANTS
    tasks = [(seed, bends) for bends in (True, False) for seed in range(plants)]
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        found = list(pool.map(_identified, tasks))
    Path("build").mkdir(exist_ok=True)
    Path("build/bending_platform.json").write_text(
        json.dumps([o.__dict__ for o in found], indent=1)
    )
    for bends, name in ((True, "bending"), (False, "rigid")):
        outcomes = [o for o in found if o.bends == bends]
        z = np.array([list(o.z.values()) for o in outcomes])
        covered = 100.0 * float(np.mean(np.abs(z) < SURE_95))
        yield Figure(f"{name}_covered", covered, "%", f"{name}: intervals that hold", None, COVERED)
        names = list(outcomes[0].relative)
        errors = np.array([[abs(o.relative[n]) for n in names] for o in outcomes]).mean(axis=0)
        worst = int(np.argmax(errors))
        yield Figure(
            f"{name}_error", 100.0 * errors[worst], "%",
            f"{name}: largest mean error of a parameter that is determined ({names[worst]})",
            target=Target(most=1.0),
        )  # fmt: skip
        right = sum(o.true_modes == o.found_modes for o in outcomes)
        yield Figure(f"{name}_orders", right, "", f"{name}: right number of modes, of {plants}")
        noise = np.array([o.noise_ratio for o in outcomes])
        off = 100.0 * float(np.median(np.abs(np.sqrt(noise) - 1.0)))
        yield Figure(f"{name}_noise", off, "%", f"{name}: median error of the noise's rms")
        over = max(o.over_noise for o in outcomes)
        bounds = np.array([o.over_bound for o in outcomes if o.over_bound])
        if len(bounds):
            label = (
                f"{name}: standard errors over the Cramér-Rao bound, largest mean of a parameter"
            )
            yield Figure(f"{name}_bound", float(bounds.mean(axis=0).max()), "", label, None, BOUND)
        yield Figure(f"{name}_over_noise", over, "", f"{name}: largest error over noise")
        seconds = float(np.median([o.seconds for o in outcomes]))
        yield Figure(f"{name}_seconds", seconds, "s", f"{name}: median time")
    bent = [o for o in found if o.bends]
    ratios = np.array([o.band_ratio for o in bent])
    band = float(np.exp(np.max(np.abs(np.log(ratios)))))
    yield Figure("band", band, "", "end of the valid band over the true one, at worst")
    mode_z = np.concatenate([o.mode_z for o in bent])
    if len(mode_z):
        inside = 100.0 * float(np.mean(np.abs(mode_z) < SURE_95))
        yield Figure("modes_covered", inside, "%", "bending modes: frequency inside its interval")
        width = 100.0 * float(np.median(np.concatenate([o.mode_widths for o in bent])))
        yield Figure("modes_width", width, "%", "bending modes: median half width of the interval")
        shape_z = np.concatenate([o.shape_z for o in bent])
        inside = 100.0 * float(np.mean(np.abs(shape_z) < SURE_95))
        yield Figure("shapes_covered", inside, "%", "their shapes: sensors in their intervals")
        se = float(np.median(np.concatenate([o.shape_se for o in bent])))
        yield Figure("shapes_se", se, "", "their shapes: median standard error, over the largest")


def _identified(task: tuple[int, bool]) -> Outcome:
    seed, bends = task
    platform = drawn(seed) if bends else Platform()
    excitation = "noise" if seed % 2 == 0 else "multisine"
    records = flights(platform, seed, excitation)
    begin = perf_counter()
    with threadpool_limits(1):
        fit, loop = fit_in_loop(_start(seed), records, (), None)
    seconds = perf_counter() - begin
    # What the records do not determine counts with the uncertainty of its declared value.
    names = [n for n in loop.fit.names if isinstance(n, str)]
    se = np.sqrt(np.diag(loop.fit.covariance))[: len(names)]
    values = loop.fit.plant.model.values
    z = {n: (values[n] - NOMINAL[n]) / e for n, e in zip(names, se.tolist(), strict=True)}
    determined = [
        n for n, e in zip(names, se, strict=True) if NOMINAL[n] and e < 0.01 * abs(NOMINAL[n])
    ]
    relative = {n: values[n] / NOMINAL[n] - 1.0 for n in names if NOMINAL[n]}
    relative = {n: x if n in determined else 0.0 for n, x in relative.items()}
    mode_z, widths = _modes(platform, loop)
    shape_z, shape_se = _shapes(platform, loop)
    force = COIL_NOISE_N**2 * STEP_S * np.diag(COILS.T @ COILS)
    sensor = (SENSOR_NOISE_M**2 + SENSOR_STEP_M**2 / 12.0) * np.diag(T @ T.T)
    ratio = [*(fit.noise.force_psd / force), *(fit.noise.output_variance / sensor)]
    return Outcome(
        seed, bends, excitation, z, relative,
        len(platform.modes) + (platform.bearing is not None), len(loop.fit.modes),
        mode_z, widths, _band_ratio(platform, loop), loop.over_noise,
        [float(x) for x in ratio], [] if bends else _over_bound(loop.fit, records),
        shape_z, shape_se,
        loop.fit.white, seconds,
    )  # fmt: skip


def _over_bound(fit: LoopFit, records: list[Experiment]) -> list[float]:
    """Return standard errors over the Cramér-Rao bound, that of the true plant and its noise.

    The Kalman filter's likelihood gives the bound. Both are given what the fit holds.
    """
    model = load_model(shipped("models/rig.yaml"))
    true = {
        name: p.model_copy(update={"value": NOMINAL.get(name, p.value)})
        for name, p in model.parameters.items()
    }
    noise = Noise(
        COIL_NOISE_N**2 * STEP_S * COILS.T @ COILS,
        (SENSOR_NOISE_M**2 + SENSOR_STEP_M**2 / 12.0) * T @ T.T,
    )
    at = linearised(model.model_copy(update={"parameters": true}), records, noise)
    held = {u.name for u in fit.unidentifiable}
    free = [k for k, name in enumerate(at.names) if name not in held]
    bound = np.linalg.inv((at.R.T @ at.R)[np.ix_(free, free)])
    own = [fit.names.index(at.names[k]) for k in free]
    given = [k for k, name in enumerate(fit.names) if name in held]
    across = fit.covariance[np.ix_(own, given)]
    known = across @ np.linalg.solve(fit.covariance[np.ix_(given, given)], across.T)
    found = fit.covariance[np.ix_(own, own)] - known
    return [float(x) for x in np.sqrt(np.diag(found) / np.diag(bound))]


def _start(seed: int) -> ModelConfig:
    """Return the shipped model with declared values up to 20 % off."""
    rng, config = np.random.default_rng([seed, 9]), load_model(shipped("models/rig.yaml"))
    changed = {}
    for name, p in config.parameters.items():
        factor = 1.0 + OFF * rng.uniform(-1.0, 1.0)
        off = {"value": p.value * factor if p.value else DELAY_OFF_S}
        changed[name] = p if p.is_fixed else p.model_copy(update=off)
    return config.model_copy(update={"parameters": changed})


def _modes(platform: Platform, loop: FittedLoop) -> tuple[list[float], list[float]]:
    """Return errors over standard errors, and half widths over the frequency, of bending modes."""
    z, widths = [], []
    for true in platform.modes:
        near = [m for m in loop.fit.modes if abs(m.freq_hz / true.freq_hz - 1.0) < NEAR]
        if not near:
            z.append(np.inf)
            continue
        mode = min(near, key=lambda m: abs(m.freq_hz - true.freq_hz))
        se, _ = loop.fit.mode_errors(mode)
        z.append((mode.freq_hz - true.freq_hz) / se)
        widths.append(SURE_95 * se / mode.freq_hz)
    return z, widths


def _shapes(platform: Platform, loop: FittedLoop) -> tuple[list[float], list[float]]:
    """Return errors over standard errors, and standard errors, of shapes at all sensors.

    At the largest motion, which is 1 by definition, there is none.
    """
    z: list[float] = []
    sizes: list[float] = []
    for true in platform.modes:
        near = [
            (abs(mode.freq_hz - true.freq_hz), shape)
            for mode, shape in loop.modes
            if shape is not None and abs(mode.freq_hz / true.freq_hz - 1.0) < NEAR
        ]
        for _, shape in sorted(near, key=lambda one: one[0])[:1]:
            largest = int(np.argmax(np.abs(shape.shape)))
            others = np.arange(len(shape.shape)) != largest
            error = shape.shape - true.shape / true.shape[largest]
            z += (error / shape.se)[others].tolist()
            sizes += shape.se[others].tolist()
    return z, sizes


def _band_ratio(platform: Platform, loop: FittedLoop) -> float:
    """Return the end of the valid band over that of the same definition from the truth."""
    top_hz = float(loop.fit.points[0].freq_hz[-1])
    freq_hz = np.geomspace(0.2, top_hz, 4000)
    first = top_hz
    for x_b_m in (-0.1, 0.0, 0.1):
        whole, rigid = (p.response(x_b_m, freq_hz) for p in (platform, Platform()))
        for i in range(3):
            wrong = np.abs(rigid[:, i, i] - whole[:, i, i]) > 0.1 * np.abs(whole[:, i, i])
            if np.any(wrong):
                first = min(first, float(freq_hz[int(np.argmax(wrong))]))
    return loop.band.end_hz / first


if __name__ == "__main__":
    run(__doc__, measure)
