"""Import a two-output plant in a loop from CSV: coverage with the controller given and unknown.

Two coupled axes, one in m and one in rad, with different noise and quantisation, are held by a
cascade and a PID controller while each input is excited by low-pass noise. Each seed draws the
data, and the declared parameters up to 20 % off. The files are imported with the controller given,
as `unknown`, and with wrong ones: gains 25 % too high, twice as high, of the wrong sign. Intervals
are those of `identify`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.signal import lfilter

from levid.benchmarks.harness.benchmark_runner import Figure, Target, run
from levid.config.base import parse
from levid.config.controller import ControllerConfig
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.controller_file import controller_of_config
from levid.identification.greybox.experiment.experiment_from_log import experiment_from_log
from levid.identification.greybox.identify_greybox import GreyBox, identify_grey_box
from levid.identification.subspace.response_uncertainty import SURE_95
from levid.log.importing.importer import import_file
from levid.log.reader import read_log
from levid.model.controller import Controller

Array = NDArray[np.float64]

RATE_HZ, ROWS = 500.0, 4000
NOISE = np.array([2e-6, 1e-5])
STEP = np.array([1e-6, 5e-6])
FORCE_N = np.array([2.0, 0.3])
EXCITATION_N = np.array([8.0, 1.0])
LOW_PASS = 0.85
TRUE = {"m": 2.0, "J": 0.05, "d": 15.0, "c": 0.2, "k": 400.0, "kr": 12.0, "kc": 8.0}
UNITS = dict(zip(TRUE, ("kg", "kg m2", "N s/m", "N m s", "N/m", "N m", "N"), strict=True))
LIMITS = (0.25, 4.0)
LINEAR = {"measured": "x_m", "kp": 30.0}
SPEED = {"measured": "x_m", "rate": True, "average": 2, "kp": 30.0}
ROTARY = {"measured": "a_rad", "kp": 10.0, "ki": 40.0, "kd": 0.3, "derivative_filter_s": 0.004}
CONTROLLER = {"pid": {"f_n": {"loops": [LINEAR, SPEED]}, "t_n_m": {"loops": [ROTARY]}}}
COVERED = Target(least=90.0, most=98.0)
SEEDS, QUICK = 200, 6


def model(rng: np.random.Generator) -> ModelConfig:
    """Return the declared model; its parameters are up to 20 % off."""
    parameters = {
        name: {
            "value": value * rng.uniform(0.8, 1.2), "unit": UNITS[name],
            "min": value * LIMITS[0], "max": value * LIMITS[1],
        }
        for name, value in TRUE.items()
    }  # fmt: skip
    plain = {
        "levid": "model", "name": "axes", "parameters": parameters,
        "dof": [{"name": "x", "unit": "m"}, {"name": "a", "unit": "rad"}],
        "inputs": [{"name": "f", "unit": "N"}, {"name": "t", "unit": "N m"}],
        "M": [["m", 0], [0, "J"]], "D": [["d", 0], [0, "c"]], "K": [["k", "kc"], ["kc", "kr"]],
        "B": [[1, 0], [0, 1]],
    }  # fmt: skip
    return parse(plain, ModelConfig, "axes")


def controller() -> Controller:
    """Return the controller that flies."""
    config = parse(CONTROLLER, ControllerConfig, "controller")
    return controller_of_config(config, ("f_n", "t_n_m"), ("x_m", "a_rad"), 1.0 / RATE_HZ)[0]


def fly(seed: int) -> Array:
    """Return the columns v_f, v_t, f, t, x, a of one flight (N, 6).

    White forces act, held over each row. The controller reads the outputs with noise, quantised.
    """
    rng, law, Ts_s = np.random.default_rng(seed), controller(), 1.0 / RATE_HZ
    M = np.diag([TRUE["m"], TRUE["J"]])
    K = np.array([[TRUE["k"], TRUE["kc"]], [TRUE["kc"], TRUE["kr"]]])
    A = np.zeros((6, 6))
    A[:2, 2:4] = np.eye(2)
    A[2:4, :2], A[2:4, 2:4] = (
        -np.linalg.solve(M, K),
        -np.linalg.solve(M, np.diag([TRUE["d"], TRUE["c"]])),
    )
    A[2:4, 4:] = np.linalg.inv(M)
    step = expm(A * Ts_s)[:4]
    x, state, rows = np.zeros(4), np.zeros(len(law.A)), []
    v = lfilter([1.0], [1.0, -LOW_PASS], rng.normal(size=(ROWS, 2)) * EXCITATION_N, axis=0)
    for k in range(ROWS):
        y = np.round((x[:2] + NOISE * rng.normal(size=2)) / STEP) * STEP
        w = np.concatenate([np.zeros(law.references), y])
        u = law.C @ state + law.D @ w + v[k]
        state = law.A @ state + law.B @ w
        rows.append([*v[k], *u, *y])
        x = step @ np.concatenate([x, u + FORCE_N * rng.normal(size=2)])
    return np.array(rows)


@dataclass(frozen=True)
class Found:
    """What one import gave: errors over half widths, and whether the controller was doubted."""

    ratios: Array
    metrics: tuple[str, ...]
    doubted: bool


def identified(data: Path, loop: object, excitation: bool, config: ModelConfig) -> Found:
    """Import the CSV with this loop, and identify it."""
    columns = [
        _column("f", "f_n", "N", "input"),
        _column("t", "t_n_m", "N m", "input"),
        _column("x", "x_m", "m", "output"),
        _column("a", "a_rad", "rad", "output"),
    ]
    if excitation:
        columns += [
            {**_column("v_f", "v_f_n", "N", "excitation"), "of": "f_n"},
            {**_column("v_t", "v_t_n_m", "N m", "excitation"), "of": "t_n_m"},
        ]
    signals, log = data.with_suffix(".yaml"), data.with_suffix(".mcap")
    log.unlink(missing_ok=True)
    plain = {
        "levid": "signals",
        "rate_hz": RATE_HZ,
        "columns": columns,
        "loop": {"controller": loop},
    }
    signals.write_text(yaml.safe_dump(plain))
    import_file(data, signals, log)
    grey: GreyBox = identify_grey_box(config, [experiment_from_log(read_log(log), config)], 0.25)
    fitted = grey.fitted.parameters
    ratios = [
        abs(fitted[n].value - value) / (SURE_95 * (fitted[n].se or 0.0))
        for n, value in TRUE.items()
    ]
    doubted = any("did not command" in text for text in grey.remarks)
    return Found(np.array(ratios), tuple(v.metric for v in grey.validations), doubted)


def _column(column: str, name: str, unit: str, role: str) -> dict[str, str]:
    return {"column": column, "name": name, "unit": unit, "role": role}


def scaled(factor: float) -> object:
    """Return the controller with other gains on the measured outputs."""
    wrong = deepcopy(CONTROLLER)
    for law in wrong["pid"].values():
        for key in {"kp", "ki", "kd"} & set(law["loops"][-1]):
            law["loops"][-1][key] *= factor
    return wrong


CASES = {
    "given": ("controller and excitation given", CONTROLLER, True),
    "assumed": ("controller given, excitation not recorded", CONTROLLER, False),
    "unknown": ("controller unknown", "unknown", False),
    "quarter": ("gains 25 % too high", scaled(1.25), True),
    "twice": ("gains twice as high, excitation not recorded", scaled(2.0), False),
    "sign": ("gains of the wrong sign, excitation not recorded", scaled(-1.0), False),
}
"""For each case: what is imported, the loop's controller, whether the excitation is imported."""
NOTICED = ("quarter", "sign")


def measure(quick: bool) -> Iterator[Figure]:
    """Yield the coverage of all parameters' intervals, and how often a controller is doubted."""
    found: dict[str, list[Found]] = {case: [] for case in CASES}
    seeds = QUICK if quick else SEEDS
    for seed in range(seeds):
        config = model(np.random.default_rng(seed + 10**6))
        with tempfile.TemporaryDirectory() as folder:
            data = Path(folder) / "axes.csv"
            names = "v_f,v_t,f,t,x,a"
            np.savetxt(data, fly(seed), delimiter=",", header=names, comments="", fmt="%.9g")
            for case, (_, loop, excitation) in CASES.items():
                found[case].append(identified(data, loop, excitation, config))
    yield Figure("seeds", seeds, "", "seeds")
    for case, (label, _, _) in CASES.items():
        covered = 100.0 * float(np.mean([f.ratios <= 1.0 for f in found[case]]))
        asked = COVERED if case in ("given", "assumed", "unknown") else None
        text = f"{label}: intervals that contain the truth"
        yield Figure(f"{case}_covered", covered, "%", text, None, asked)
        doubted = 100.0 * float(np.mean([f.doubted for f in found[case]]))
        most = {"twice": None}.get(
            case, Target(least=99.0) if case in NOTICED else Target(most=1.0)
        )
        text = f"{label}: controller said to be wrong"
        yield Figure(f"{case}_doubted", doubted, "%", text, None, None if case == "twice" else most)
        free = 100.0 * float(np.mean([m == "free_run" for f in found[case] for m in f.metrics]))
        yield Figure(f"{case}_free_run", free, "%", f"{label}: judged by a free run")


if __name__ == "__main__":
    run("Imported data of a loop", measure)
