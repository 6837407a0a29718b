"""A simulated motor on a spring, measured in the ways in which people record such data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import experiment_from_log
from levid.identification.greybox.identify_greybox import identify_grey_box
from levid.log.reader import read_log

MASS_KG, DAMPING_NS_M, STIFFNESS_N_M, FORCE_N_A = 0.5, 10.0, 8000.0, 20.0
"""Natural frequency 20.1 Hz, damping ratio 0.08, static gain 2.5 mm/A."""
NOISE_M = 2e-6
RATE_HZ = 500.0

MODEL = f"""
levid: model
name: motor
dof: [{{name: position_m, unit: m}}]
inputs: [{{name: current_a, unit: A}}]
parameters:
  d: {{value: 5, unit: N s/m, min: 0, max: 100, about: damping}}
  k: {{value: 5000, unit: N/m, min: 100, max: 100000, about: stiffness}}
  c: {{value: 10, unit: N/A, min: 0.1, max: 1000, about: force constant}}
M: [[{MASS_KG}]]
D: [[d]]
K: [[k]]
B: [[c]]
"""


@dataclass(frozen=True)
class Measurement:
    """Time in s, current in A and position in m, each (N,)."""

    time_s: np.ndarray
    current_a: np.ndarray
    position_m: np.ndarray


def measured(time_s: np.ndarray, current_a: np.ndarray, seed: int = 1) -> Measurement:
    """Return the motor's position at times (N,) for a current that is held from time to time."""
    rng = np.random.default_rng(seed)
    A = np.array([[0.0, 1.0], [-STIFFNESS_N_M / MASS_KG, -DAMPING_NS_M / MASS_KG]])
    poles, modes = np.linalg.eig(A)
    b = np.linalg.solve(modes, np.array([0.0, FORCE_N_A / MASS_KG]))
    x, position = np.zeros(2, complex), np.zeros(len(time_s))
    for k, step_s in enumerate(np.diff(time_s), 1):
        decay = np.exp(poles * step_s)
        x = decay * x + (decay - 1.0) / poles * b * current_a[k - 1]
        position[k] = (modes @ x)[0].real
    return Measurement(time_s, current_a, position + NOISE_M * rng.standard_normal(len(time_s)))


def parameters(*logs: Path) -> dict[str, float]:
    """Return the parameters of MODEL, fitted to imported logs, over their true values."""
    model = parse_text(MODEL, ModelConfig, "motor")
    experiments = [experiment_from_log(read_log(log), model) for log in logs]
    fitted = identify_grey_box(model, experiments, 0.25).fitted.parameters
    true = {"d": DAMPING_NS_M, "k": STIFFNESS_N_M, "c": FORCE_N_A}
    return {name: fitted[name].value / value for name, value in true.items()}


def uniform(rows: int = 4000, clip_a: float = np.inf) -> Measurement:
    """Return a record at RATE_HZ with a current that changes at random every row, RMS 1 A."""
    current_a = np.random.default_rng(3).standard_normal(rows)
    return measured(np.arange(rows) / RATE_HZ, np.clip(current_a, -clip_a, clip_a))
