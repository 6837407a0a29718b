"""Simulate a stage that sticks at rest, and a motor that drives a load through a shaft.

They are integrated step by step, with no code of levid. At rest, dry friction balances any force up
to its level, as on a real machine. Steps are so short that the simulation errs by a tenth of what
the records tell of the numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import copysign, cos, exp, pi, sin

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

TS, STEPS = 2e-3, 80
"""Time between rows in s, and steps of integration in a row."""
_REST_ROWS = 100


@dataclass(frozen=True)
class Stage:
    """A linear stage in a PID loop, with dry friction, a Stribeck peak, cogging and drag."""

    m: float = 3.2
    d: float = 17.0
    kf: float = 40.0
    friction: float = 0.0
    peak: float = 0.0
    v_s: float = 0.01
    cogging: float = 0.0
    pitch: float = 0.03
    drag: float = 0.0

    def flown(self, seed: int, rows: int = 5000) -> tuple[Array, Array]:
        """Return currents and positions (rows, 1) of smooth moves that end at rest."""
        numbers = self.m, self.d, self.kf, self.friction, self.peak, self.v_s
        periodic = self.cogging, self.pitch, self.drag
        u, y = _fly_stage(np.array([*numbers, *periodic]), _moves(seed, 0.08, rows))
        return u, y + np.random.default_rng(seed).normal(0.0, 3e-7, y.shape)


@dataclass(frozen=True)
class Shaft:
    """A motor and a load that a shaft joins, with a gap of half width `half` or a cubic spring.

    In the gap, neither spring nor damper of the shaft acts.
    """

    j1: float = 9e-4
    j2: float = 1.1e-3
    d1: float = 2.4e-3
    k: float = 20.0
    c: float = 0.012
    half: float = 0.0
    k3: float = 0.0

    def flown(self, seed: int, rows: int = 5000) -> tuple[Array, Array]:
        """Return torques (rows, 1) and both angles (rows, 2); a soft loop holds the motor at 0."""
        rng = np.random.default_rng(seed)
        hz, phase = rng.uniform(0.5, 18.0, 12), rng.uniform(0.0, 2 * pi, 12)
        numbers = self.j1, self.j2, self.d1, self.k, self.c, self.half, self.k3
        u, y = _fly_shaft(np.array(numbers), hz, phase, rows)
        return u, y + rng.normal(0.0, 2e-6, y.shape)


@njit(cache=True)
def _fly_stage(numbers: Array, set_points: Array) -> tuple[Array, Array]:
    """Return currents and positions (rows, 1) of a stage in its loop."""
    m, d, kf, friction, peak, v_s, cogging, pitch, drag = numbers
    u, y = np.zeros((len(set_points), 1)), np.zeros((len(set_points), 1))
    x = v = integral = last = 0.0
    h = TS / STEPS
    for k in range(len(set_points)):
        error = set_points[k] - x
        integral += 470.0 * m * TS * error
        force = m * (280.0 * error + 12.5 * (error - last) / TS) + integral
        u[k, 0], y[k, 0], last = force / kf, x, error
        for _ in range(STEPS):
            # Half a step of x, one of v, half a step of x: of second order.
            x += 0.5 * h * v
            acting = force + cogging * sin(2 * pi * x / pitch + 0.4)
            level = friction + peak * exp(-((v / v_s) ** 2))
            if v == 0.0 and abs(acting) <= level:
                continue
            slows = 0.5 * h * (d + drag * abs(v)) / m
            way = v if v != 0.0 else acting
            push = h * (acting - copysign(level, way)) / m
            after = ((1.0 - slows) * v + push) / (1.0 + slows)
            if level > 0.0 and v * after < 0.0:
                # It stops within the step, and moves on if more than friction acts.
                rest = after / (after - v)
                x -= 0.5 * h * v * rest
                more = max(abs(acting) - level, 0.0)
                after = copysign(rest * h * more / m, acting)
                x += 0.5 * h * after * (rest - 1.0)
            v = after
            x += 0.5 * h * v
    return u, y


@njit(cache=True)
def _fly_shaft(numbers: Array, hz: Array, phase: Array, rows: int) -> tuple[Array, Array]:
    """Return torques (rows, 1) and angles (rows, 2), by the classic method of Runge and Kutta."""
    u, y, h = np.zeros((rows, 1)), np.zeros((rows, 2)), TS / STEPS
    x = np.zeros(4)
    for k in range(rows):
        torque = -0.05 * x[0]
        for i in range(len(hz)):
            torque += 0.06 * cos(2 * pi * hz[i] * k * TS + phase[i])
        u[k, 0], y[k] = torque, x[:2]
        for _ in range(STEPS):
            a = _rate(x, torque, numbers)
            b = _rate(x + 0.5 * h * a, torque, numbers)
            c = _rate(x + 0.5 * h * b, torque, numbers)
            e = _rate(x + h * c, torque, numbers)
            x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + e)
    return u, y


@njit(cache=True)
def _rate(x: Array, torque: float, numbers: Array) -> Array:
    j1, j2, d1, k, c, half, k3 = numbers
    twist, contact = x[0] - x[1], 0.0
    if half == 0.0 or abs(twist) > half:
        stretch = twist - copysign(half, twist)
        contact = k * stretch + k3 * stretch**3 + c * (x[2] - x[3])
    return np.array([x[2], x[3], (torque - d1 * x[2] - contact) / j1, contact / j2])


def _moves(seed: int, reach: float, rows: int) -> Array:
    """Return set points (rows,): smooth moves between random places, each followed by a rest."""
    rng = np.random.default_rng(seed)
    found, at = [np.zeros(_REST_ROWS)], 0.0
    while sum(map(len, found)) < rows:
        there, n = rng.uniform(-reach, reach), int(rng.uniform(120, 300))
        s = np.linspace(0.0, 1.0, n)
        found += [at + (there - at) * (10 * s**3 - 15 * s**4 + 6 * s**5), np.full(n, there)]
        at = there
    return np.concatenate(found)[:rows]
