"""How long one control period of the simulated plant takes: numba against numpy, start-up included.

The plant is the hot spot of everything in virtual time. Its numpy rival is the cheapest that can
be written: the declared model with the beam at rest, discretised once, one product a step.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from levid.benchmarks.harness.benchmark_runner import Figure, median_times, run
from levid.config.base import load_yaml
from levid.config.sim import SimConfig
from levid.model.geometry import shape_matrix
from levid.model.second_order import held_step
from levid.model.second_order import state_space as continuous
from levid.sim.plant import Plant
from levid.sim.true_response import declared_model

SIMS = Path(__file__).parents[2] / "config" / "sims"
EFFECT = """
class Spring:
    def wrench(self, t_s, q, qd, beam):
        return (0.0, 0.0, -100.0 * q[2])
"""
START = """
import time
start = time.perf_counter()
from levid.config.base import load_yaml
from levid.config.sim import SimConfig
from levid.sim.plant import Plant
imported = time.perf_counter()
for name in ("nominal", "rig"):
    Plant(load_yaml({sims!r} + "/" + name + ".yaml", SimConfig), 1e-3)
print(imported - start, time.perf_counter() - imported)
"""


def measure(quick: bool) -> Sequence[Figure]:
    repeats, periods = (5, 300) if quick else (25, 2000)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "effect.py").write_text(EFFECT)
        contenders: dict[str, Callable[[], object]] = {}
        for rate, period_s in (("1khz", 1e-3), ("10khz", 1e-4)):
            nominal, rig = (load_yaml(SIMS / f"{name}.yaml", SimConfig) for name in SIM_NAMES)
            one = rig.model_dump() | {"effects": [{"use": "effect.py:Spring"}]}
            source = Path(folder) / "SIM.yaml"
            contenders[f"numpy_{rate}"] = flight(NumpyPlant(nominal, period_s), periods)
            contenders[f"declared_{rate}"] = flight(Plant(nominal, period_s), periods)
            contenders[f"nonlinear_{rate}"] = flight(Plant(rig, period_s), periods)
            with_effect = Plant(SimConfig.model_validate(one), period_s, source=source)
            contenders[f"effect_{rate}"] = flight(with_effect, periods)
        times = median_times(contenders, repeats)
    label = {
        "numpy": "numpy, declared, beam at rest",
        "declared": "declared",
        "nonlinear": "nonlinear",
        "effect": "nonlinear with one effect",
    }
    figures = [
        Figure(
            f"{name}_us",
            times[name] / periods * 1e6,
            "us a period",
            f"{label[name.split('_')[0]]}, {name.split('_')[1]}",
            None if name.startswith("numpy") else f"numpy_{name.split('_')[1]}_us",
        )
        for name in contenders
    ]
    return [*figures, *start_up()]


SIM_NAMES = ("nominal", "rig")


def flight(plant: Plant | NumpyPlant, periods: int) -> Callable[[], None]:
    """A contender: some periods with a hovering force, each advanced and sampled."""
    coil_n, ref = np.full(9, 7.0 * 9.81 / 9), np.zeros(3)

    def fly() -> None:
        for _ in range(periods):
            plant.advance(coil_n, ref, ref)
            plant.sample()

    fly()
    return fly


def start_up() -> list[Figure]:
    """Import and both levels built, in a fresh process: first with an empty cache, then with it."""
    figures = []
    with tempfile.TemporaryDirectory() as cache:
        for key, label in (("compile", "compiling"), ("cached", "from the cache")):
            answer = subprocess.run(
                [sys.executable, "-c", START.format(sims=str(SIMS))],
                env=os.environ | {"NUMBA_CACHE_DIR": cache},
                capture_output=True,
                text=True,
                check=True,
            )
            imported, built = map(float, answer.stdout.split())
            figures.append(Figure(f"{key}_import_s", imported, "s", f"import, {label}"))
            figures.append(Figure(f"{key}_build_s", built, "s", f"both levels, {label}"))
    return figures


class NumpyPlant:
    """The declared plant with the beam at rest, without stops: one stacked product a step."""

    def __init__(self, config: SimConfig, period_s: float) -> None:
        self._steps = round(period_s / config.step_s)
        model = declared_model(config, 0.0, 1.0 / period_s)
        plant = continuous(model)
        lag = config.coils.lag_s
        A = np.block([[plant.A, plant.B], [np.zeros((3, 6)), -np.eye(3) / lag]])
        # Inputs: the wrench through the lag, the noise and the weight past it.
        B = np.block([[np.zeros((6, 3)), plant.B], [np.eye(3) / lag, np.zeros((3, 3))]])
        Ad, Bd = held_step(A, B, period_s / self._steps)
        S = shape_matrix(config.geometry.coil_x_m, config.geometry.coil_y_m)
        self._weight, self._S = model.force, S
        self._next = np.hstack([Ad, Bd[:, :3] @ S.T, Bd[:, 3:] @ S.T * config.coils.noise_n])
        self._offset = Bd[:, 3:] @ model.force
        self._rng = np.random.default_rng(config.seed)
        self._noise = np.zeros(9 * self._steps + 9)
        self._x, self._z = np.zeros(9), np.zeros(27)
        self._lsb, self._noise_m = 2e-3 / 2**16, config.sensors.noise_m
        self.gap_m = np.zeros(9)

    def advance(
        self, coil_n: NDArray[np.float64], _beam: NDArray[np.float64], _rotor: NDArray[np.float64]
    ) -> None:
        self._rng.standard_normal(out=self._noise)
        z, x = self._z, self._x
        np.clip(coil_n, -20.0, 20.0, out=z[9:18])
        for i in range(self._steps):
            z[:9] = x
            z[18:] = self._noise[9 * i : 9 * i + 9]
            np.dot(self._next, z, out=x)
            x += self._offset

    def sample(self) -> None:
        gap = self._S @ self._x[:3] + self._noise_m * self._noise[-9:]
        np.clip(np.rint(gap / self._lsb) * self._lsb, -1e-3, 1e-3, out=self.gap_m)


if __name__ == "__main__":
    run("One period of the simulated plant, advance() and sample()", measure)
