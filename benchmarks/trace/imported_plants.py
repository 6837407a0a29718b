"""Trace imported records of plants that are not the rig: names, intervals, missing force, time.

A drive and a two-axis stage in an unknown loop, with and without Coulomb friction at x; a pendulum
in open loop, with and without k sin q in place of k q. The declared models are linear, and their
parameters 10 to 20 % off. Each seed draws the plant and its data. The simulation does not use
levid's simulator: each DOF is integrated by the midpoint rule, far below the sampling period.

A report is *right* if its class and place are those of the effect in the plant; *in a group* if
only an alternative of an ambiguous report is. A *false name* is a known class of which no member is
right. Free forms (class `unknown`) are counted apart. Intervals are counted only if the fitted
model has the structure of the plant.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray
from rich.table import Table
from scipy.signal import butter, lfilter

from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.benchmarks.trace.support_calibration import Statement, figures, statements
from levid.config.base import parse
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment_from_log import Experiment
from levid.identification.subspace.response_uncertainty import SURE_95
from levid.identification.trace.force_regression import force_trace_summary
from levid.identification.trace.force_regression.trace_imported import trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.candidate_effects import all_effects

Array = NDArray[np.float64]
Generator = np.random.Generator

SEEDS, QUICK = 20, 1
FIRST_SEED = 120_000
"""No plant of these seeds was used to develop the trace; plants of these kinds were."""
OFF = (0.1, 0.2)
"""Relative errors of the declared parameters, of random sign."""


@dataclass(frozen=True)
class Plant:
    """Independent DOFs: m q'' + d q' + k q (or k sin q) + coulomb tanh(q' / v_s) = b u.

    values: rows m, d, k, b, kp, kd, coulomb, v_s (8, n). The controller is u = v - kp y - kd dy, dy
    the change of y over a period. dof and inputs: units by name. noise: of y (n,). classes: right
    ones of the effect that the declared model lacks, at the first DOF; empty without one.
    """

    dof: dict[str, str]
    inputs: dict[str, str]
    Ts_s: float
    values: Array
    noise: Array
    sine: bool = False
    classes: tuple[str, ...] = ()

    def simulated(self, v: Array, rng: Generator, steps: int) -> tuple[Plant, Array, Array]:
        """Return the plant, its input and its output (N, n); v (N, n), `steps` per period."""
        noise = self.noise * rng.normal(size=v.shape)
        return self, *_integrated(v, noise, self.Ts_s, steps, self.sine, self.values)

    def completed(self) -> tuple[list[str], dict[str, float]]:
        """Return the effects of the plant's structure, and the true parameters with them."""
        m, d, k, *_, coulomb, v_s = self.values
        rows = {"m": m, "d": d, "k": 0 * k if self.sine else k}
        truth = {f"{a}_{q}": x[i] for a, x in rows.items() for i, q in enumerate(self.dof)}
        if self.sine:
            return ["gravity.sine@q"], {**truth, "k_s": k[0], "k_c": 0.0}
        if self.classes:
            return ["friction.coulomb@x"], {**truth, "friction": coulomb[0], "v_s": v_s[0]}
        return [], truth


def _integrate(
    v: Array, noise: Array, Ts_s: float, steps: int, sine: bool, values: Array
) -> tuple[Array, Array]:
    u, y, h = np.zeros_like(v), np.zeros_like(v), Ts_s / steps
    for i in range(v.shape[1]):
        m, d, k, b, kp, kd, coulomb, v_s = values[:, i]
        x, w, last = 0.0, 0.0, noise[0, i]
        for row in range(len(v)):
            y[row, i] = x + noise[row, i]
            u[row, i] = v[row, i] - kp * y[row, i] - kd * (y[row, i] - last)
            last = y[row, i]
            for _ in range(steps):
                x_mid, w_mid = x, w
                for part in (0.5, 1.0):
                    spring = k * (np.sin(x_mid) if sine else x_mid)
                    a = (b * u[row, i] - spring - d * w_mid - coulomb * np.tanh(w_mid / v_s)) / m
                    x_mid, w_mid = x + part * h * w_mid, w + part * h * a
                x, w = x_mid, w_mid
    return u, y


_integrated = cast("Callable[..., tuple[Array, Array]]", njit(_integrate))


def low_pass_noise(rng: Generator, rows: int, Ts_s: float, limit_hz: float) -> Array:
    """Return noise (rows,) of unit deviation below the limit."""
    u = lfilter(*butter(2, 2.0 * limit_hz * Ts_s), rng.normal(size=rows))
    return np.asarray(u / np.std(u))


def drive(rng: Generator, friction: bool) -> tuple[Plant, Array, Array]:
    """Return a drive that follows triangles of 0.4 m/s, plus noise below 15 Hz; 20 s at 500 Hz."""
    Ts_s, rows = 0.002, 10_000
    m, d, coulomb = rng.uniform(5, 20), rng.uniform(10, 60), friction * rng.uniform(3, 12)
    kp, kd = m * 40.0**2, 0.3 * m * 40.0 * 1.2 / Ts_s
    values = np.array([[m], [d], [0.0], [1.0], [kp], [kd], [coulomb], [1e-3]])
    right = ("friction",) if friction else ()
    plant = Plant({"x": "m"}, {"f": "N"}, Ts_s, values, np.array([1e-5]), classes=right)
    path = np.repeat(rng.choice([-1.0, 1.0], rows // 250), 250)
    path, t = 0.4 * Ts_s * np.cumsum(path), np.arange(rows)
    path -= np.polyval(np.polyfit(t, path, 1), t)
    path -= path[0]
    v = kp * path + kd * np.diff(path, prepend=0.0)
    v += 1e-3 * kp * low_pass_noise(rng, rows, Ts_s, 15.0)
    return plant.simulated(v[:, None], rng, 20)


def pendulum(rng: Generator, sine: bool) -> tuple[Plant, Array, Array]:
    """Return a pendulum driven by noise below 0.8 Hz; 60 s at 100 Hz.

    The input is sized by a simulation without the sine: RMS 0.55 rad there, 0.3 rad if linear.
    """
    m, d, k, b = (rng.uniform(*r) for r in ((0.05, 0.2), (0.02, 0.1), (0.5, 2.0), (0.2, 0.5)))
    values = np.array([[m], [d], [k], [b], [0.0], [0.0], [0.0], [1.0]])
    linear = Plant({"q": "rad"}, {"u": "V"}, 0.01, values, np.array([1e-3]))
    v = low_pass_noise(rng, 6000, 0.01, 0.8)[:, None]
    v *= (0.55 if sine else 0.3) / linear.simulated(v, rng, 10)[2].std()
    plant = replace(linear, sine=True, classes=("gravity", "stiffness")) if sine else linear
    return plant.simulated(v, rng, 10)


def stage(rng: Generator, friction: bool) -> tuple[Plant, Array, Array]:
    """Return a stage with axes in m and rad, damped by its loop; noise up to 25 Hz, 20 s, 500 Hz.

    The effect, if any, is Coulomb friction at x.
    """
    Ts_s = 0.002
    m, d, k = rng.uniform(((2, 0.01), (5, 0.05), (500, 5)), ((5, 0.03), (20, 0.2), (2000, 20)))
    coulomb, one = np.array([friction * rng.uniform(0.3, 1.0), 0.0]), np.ones(2)
    kd = np.array([1.8, 0.9]) * m / Ts_s
    values = np.array([m, d, k, one, 0 * one, kd, coulomb, 1e-4 * one])
    dof, inputs = {"x": "m", "phi": "rad"}, {"f": "N", "t": "N m"}
    right = ("friction",) if friction else ()
    plant = Plant(dof, inputs, Ts_s, values, np.array([2e-7, 1e-6]), classes=right)
    v = [a * low_pass_noise(rng, 10_000, Ts_s, hz) for a, hz in ((3.0, 20.0), (0.05, 25.0))]
    return plant.simulated(np.stack(v, axis=1), rng, 10)


_PLANTS = (drive, "friction"), (pendulum, "sine"), (stage, "friction")
PLANTS = {f"{f.__name__}-{what}": (f, True) for f, what in _PLANTS}
PLANTS |= {f.__name__: (f, False) for f, _ in _PLANTS}
"""For each plant, its function, and whether the declared model lacks an effect."""


def declared(plant: Plant, rng: Generator) -> ModelConfig:
    """Return the linear model that is declared; its input gains are exact."""
    parameters, n = dict[str, Any](), len(plant.dof)
    matrices: dict[str, Any] = {name: [[0.0] * n for _ in range(n)] for name in "MDK"}
    for i, (name, unit) in enumerate(plant.dof.items()):
        force, mass = ("N", "kg") if unit == "m" else ("N m", "kg m2")
        units = (mass, f"{force} s/{unit}", f"{force}/{unit}")
        for matrix, values, of in zip("MDK", plant.values, units, strict=False):
            if value := float(values[i]):
                start = value * (1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(*OFF))
                limits = {"min": 0.02 * value if matrix == "M" else 0.0, "max": 50.0 * value}
                key = f"{matrix.lower()}_{name}"
                parameters[key] = {"value": start, "unit": of, **limits}
                matrices[matrix][i][i] = key
    axes = {"dof": plant.dof, "inputs": plant.inputs}
    named = {k: [{"name": n, "unit": u} for n, u in a.items()] for k, a in axes.items()}
    plain = {"levid": "model", "name": "plant", "parameters": parameters, **matrices, **named}
    return parse({**plain, "B": np.diag(plant.values[3]).tolist()}, ModelConfig, "plant")


def scored(
    name: str, seed: int, options: SearchOptions | None = None
) -> tuple[dict[str, float], list[bool], list[Statement]]:
    """Return the score of a plant by keys of COLUMNS, whether each interval has the truth, and the
    names with their support."""
    rng, (simulate, effect) = np.random.default_rng(seed), PLANTS[name]
    plant, u, y = simulate(rng, effect)
    config, in_loop = declared(plant, rng), bool(np.any(plant.values[4:6]))
    record = Experiment(name, plant.Ts_s, u, y, {}, frozenset(), False, feedback=in_loop)
    records, start = [imported_trace_record(record, config)], time.perf_counter()
    trace = trace_records(records, config, all_effects, lambda *_: None, options)
    seconds = time.perf_counter() - start
    summary = force_trace_summary.force_summary(trace)
    model = force_trace_summary.model_with_effects(trace)

    def right(one: dict[str, Any]) -> bool:
        return one["class"] in plant.classes and one["where"] == [*plant.dof][:1]

    known = [e for e in summary["effects"] if e["class"] != "unknown"]
    alone = [right(e) for e in known]
    grouped = [any(map(right, e["alternatives"])) for e in known]
    false = any(not (a or g) for a, g in zip(alone, grouped, strict=True))
    inside, (structure, truth) = list[bool](), plant.completed()
    if [p.effect.identity for p in trace.found.point.placed] == structure:
        told = {key: (p.value, p.se) for key, p in model.parameters.items()}
        told |= {key: (p.value, p.se) for e in model.effects for key, p in e.parameters.items()}
        errors = [(value - truth[key], se) for key, (value, se) in told.items() if se is not None]
        inside = [bool(abs(error) <= SURE_95 * se) for error, se in errors]
    force = summary["validation"]["force_percent"]
    score = {
        "right": any(alone), "in_group": any(grouped) and not any(alone), "false_name": false,
        "free_form": len(known) < len(summary["effects"]), "force_before": force["before"],
        "force_after": force["after"], "seconds": seconds,
    }  # fmt: skip
    print(f"{name} {seed}: {summary['unexplained']['found']}", file=sys.stderr)
    return score, inside, statements(summary, right)


KEYS = "right in_group false_name free_form force_before force_after seconds inside intervals"
HEADINGS = "right %,in group %,false name %,free form %,force before %,after %,s,inside %,of"
COLUMNS = dict(zip(KEYS.split(), HEADINGS.split(","), strict=True))
"""Headings by key: shares in %, medians of missing force in % and of seconds."""


def row(
    scores: Sequence[tuple[dict[str, float], list[bool], list[Statement]]], effect: bool
) -> list[float | None]:
    """Return the values of COLUMNS of one plant; None where there is nothing to count."""
    values = np.array([[*score.values()] for score, *_ in scores], dtype=float)
    shares, medians = 100.0 * values[:, :4].mean(axis=0), np.median(values[:, 4:], axis=0)
    inside = [ok for _, some, _ in scores for ok in some]
    covered = 100.0 * float(np.mean(inside)) if inside else None
    named = shares[:2].tolist() if effect else [None, None]
    return [*named, *shares[2:].tolist(), *medians.tolist(), covered, float(len(inside))]


def main() -> None:
    options = parser("Trace plants that are not the rig; --quick: one seed of each")
    options.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help="of each plant")
    options.add_argument("--first-seed", type=int, default=FIRST_SEED, metavar="N")
    options.add_argument("--only", nargs="+", default=(*PLANTS,), choices=PLANTS, metavar="PLANT")
    arguments = options.parse_args()
    seeds, first = QUICK if arguments.quick else arguments.seeds, arguments.first_seed
    table = Table("plant", "seeds", *COLUMNS.values())

    def measure() -> Iterator[Figure]:
        false, told = 0, list[Statement]()
        for name in arguments.only:
            scores = [scored(name, seed) for seed in range(first, first + seeds)]
            false += sum(bool(score["false_name"]) for score, *_ in scores)
            told += [one for *_, some in scores for one in some]
            values = row(scores, PLANTS[name][1])
            shown = ["-" if x is None else f"{x:.3g}" for x in values]
            table.add_row(name, str(seeds), *shown)
            for key, x in zip(COLUMNS, values, strict=True):
                yield Figure(f"{name}_{key}", x, "", "")
        label = "records with a false name"
        yield Figure("false_names", false, "", label, target=Target(most=0.0))
        yield from figures(told)

    show("Imported plants", arguments, measure, lambda: [table])


if __name__ == "__main__":
    main()
