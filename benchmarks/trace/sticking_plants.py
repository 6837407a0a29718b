"""Simulate a stage that sticks at rest, and a motor that drives a load through a shaft.

They are integrated step by step, with no code of levid. At rest, dry friction balances any force up
to its level, as on a real machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import copysign, cos, exp, pi, sin

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TS, STEPS = 2e-3, 10
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
        set_points = _moves(seed, 0.08, rows)
        u, y = np.zeros((rows, 1)), np.zeros((rows, 1))
        x = v = integral = last = 0.0
        h = TS / STEPS
        for k in range(rows):
            error = set_points[k] - x
            integral += 470.0 * self.m * TS * error
            force = self.m * (280.0 * error + 12.5 * (error - last) / TS) + integral
            u[k], y[k], last = force / self.kf, x, error
            for _ in range(STEPS):
                # Half a step of x, one of v, half a step of x: of second order.
                x += 0.5 * h * v
                acting = force + self.cogging * sin(2 * pi * x / self.pitch + 0.4)
                level = self.friction + self.peak * exp(-((v / self.v_s) ** 2))
                if v == 0.0 and abs(acting) <= level:
                    continue
                slows = 0.5 * h * (self.d + self.drag * abs(v)) / self.m
                push = h * (acting - copysign(level, v or acting)) / self.m
                after = ((1.0 - slows) * v + push) / (1.0 + slows)
                if level and v * after < 0.0:
                    # It stops within the step, and moves on if more than friction acts.
                    rest = after / (after - v)
                    x -= 0.5 * h * v * rest
                    more = max(abs(acting) - level, 0.0)
                    after = copysign(rest * h * more / self.m, acting)
                    x += 0.5 * h * after * (rest - 1.0)
                v = after
                x += 0.5 * h * v
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
        tones = list(zip(hz.tolist(), phase.tolist(), strict=True))
        u, y = np.zeros((rows, 1)), np.zeros((rows, 2))
        q1 = q2 = v1 = v2 = 0.0
        h = TS / STEPS
        for k in range(rows):
            torque = 0.06 * sum(cos(2 * pi * f * k * TS + p) for f, p in tones) - 0.05 * q1
            u[k], y[k] = torque, (q1, q2)
            for _ in range(STEPS):
                q1, q2, v1, v2 = self._after(h, q1, q2, v1, v2, torque)
        return u, y + rng.normal(0.0, 2e-6, y.shape)

    def _after(
        self, h: float, q1: float, q2: float, v1: float, v2: float, torque: float
    ) -> tuple[float, float, float, float]:
        """Return the motion after h seconds, by the classic method of Runge and Kutta."""
        a1, a2 = self._accelerations(q1 - q2, v1, v2, torque)
        sums = [v1, v2, a1, a2]
        w1, w2 = v1, v2
        for part, weight in ((0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
            twist = q1 - q2 + part * h * (w1 - w2)
            w1, w2 = v1 + part * h * a1, v2 + part * h * a2
            a1, a2 = self._accelerations(twist, w1, w2, torque)
            sums = [s + weight * x for s, x in zip(sums, (w1, w2, a1, a2), strict=True)]
        dq1, dq2, dv1, dv2 = (h / 6.0 * s for s in sums)
        return q1 + dq1, q2 + dq2, v1 + dv1, v2 + dv2

    def _accelerations(
        self, twist: float, v1: float, v2: float, torque: float
    ) -> tuple[float, float]:
        contact = 0.0
        if not self.half or abs(twist) > self.half:
            stretch = twist - copysign(self.half, twist)
            contact = self.k * stretch + self.k3 * stretch**3 + self.c * (v1 - v2)
        return (torque - self.d1 * v1 - contact) / self.j1, contact / self.j2


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
