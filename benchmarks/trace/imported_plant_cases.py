"""Draw plants that are not the rig, without an effect, and the model that is declared for each.

A drive on triangles in a loop, a motor with a geared load (outputs: motor and twist), a pendulum in
open loop, a stage with two coupled axes, a magnet that levitates in a loop and is unstable without,
a helicopter on a stand, whose propellers turn both axes by gains of which only a half is known.
Declared parameters are 10 to 20 % off; the declared input gain is exact, or off by 2 to 8 %: then
all forces of the model are, in the same ratio.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, lfilter

from levid.benchmarks.trace.imported_plant_simulation import Linear, Motion
from levid.config.base import parse
from levid.config.model import ModelConfig

Array = NDArray[np.float64]
Generator = np.random.Generator

OFF, GAIN_OFF = (0.1, 0.2), (0.02, 0.08)
"""Relative errors of declared parameters and of the input gain, of random sign."""


@dataclass(frozen=True)
class Plant:
    """A plant before it has an effect: names and units, parameters, matrices, reference signals.

    parameters: values with units; matrices: entries of M, D, K are sums of parameter names; of B,
    if it is there, names of those that are free. gain (n, m): B. v (N, m). noise: of y, over the
    standard deviation of the motion.
    """

    dof: dict[str, str]
    inputs: dict[str, str]
    parameters: dict[str, tuple[float, str]]
    matrices: dict[str, list[list[str]]]
    gain: Array
    Ts_s: float
    v: Array
    kp: Array
    kd: Array
    noise: float
    steps: int = 10
    reach: float | None = None
    """Standard deviation of the first output without an effect, which sizes v; None: v is sized."""

    def linear(self, noise: Array) -> Linear:
        """Return its matrices."""
        M, D, K = (self._matrix(self.matrices[name]) for name in "MDK")
        B, kp, kd = self.gain, self.kp, self.kd
        return Linear(M, D, K, B, kp, kd, noise, self.Ts_s, self.steps)

    def unexplained(self, motion: Motion) -> float:
        """Return the norm of what parameters and constant forces leave of the effect's force."""
        n = len(self.dof)
        columns = []
        for name in self.parameters:
            column = np.zeros_like(motion.q)
            signals = {"M": motion.a, "D": motion.w, "K": motion.q, "B": motion.u}
            for key, rows in self.matrices.items():
                has = [[name in e.split(" + ") for e in row] for row in rows]
                column += signals[key] @ np.array(has, dtype=float).T
            columns.append(column.reshape(-1))
        columns += [np.tile(np.eye(n)[i], len(motion.q)) for i in range(n)]
        X = np.stack(columns, axis=1)
        Q, _ = np.linalg.qr(X / np.linalg.norm(X, axis=0))
        effect = motion.effect.reshape(-1)
        return float(np.linalg.norm(effect - Q @ (Q.T @ effect)))

    def _matrix(self, rows: list[list[str]]) -> Array:
        known = {name: value for name, (value, _) in self.parameters.items()}
        entries = [[sum(known[t] for t in e.split(" + ") if t) for e in r] for r in rows]
        return np.array(entries, dtype=float)


def low_pass_noise(rng: Generator, rows: int, Ts_s: float, limit_hz: float) -> Array:
    """Return noise (rows,) of unit deviation below the limit."""
    u = lfilter(*butter(2, 2.0 * limit_hz * Ts_s), rng.normal(size=rows))
    return np.asarray(u / np.std(u))


def drive(rng: Generator) -> Plant:
    """Return a drive that follows triangles of 0.4 m/s, plus noise below 15 Hz; 20 s at 500 Hz."""
    Ts_s, rows = 0.002, 10_000
    m, d = rng.uniform(5, 20), rng.uniform(10, 60)
    kp, kd = m * 40.0**2, 0.3 * m * 40.0 * 1.2 / Ts_s
    path = np.repeat(rng.choice([-1.0, 1.0], rows // 250), 250)
    path, t = 0.4 * Ts_s * np.cumsum(path), np.arange(rows)
    path -= np.polyval(np.polyfit(t, path, 1), t)
    path -= path[0]
    v = kp * path + kd * np.diff(path, prepend=0.0)
    v += 1e-3 * kp * low_pass_noise(rng, rows, Ts_s, 15.0)
    parameters = {"m": (m, "kg"), "d": (d, "N s/m")}
    return Plant(
        {"x": "m"}, {"f": "N"}, parameters, {"M": [["m"]], "D": [["d"]], "K": [[""]]},
        np.eye(1), Ts_s, v[:, None], np.array([[kp]]), np.array([[kd]]), 1e-5, 20,
    )  # fmt: skip


def geared(rng: Generator) -> Plant:
    """Return a motor with a geared load, 20 s at 1 kHz: angles of the motor and of the twist."""
    Ts_s, rows = 0.001, 20_000
    j_1, j_2 = rng.uniform(1e-3, 3e-3), rng.uniform(1e-3, 4e-3)
    k_c = (2 * np.pi * rng.uniform(12.0, 20.0)) ** 2 / (1 / j_1 + 1 / j_2)
    d_1, d_2, d_c = rng.uniform((0.02, 0.01, 0.01), (0.06, 0.03, 0.03))
    kp = (j_1 + j_2) * (2 * np.pi * 1.0) ** 2
    kd = 0.3 * kp / (2 * np.pi * 1.0) / Ts_s
    v = rng.uniform(0.5, 2.0) * low_pass_noise(rng, rows, Ts_s, 20.0)
    inertia, damping = "kg m2", "N m s/rad"
    parameters = {
        "j_1": (j_1, inertia), "j_2": (j_2, inertia), "d_1": (d_1, damping),
        "d_2": (d_2, damping), "d_c": (d_c, damping), "k_c": (k_c, "N m/rad"),
    }  # fmt: skip
    matrices = {
        "M": [["j_1 + j_2", "j_2"], ["j_2", "j_2"]],
        "D": [["d_1 + d_2", "d_2"], ["d_2", "d_2 + d_c"]],
        "K": [["", ""], ["", "k_c"]],
    }
    dof, gain = {"motor": "rad", "twist": "rad"}, np.array([[1.0], [0.0]])
    kp_kd = np.array([[kp, 0.0]]), np.array([[kd, 0.0]])
    return Plant(dof, {"t": "N m"}, parameters, matrices, gain, Ts_s, v[:, None], *kp_kd, 1e-4)


def pendulum(rng: Generator) -> Plant:
    """Return a pendulum driven by noise below 0.8 Hz to 0.3 to 0.6 rad; 60 s at 100 Hz."""
    Ts_s = 0.01
    m, d, k, b = (rng.uniform(*r) for r in ((0.05, 0.2), (0.02, 0.1), (0.5, 2.0), (0.2, 0.5)))
    v = low_pass_noise(rng, 6000, Ts_s, 0.8)[:, None]
    parameters = {"m": (m, "kg m2"), "d": (d, "N m s/rad"), "k": (k, "N m/rad")}
    matrices, none = {"M": [["m"]], "D": [["d"]], "K": [["k"]]}, np.zeros((1, 1))
    axes = {"q": "rad"}, {"u": "V"}
    gain, reach = np.array([[b]]), rng.uniform(0.3, 0.6)
    return Plant(*axes, parameters, matrices, gain, Ts_s, v, none, none, 1e-3, reach=reach)


def stage(rng: Generator) -> Plant:
    """Return a stage with axes in m and rad, damped by its loop, whose stiffness couples them;
    noise up to 25 Hz, 20 s at 500 Hz."""
    Ts_s = 0.002
    m, d, k = rng.uniform(((2, 0.01), (5, 0.05), (500, 5)), ((5, 0.03), (20, 0.2), (2000, 20)))
    k_xr = 0.3 * rng.uniform(-1.0, 1.0) * np.sqrt(k[0] * k[1])
    kd = np.diag(np.array([1.8, 0.9]) * m / Ts_s)
    v = [a * low_pass_noise(rng, 10_000, Ts_s, hz) for a, hz in ((3.0, 20.0), (0.05, 25.0))]
    parameters = {
        "m_x": (m[0], "kg"), "m_r": (m[1], "kg m2"), "d_x": (d[0], "N s/m"),
        "d_r": (d[1], "N m s/rad"), "k_x": (k[0], "N/m"), "k_r": (k[1], "N m/rad"),
        "k_xr": (k_xr, "N/rad"),
    }  # fmt: skip
    matrices = {
        "M": [["m_x", ""], ["", "m_r"]],
        "D": [["d_x", ""], ["", "d_r"]],
        "K": [["k_x", "k_xr"], ["k_xr", "k_r"]],
    }
    dof, inputs = {"x": "m", "r": "rad"}, {"f": "N", "t": "N m"}
    loop = np.eye(2), Ts_s, np.stack(v, axis=1), np.zeros((2, 2)), kd
    return Plant(dof, inputs, parameters, matrices, *loop, 10.0 ** rng.uniform(-4.0, -3.0))


def levitation(rng: Generator) -> Plant:
    """Return a magnet that pulls a mass upwards around its working point; 20 s at 1 kHz."""
    Ts_s = 0.001
    m, y0, i0 = rng.uniform(0.03, 0.2), rng.uniform(0.004, 0.015), rng.uniform(0.5, 2.0)
    weight = 9.81 * m
    b, k = 2.0 * weight / i0, -2.0 * weight / y0
    rate = 2 * np.pi * rng.uniform(6.0, 12.0)
    kp, kd = (m * rate**2 - k) / b, 1.4 * m * rate / b
    v = 0.08 * y0 * m * rate**2 / b * low_pass_noise(rng, 20_000, Ts_s, 12.0)
    parameters = {"m": (m, "kg"), "d": (rng.uniform(0.05, 0.2) * m * rate, "N s/m")}
    parameters["k"] = (k, "N/m")
    matrices = {"M": [["m"]], "D": [["d"]], "K": [["k"]]}
    loop = np.array([[b]]), Ts_s, v[:, None], np.array([[kp]]), np.array([[kd / Ts_s]])
    return Plant({"y": "m"}, {"i": "A"}, parameters, matrices, *loop, 3e-4)


def helicopter(rng: Generator) -> Plant:
    """Return a helicopter on a stand, yaw held by a slow loop; noise up to 2 Hz, 40 s at 200 Hz.

    What each propeller does to its own axis is known, what it does to the other one is free.
    """
    Ts_s = 0.005
    (j_p, j_y), (d_p, d_y) = rng.uniform(((0.02, 0.02), (0.03, 0.05)), ((0.06, 0.06), (0.1, 0.1)))
    k_p, b = rng.uniform(0.2, 0.6), rng.uniform(0.04, 0.08, 2)
    c = b * rng.uniform(0.1, 0.3, 2) * rng.choice([-1.0, 1.0], 2)
    rate = 2 * np.pi * 0.3
    kp = np.diag([0.0, j_y * rate**2 / b[1]])
    kd = np.diag([0.0, 1.4 * j_y * rate / b[1] / Ts_s])
    v = 2.0 * np.stack([low_pass_noise(rng, 8000, Ts_s, 2.0) for _ in b], axis=1)
    parameters = {
        "j_p": (j_p, "kg m2"), "j_y": (j_y, "kg m2"), "d_p": (d_p, "N m s/rad"),
        "d_y": (d_y, "N m s/rad"), "k_p": (k_p, "N m/rad"),
        "k_py": (float(c[0]), "N m/V"), "k_yp": (float(c[1]), "N m/V"),
    }  # fmt: skip
    matrices = {
        "M": [["j_p", ""], ["", "j_y"]],
        "D": [["d_p", ""], ["", "d_y"]],
        "K": [["k_p", ""], ["", ""]],
        "B": [["", "k_py"], ["k_yp", ""]],
    }
    gain = np.array([[b[0], c[0]], [c[1], b[1]]])
    dof, inputs = {"pitch": "rad", "yaw": "rad"}, {"v_p": "V", "v_y": "V"}
    noise = 10.0 ** rng.uniform(-4.0, -3.0)
    return Plant(dof, inputs, parameters, matrices, gain, Ts_s, v, kp, kd, noise)


PLANTS: Mapping[str, Callable[[Generator], Plant]] = {
    f.__name__: f for f in (drive, geared, pendulum, stage, levitation, helicopter)
}
"""Functions that draw a plant, by name."""


def declared(plant: Plant, rng: Generator, gain_off: bool) -> tuple[ModelConfig, float]:
    """Return the linear model that is declared, and its input gain over the true one."""
    ratio = 1.0 + gain_off * rng.choice([-1.0, 1.0]) * rng.uniform(*GAIN_OFF)
    parameters = {}
    for name, (value, unit) in plant.parameters.items():
        start = value * (1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(*OFF))
        wide = sorted((0.02 * value, 50.0 * value))
        if name.startswith("k"):
            wide = [-50.0 * abs(value), 50.0 * abs(value)]
        if name.startswith("d"):
            wide = [0.0, 50.0 * value]
        parameters[name] = {"value": start, "unit": unit, "min": wide[0], "max": wide[1]}
    axes = {"dof": plant.dof, "inputs": plant.inputs}
    named = {k: [{"name": n, "unit": u} for n, u in a.items()] for k, a in axes.items()}
    entries = {k: [[e or 0.0 for e in r] for r in rows] for k, rows in plant.matrices.items()}
    known = (ratio * plant.gain).tolist()
    free = plant.matrices.get("B", [[""] * len(plant.inputs)] * len(plant.dof))
    B = [[f or k for f, k in zip(*rows, strict=True)] for rows in zip(free, known, strict=True)]
    plain: dict[str, Any] = {"levid": "model", "name": "plant", "parameters": parameters}
    plain |= {**named, **entries, "B": B}
    return parse(plain, ModelConfig, "plant"), float(ratio)
