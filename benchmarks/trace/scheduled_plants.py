"""Trace plants whose inertia, stiffness, input gain and weight move with a scheduling variable.

A carriage travels along a beam that turns in a soft bearing: its inertia about the bearing, the
spring that it compresses and the torque of its weight depend on where it is, and the lever of the
actuator does. The records are of the beam under a random command while the carriage moves. The
simulation is written independently of the model.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.signal import butter, lfilter

from levid.benchmarks.trace.judged_plants import RECORDS, Named, Result, result, show_plants, traced
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.subspace.response_uncertainty import SURE_95

Array = NDArray[np.float64]

FIRST_SEED = 86_000
STEPS, TS_S, ROWS = 10, 2e-3, 12_000
LACKS: dict[str, frozenset[Named]] = {
    "nothing missing": frozenset(),
    "hardening spring": frozenset({("stiffness", ("q",))}),
    "dry friction": frozenset({("friction", ("q",))}),
    "delay": frozenset({("delay", ("u",))}),
}
MODEL = """
levid: model
name: beam
dof: [{name: q, unit: rad}]
inputs: [{name: u, unit: N m}]
parameters: {PARAMETERS}
scheduling: {s: {unit: '1', signal: s, min: -1, max: 1}}
M: [[j + j_s * s**2]]
D: [[d]]
K: [[k + k_s * s]]
B: [[1 + LEVER * s]]
force: [g_s * s]
"""
NAMES = ("j", "j_s", "d", "k", "k_s", "g_s")


@dataclass(frozen=True)
class Beam:
    """A beam with a carriage at s, -1 to 1, and what its model may lack, in SI units.

    numbers: inertia j + j_s s^2, damping d, stiffness k + k_s s, weight g_s s. lever: of the
    input, 1 + lever s. travel_hz: how often the carriage goes to and fro in a second. noise_rad: of
    the readings. cubic in N m/rad^3, stick in N m and late_rows of delay are what its model lacks.
    """

    numbers: tuple[float, ...]
    lever: float
    travel_hz: float
    noise_rad: float
    cubic: float = 0.0
    stick: float = 0.0
    late_rows: int = 0

    @classmethod
    def drawn(cls, kind: str, rng: np.random.Generator) -> Beam:
        """Return a beam that swings by about a tenth of a radian with 2 to 6 Hz."""
        j, rate = rng.uniform(0.5, 2.0), 2 * np.pi * rng.uniform(2.0, 6.0)
        k = j * rate**2
        beam = cls(
            (j, rng.uniform(0.2, 0.6) * j, 2 * rng.uniform(0.1, 0.3) * rate * j, k,
             rng.uniform(-0.4, 0.4) * k, rng.uniform(0.01, 0.04) * k),
            rng.uniform(-0.3, 0.3), rng.uniform(0.05, 0.3), 0.1 * 10.0 ** rng.uniform(-4.0, -3.0),
        )  # fmt: skip
        share = rng.uniform(0.05, 0.4)
        if kind == "hardening spring":
            return replace(beam, cubic=share * k / 0.1**2)
        if kind == "dry friction":
            return replace(beam, stick=share * 0.1 * k)
        return replace(beam, late_rows=int(rng.integers(1, 4))) if kind == "delay" else beam

    def flown(self, seed: int) -> tuple[Array, Array, Array]:
        """Return commands, readings (rows, 1) and the carriage's position (rows,) of a record."""
        rng = np.random.default_rng(seed)
        v = lfilter(*butter(2, 2.0 * rng.uniform(8.0, 15.0) * TS_S), rng.standard_normal(ROWS))
        rise = 2 * np.pi * self.travel_hz * np.arange(ROWS * STEPS) * TS_S / STEPS
        s = 0.9 * np.sin(rise + rng.uniform(0, 2 * np.pi))
        u = 0.2 * self.numbers[3] * rng.uniform(0.5, 1.0) * v / v.std()
        more = np.array([*self.numbers, self.lever, self.cubic, self.stick])
        q = _fly(more, u, s, self.late_rows, TS_S, STEPS)
        y = q + self.noise_rad * rng.standard_normal(ROWS)
        return u[:, None], y[:, None], s[::STEPS]


@njit(cache=True)
def _fly(p: Array, u: Array, s: Array, late: int, Ts_s: float, steps: int) -> Array:
    j, j_s, d, k, k_s, g_s, lever, cubic, stick = p
    q, w, h = g_s * s[0] / k, 0.0, Ts_s / steps
    found = np.zeros(len(u))
    for row in range(len(u)):
        found[row] = q
        acting = u[max(row - late, 0)]
        for step in range(steps):
            at = s[row * steps + step]
            inertia, stiffness = j + j_s * at**2, k + k_s * at
            push = (1.0 + lever * at) * acting + g_s * at
            half = w + 0.5 * h * _pull(push, d, stiffness, cubic, stick, q, w) / inertia
            middle = q + 0.5 * h * w
            a = _pull(push, d, stiffness, cubic, stick, middle, half) / inertia
            q, w = q + h * half, w + h * a
    return found


@njit(cache=True)
def _pull(push: float, d: float, k: float, cubic: float, stick: float, q: float, w: float) -> float:
    return push - d * w - k * q - cubic * q**3 - stick * np.tanh(w / 1e-3)


def declared(beam: Beam, rng: np.random.Generator) -> ModelConfig:
    """Return the model with its parameters 10 to 20 % off."""
    entries = []
    for name, value in zip(NAMES, beam.numbers, strict=True):
        start = value * (1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.2))
        wide = 50.0 * abs(value)
        least = -wide if name in ("k_s", "g_s") else 0.02 * value
        bounds = f"unit: '1', min: {least:.9g}, max: {wide:.9g}"
        entries.append(f"{name}: {{value: {start:.9g}, {bounds}}}")
    text = MODEL.replace("PARAMETERS", ", ".join(entries)).replace("LEVER", f"{beam.lever:.9g}")
    return parse_text(text, ModelConfig, "model")


def judged(kind: str, seed: int) -> Result:
    """Return the result of one plant."""
    rng = np.random.default_rng(seed)
    beam = Beam.drawn(kind, rng)
    config = declared(beam, rng)
    flown = [beam.flown(RECORDS * seed + i) for i in range(RECORDS)]
    schedules = [{"s": s} for _, _, s in flown]
    trace = traced(config, [(u, y) for u, y, _ in flown], TS_S, schedules=schedules)
    point = trace.found.point

    def inside(_effects: Sequence[Mapping[str, Any]]) -> Iterator[bool]:
        numbers = zip(point.values, beam.numbers, trace.errors, strict=False)
        for value, true, se in numbers:
            yield bool(abs(value - true) <= SURE_95 * se)

    return result(kind, seed, trace, LACKS[kind], inside)


def main() -> None:
    """Print the figures of all plants."""
    show_plants("plants along a schedule", LACKS, judged, FIRST_SEED)


if __name__ == "__main__":
    main()
