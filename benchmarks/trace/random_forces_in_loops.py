"""Trace axes under random forces that nothing measures, such as turbulence, in a loop and without.

A loop answers the random force, so that its command follows it: the force balance then takes part
of the controller for the plant. Set points, or the commands of an axis without a loop, do not
depend on the force. The simulation is written independently of the model.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.signal import butter, lfilter

from levid.benchmarks.trace.judged_plants import RECORDS, Named, Result, result, show_plants, traced
from levid.benchmarks.trace.sensors_and_swings import ONE
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.subspace.response_uncertainty import SURE_95

Array = NDArray[np.float64]

FIRST_SEED = 80_000
STEPS = 10
TS_S, ROWS = 2e-3, 12_000
FRICTION, DELAY = ("friction", ("x",)), ("delay", ("f",))
LACKS: dict[str, frozenset[Named]] = {
    "nothing missing": frozenset(),
    "friction": frozenset({FRICTION}),
    "delay": frozenset({DELAY}),
}
RECORDED = ("a loop", "a loop with set points", "no loop")
KINDS = {f"{lack}, {recorded}": (lack, recorded) for recorded in RECORDED for lack in LACKS}


@dataclass(frozen=True)
class Axis:
    """An axis with mass, damping and stiffness in a PID loop, and what its model may lack.

    m1, d1, k1 in SI units. gains: kp, kd, ki. random: RMS of the random force below
    random_hz, over that of the loop's command. stick: dry friction, N. late_rows: delay of the
    command. noise: RMS of the reading's, over 1 cm.
    """

    m1: float
    d1: float
    k1: float
    gains: tuple[float, float, float]
    random: float
    random_hz: float
    stick: float = 0.0
    late_rows: int = 0
    noise: float = 1e-3

    @classmethod
    def drawn(cls, kind: str, rng: np.random.Generator) -> Axis:
        """Return an axis with a loop of two to four times its own rate."""
        m, rate = rng.uniform(1.0, 4.0), 2 * np.pi * rng.uniform(2.0, 4.0)
        loop = rng.uniform(2.0, 4.0) * rate
        gains = (m * (loop**2 - rate**2), 1.4 * m * loop, 0.2 * m * loop**3)
        axis = cls(
            m, 2 * rng.uniform(0.1, 0.3) * rate * m, rate**2 * m, gains, rng.uniform(0.05, 0.25),
            rng.uniform(4.0, 12.0),
        )  # fmt: skip
        if kind == "friction":
            # Over the force that moves it by 1 cm at 4 Hz.
            stick = 0.01 * (2 * np.pi * 4.0) ** 2 * m * rng.uniform(0.3, 0.6)
            return replace(axis, stick=stick)
        return replace(axis, late_rows=int(rng.integers(2, 4))) if kind == "delay" else axis

    def flown(self, seed: int, looped: bool = True) -> tuple[Array, Array, Array]:
        """Return command, reading and set point (rows, 1) of a record with random set points.

        The size of the random force is found from a record without it. Without the loop, the
        command is that of the loop without a random force and noise.
        """
        rng = np.random.default_rng(seed)
        wanted = 0.01 * rng.uniform(0.5, 1.0) * _below(rng.uniform(3.0, 6.0), rng)
        other = _below(self.random_hz, rng)
        noise = self.noise * 0.01 * rng.standard_normal(ROWS)
        numbers, none = np.array([self.m1, self.d1, self.k1, self.stick, *self.gains]), np.zeros(0)
        quiet = np.zeros(ROWS)
        u, _ = _fly(numbers, wanted, none, quiet, quiet, self.late_rows, TS_S, STEPS)
        force = self.random * u.std() * other
        given = none if looped else u
        u, y = _fly(numbers, wanted, given, force, noise, self.late_rows, TS_S, STEPS)
        return u[:, None], y[:, None], wanted[:, None]


def _below(limit_hz: float, rng: np.random.Generator) -> Array:
    x = lfilter(*butter(2, 2.0 * limit_hz * TS_S), rng.standard_normal(ROWS))
    return np.asarray(x / x.std())


@njit(cache=True)
def _fly(
    p: Array, wanted: Array, given: Array, force: Array, noise: Array, late: int, Ts_s: float,
    steps: int,
) -> tuple[Array, Array]:  # fmt: skip
    m, d, k, stick, kp, kd, ki = p
    q, v, whole, h = 0.0, 0.0, 0.0, Ts_s / steps
    u, y = np.zeros(len(wanted)), np.zeros(len(wanted))
    before = wanted[0]
    for row in range(len(wanted)):
        y[row] = q + noise[row]
        error = wanted[row] - y[row]
        whole += error * Ts_s
        rate = (error - before) / Ts_s
        before = error
        u[row] = given[row] if len(given) else kp * error + kd * rate + ki * whole
        acting = u[max(row - late, 0)] + force[row]
        for _ in range(steps):
            half = v + 0.5 * h * (acting - d * v - k * q - stick * np.tanh(v / 1e-3)) / m
            middle = q + 0.5 * h * v
            a = (acting - d * half - k * middle - stick * np.tanh(half / 1e-3)) / m
            q, v = q + h * half, v + h * a
    return u, y


def declared(axis: Axis, rng: np.random.Generator) -> ModelConfig:
    """Return a linear model with its parameters 10 to 20 % off."""
    entries = []
    for name in ("m1", "d1", "k1"):
        value = getattr(axis, name)
        off = 1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.2)
        bounds = f"min: 0, max: {50.0 * value:.9g}"
        entries.append(f"{name}: {{value: {off * value:.9g}, unit: '1', {bounds}}}")
    return parse_text(ONE.replace("PARAMETERS", ", ".join(entries)), ModelConfig, "model")


def judged(kind: str, seed: int) -> Result:
    """Return the result of one plant."""
    lack, recorded = KINDS[kind]
    rng = np.random.default_rng(seed)
    axis = Axis.drawn(lack, rng)
    config = declared(axis, rng)
    looped = recorded != "no loop"
    flown = [axis.flown(RECORDS * seed + i, looped) for i in range(RECORDS)]
    wanted = [points if recorded == "a loop with set points" else None for _, _, points in flown]
    trace = traced(config, [(u, y) for u, y, _ in flown], TS_S, wanted if looped else ())
    point = trace.found.point

    def inside(_effects: object) -> Iterator[bool]:
        numbers = zip(point.values, point.parameters.names, trace.errors, strict=False)
        for value, name, se in numbers:
            yield bool(abs(value - getattr(axis, name)) <= SURE_95 * se)

    return result(kind, seed, trace, LACKS[lack], inside)


def main() -> None:
    """Print the figures of all plants."""
    show_plants("axes under random forces, in a loop and without", KINDS, judged, FIRST_SEED)


if __name__ == "__main__":
    main()
