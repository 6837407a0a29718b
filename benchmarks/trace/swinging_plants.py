"""Simulate plants with one or two axes whose sensors err, whose thrust lags, or whose arm swings.

Written independently of the model: explicit equations in steps of an eightieth of a row, by the
midpoint rule, so that the simulation errs by less than the records tell of the numbers. Inputs are
random below a frequency and held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lfilter

Array = NDArray[np.float64]

STEPS = 80


@dataclass(frozen=True)
class Plant:
    """Two axes, of which the second may be an arm on the first; one axis if m2 is 0.

    m, d, k: mass, damping, stiffness; h: coupling with the arm, w: its weight. lag_s, squared: of
    the thrust over the first command. cross: share of the first command at the second axis. cog,
    pitch: cogging of the first axis. bend2, bend3: the first position is r + bend2 r^2 + bend3 r^3.
    late_s: lag of its reading. mix: share of the first position in the second reading. noise: of
    the readings, over the deviation of the motion.
    """

    m1: float
    d1: float
    k1: float
    m2: float = 0.0
    d2: float = 0.0
    k2: float = 0.0
    h: float = 0.0
    w: float = 0.0
    lag_s: float = 0.0
    squared: bool = False
    mean: float = 0.0
    cross: float = 0.0
    cog: float = 0.0
    pitch: float = 1.0
    bend2: float = 0.0
    bend3: float = 0.0
    late_s: float = 0.0
    mix: float = 0.0
    Ts_s: float = 5e-3
    rows: int = 6000
    below_hz: float = 5.0
    sizes: tuple[float, float] = (10.0, 10.0)
    noise: float = 1e-3

    @property
    def axes(self) -> int:
        """Number of axes with a mass."""
        return 1 + (self.m2 > 0.0)

    @property
    def inputs(self) -> int:
        """Number of inputs: an arm has none."""
        return 1 if self.h else self.axes

    def flown(self, seed: int) -> tuple[Array, Array]:
        """Return inputs (rows, inputs) and readings (rows, axes) of one record."""
        rng = np.random.default_rng(seed)
        share = rng.uniform(0.5, 1.0)
        u = lfilter(
            *butter(2, 2.0 * self.below_hz * self.Ts_s), rng.standard_normal((self.rows, 2)), axis=0
        )
        u = self.mean + share * np.array(self.sizes) * np.clip(u / u.std(axis=0), -2.5, 2.5)
        numbers = np.array([
            self.m1, self.d1, self.k1, self.m2 or 1.0, self.d2, self.k2, self.h, self.w, self.lag_s,
            float(self.squared), self.cross, self.cog, self.pitch,
        ])  # fmt: skip
        q = _fly(u, numbers, float(self.Ts_s), STEPS)[:, : self.axes]
        y = self._read(q)
        y = y + self.noise * y.std(axis=0) * rng.standard_normal(y.shape)
        return u[:, : self.inputs], y

    def _read(self, q: Array) -> Array:
        y = q.copy()
        r = q[:, 0].copy()
        for _ in range(40):
            over = r + self.bend2 * r**2 + self.bend3 * r**3 - q[:, 0]
            r -= over / (1.0 + 2.0 * self.bend2 * r + 3.0 * self.bend3 * r**2)
        y[:, 0] = _lagged(r, self.late_s, self.Ts_s) if self.late_s else r
        if self.mix:
            y[:, 1] += self.mix * q[:, 0]
        return y


def _lagged(values: Array, lag_s: float, Ts_s: float, fine: int = 50) -> Array:
    at = np.arange(len(values), dtype=float)
    between = CubicSpline(at, values)(np.arange(fine * len(values)) / fine)
    left = np.exp(-Ts_s / fine / lag_s)
    half = 0.5 * (1.0 - left)
    return np.asarray(lfilter([half, half], [1.0, -left], between)[::fine])


@njit(cache=True)
def _fly(u: Array, p: Array, Ts_s: float, steps: int) -> Array:
    m1, d1, k1, m2, d2, k2, h, w, lag_s, squared, cross, cog, pitch = p
    q, v, speed = np.zeros(2), np.zeros(2), u[0, 0]
    if squared > 0.0:
        q[0] = speed * abs(speed) / k1
    found, a = np.empty((len(u), 2)), np.zeros(2)
    for row in range(len(u)):
        found[row] = q
        for _ in range(steps):
            begin_q, begin_v = q.copy(), v.copy()
            for part in (0.5, 1.0):
                thrust = u[row, 0]
                if lag_s > 0.0:
                    since = (0.0 if part == 0.5 else 0.5) * Ts_s / steps
                    thrust += (speed - thrust) * np.exp(-since / lag_s)
                if squared > 0.0:
                    thrust = thrust * abs(thrust)
                c, s = np.cos(q[1]), np.sin(q[1])
                f1 = thrust - d1 * v[0] - k1 * q[0] + cog * np.sin(2.0 * np.pi * q[0] / pitch)
                f2 = cross * u[row, 0] - d2 * v[1] - k2 * q[1] - w * s
                if h > 0.0:
                    f1 += h * s * v[1] ** 2
                    det = m1 * m2 - (h * c) ** 2
                    a[0], a[1] = (m2 * f1 - h * c * f2) / det, (m1 * f2 - h * c * f1) / det
                else:
                    a[0], a[1] = f1 / m1, (f2 + u[row, 1]) / m2
                q = begin_q + part * Ts_s / steps * v
                v = begin_v + part * Ts_s / steps * a
            if lag_s > 0.0:
                speed = u[row, 0] + (speed - u[row, 0]) * np.exp(-Ts_s / steps / lag_s)
    return found
