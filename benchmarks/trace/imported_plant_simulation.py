"""Simulate plants that are not the rig, with one effect, independently of levid's simulator.

M q'' + D q' + K q = B F(u) + the effect; the controller is u = v - kp y - kd dy, dy the change of y
over a period, y = q + noise. Commands are held over a period, in which the motion is integrated by
the midpoint rule. An effect is a Kind, a place (index of a DOF or an input) and up to four numbers,
of which the first one is its size.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Kind(IntEnum):
    """Effects: s is the first number of each; q, w position and speed, u command of the place."""

    NONE = 0
    COULOMB = 1  # -s tanh(w / v)
    STRIBECK = 2  # -s (1 + peak exp(-(w / v)^2)) tanh(10 w / v)
    ASYMMETRIC = 3  # -s (1 + share sign w) tanh(w / v)
    CUBIC = 4  # -s q^3
    QUADRATIC = 5  # -s q^2
    DRAG = 6  # -s |w| w
    SINE = 7  # -s (sin q - q): with K, -s sin q
    STOP = 8  # -s max(q - q0, 0)
    GAP = 9  # s clip(q, -half, half): with K = s, a spring with a gap
    COGGING = 10  # s sin(2 pi q / pitch + phase)
    LOOSE_MASS = 11  # a mass of s on a spring: frequency, damping
    RUBBED_UNEVENLY = 12  # -s (1 + share sin(q / length)) tanh(w / v)
    DRAG_15 = 13  # -s |w|^0.5 w
    SQUARED = 14  # F = u + s u |u|
    CUBED = 15  # F = u + s u^3
    WITH_SPEED = 16  # F = u (1 + s w)
    DEAD_ZONE = 17  # F = u - clip(u, -s, s)
    SATURATION = 18  # F = clip(u, -limit, limit), limit = 1 / s
    QUANTISED = 19  # F = round(u / s) s
    DRIFT = 20  # F = (1 - s t) u
    LAG = 21  # F follows u with the time constant s
    DELAY = 22  # F = u(t - s), s less than a period
    RIPPLE = 23  # F = u (1 + s sin(2 pi q / pitch))
    MAGNET = 24  # s ((1 + u / i0)^2 / (1 - q / y0)^2 less its linear part): number s, i0, y0
    TWO_GAINS = 25  # F = u + s |u|
    CREEP = 26  # -s (q - p), p follows q with the time constant
    SLEWED = 27  # F follows u by at most 1 / s in a second
    SECOND_ORDER = 28  # F'' + 2 damping w F' + w^2 F = w^2 u, w = 1 / s
    THINNING = 29  # -s w / (1 + |w| / v)
    LOADED_GEAR = 30  # F = u - s |u| tanh(w / v)
    PRELOAD = 31  # -s clip((q - q0) / width, -1, 1)
    BEARING = 32  # s (((1 + i)^2 / (1 - x)^2 - (1 - i)^2 / (1 + x)^2) / 4 - i - x), as MAGNET
    HYSTERESIS = 33  # F = u - s (u - p), p follows u at most half away
    LEVELING = 34  # -s w / (|w| + v)
    SOFT_SPRING = 35  # -s tanh(q / width)
    QUINTIC = 36  # -s q^5
    FOAM = 37  # -s (exp(q / d) - 1)
    PERMANENT_MAGNET = 38  # s (1 / (1 - q / y0)^2 - 1)
    CUBIC_DAMPER = 39  # -s w^3
    SHAFT = 40  # a mass of s on a soft shaft, in bearings: frequency, damping, slowing
    DRIFTING_DAMPING = 41  # -s t w
    DRIFTING_STIFFNESS = 42  # -s t q
    DRIFTING_MASS = 43  # -s t w'
    WARMING_FRICTION = 44  # -s (1 + share exp(-t / tau)) tanh(w / v): number s, v, share, tau
    BENT = 45  # a reading of q + s q^2
    WARMING_DAMPING = 46  # -s exp(-t / tau) w
    BUFFER = 47  # -s (q - q0 + tau w) beyond q0: number s, q0, tau, side


_FORCES_ON_DOF = (
    Kind.THINNING, Kind.PRELOAD, Kind.LEVELING, Kind.SOFT_SPRING, Kind.QUINTIC, Kind.FOAM,
    Kind.PERMANENT_MAGNET, Kind.CUBIC_DAMPER, Kind.DRIFTING_DAMPING, Kind.DRIFTING_STIFFNESS,
    Kind.WARMING_FRICTION, Kind.WARMING_DAMPING, Kind.BUFFER,
)  # fmt: skip
"""Of the kinds behind those of an input."""


@dataclass(frozen=True)
class Linear:
    """Matrices M, D, K (n, n), B (n, m), controller kp, kd (m, n), noise of the outputs (n,)."""

    M: Array
    D: Array
    K: Array
    B: Array
    kp: Array
    kd: Array
    noise: Array
    Ts_s: float
    steps: int
    """Steps of the integration in a period."""


@dataclass(frozen=True)
class Motion:
    """Commands u (N, m), outputs y (N, n), and means over each period: positions, speeds and
    accelerations (N, n), forces of the effect on the DOF (N, n)."""

    u: Array
    y: Array
    q: Array
    w: Array
    a: Array
    effect: Array


class Acting(NamedTuple):
    """An effect: its kind, the DOF or input it acts at, and at most four numbers."""

    kind: Kind
    place: int
    numbers: Array


def simulated(plant: Linear, v: Array, rng: np.random.Generator, *effects: Acting) -> Motion:
    """Return the motion for reference signals v (N, m) of a plant that starts at rest.

    Effects of one input act in their order. One of a lag, a creep, a play and a slew has a
    state, and one of a mass on a spring and a second-order lag.
    """
    n = len(plant.M)
    noise = plant.noise * rng.normal(size=(len(v), n))
    arrays = (np.linalg.inv(plant.M), plant.D, plant.K, plant.B, plant.kp, plant.kd)
    four = np.zeros((len(effects), 4))
    for row, effect in zip(four, effects, strict=True):
        row[: len(effect.numbers)] = effect.numbers
    kinds, places = (np.array([int(e[i]) for e in effects], np.int64) for i in (0, 1))
    return Motion(*_integrated(v, noise, plant.Ts_s, plant.steps, arrays, kinds, places, four))


def _on_dof(  # noqa: PLR0911, PLR0912 - numba has no match
    kind: int, s: Array, q: float, w: float, t_s: float
) -> float:
    if kind == Kind.COULOMB:
        return -s[0] * np.tanh(w / s[1])
    if kind == Kind.STRIBECK:
        return -s[0] * (1.0 + s[2] * np.exp(-((w / s[1]) ** 2))) * np.tanh(10.0 * w / s[1])
    if kind == Kind.ASYMMETRIC:
        return -s[0] * (1.0 + s[2] * np.sign(w)) * np.tanh(w / s[1])
    if kind == Kind.CUBIC:
        return -s[0] * q**3
    if kind == Kind.QUADRATIC:
        return -s[0] * q * q
    if kind == Kind.DRAG:
        return -s[0] * abs(w) * w
    if kind == Kind.SINE:
        return -s[0] * (np.sin(q) - q)
    if kind == Kind.STOP:
        return -s[0] * max(q - s[1], 0.0)
    if kind == Kind.BUFFER:
        return -s[0] * (q - s[1] + s[2] * w) if s[3] * (q - s[1]) > 0.0 else 0.0
    if kind == Kind.GAP:
        return s[1] * min(max(q, -s[0]), s[0])
    if kind == Kind.COGGING:
        return s[0] * np.sin(2.0 * np.pi * q / s[1] + s[2])
    if kind == Kind.RUBBED_UNEVENLY:
        return -s[0] * (1.0 + s[2] * np.sin(q / s[3])) * np.tanh(w / s[1])
    if kind == Kind.THINNING:
        return -s[0] * w / (1.0 + np.abs(w) / s[1])
    if kind == Kind.LEVELING:
        return -s[0] * w / (np.abs(w) + s[1])
    if kind == Kind.SOFT_SPRING:
        return -s[0] * np.tanh(q / s[1])
    if kind == Kind.QUINTIC:
        return -s[0] * q**5
    if kind == Kind.FOAM:
        return -s[0] * (np.exp(q / s[1]) - 1.0)
    if kind == Kind.PERMANENT_MAGNET:
        return s[0] * (max(1.0 - q / s[1], 0.1) ** -2.0 - 1.0)
    if kind == Kind.CUBIC_DAMPER:
        return -s[0] * w**3
    if kind == Kind.DRIFTING_DAMPING:
        return -s[0] * t_s * w
    if kind == Kind.DRIFTING_STIFFNESS:
        return -s[0] * t_s * q
    if kind == Kind.WARMING_DAMPING:
        return -s[0] * np.exp(-t_s / s[1]) * w
    if kind == Kind.WARMING_FRICTION:
        return -s[0] * (1.0 + s[2] * np.exp(-t_s / s[3])) * np.tanh(w / s[1])
    if kind == Kind.PRELOAD:
        return -s[0] * min(max((q - s[1]) / s[2], -1.0), 1.0)
    if kind == Kind.DRAG_15:
        return -s[0] * abs(w) ** 0.5 * w
    return 0.0


def _on_input(  # noqa: PLR0911 - as above
    kind: int, s: Array, u: float, q: float, w: float, t_s: float
) -> float:
    if kind == Kind.SQUARED:
        return u + s[0] * u * abs(u)
    if kind == Kind.CUBED:
        return u + s[0] * u**3
    if kind == Kind.LOADED_GEAR:
        return u - s[0] * np.abs(u) * np.tanh(w / s[1])
    if kind == Kind.WITH_SPEED:
        return u * (1.0 + s[0] * w)
    if kind == Kind.DEAD_ZONE:
        return u - min(max(u, -s[0]), s[0])
    if kind == Kind.SATURATION:
        return min(max(u, -1.0 / s[0]), 1.0 / s[0])
    if kind == Kind.QUANTISED:
        return np.round(u / s[0]) * s[0]
    if kind == Kind.DRIFT:
        return u * (1.0 - s[0] * t_s)
    if kind == Kind.TWO_GAINS:
        return u + s[0] * abs(u)
    if kind == Kind.RIPPLE:
        return u * (1.0 + s[0] * np.sin(2.0 * np.pi * q / s[1]))
    return u


def _set_acceleration(
    a: Array, arrays: tuple[Array, ...], F: Array, q: Array, w: Array, extra: Array
) -> None:
    """Set the acceleration (n,); products of small matrices would each allocate their result."""
    Minv, D, K, B, _, _ = arrays
    a[:] = 0.0
    for i in range(len(a)):
        force = extra[i]
        for j in range(len(F)):
            force += B[i, j] * F[j]
        for j in range(len(a)):
            force -= D[i, j] * w[j] + K[i, j] * q[j]
        for j in range(len(a)):
            a[j] += Minv[j, i] * force


_accelerate = njit(cache=True)(_set_acceleration)
_dof_force = njit(cache=True)(_on_dof)
_input_force = njit(cache=True)(_on_input)


def _integrate(  # noqa: PLR0912, PLR0915 - compiled as one loop
    v: Array, noise: Array, Ts_s: float, steps: int, arrays: tuple[Array, ...],
    kinds: NDArray[np.int64], places: NDArray[np.int64], four: Array,
) -> tuple[Array, Array, Array, Array, Array, Array]:  # fmt: skip
    Minv, _, _, B, kp, kd = arrays
    rows, m, n, h = v.shape[0], v.shape[1], len(Minv), Ts_s / steps
    u, y, qs = np.zeros((rows, m)), np.zeros((rows, n)), np.zeros((rows, n))
    ws, accelerations, effects = np.zeros_like(y), np.zeros_like(y), np.zeros_like(y)
    q, w, last, before = np.zeros(n), np.zeros(n), noise[0].copy(), np.zeros(m)
    lagged, hung, hung_w = 0.0, 0.0, 0.0
    F, extra, a = np.zeros(m), np.zeros(n), np.zeros(n)
    q_mid, w_mid = np.zeros(n), np.zeros(n)
    for row in range(rows):
        y[row] = q + noise[row]
        for e in range(len(kinds)):
            if kinds[e] == Kind.BENT:
                y[row, places[e]] += four[e, 0] * q[places[e]] ** 2
        u[row] = v[row] - kp @ y[row] - kd @ (y[row] - last)
        last = y[row].copy()
        for step in range(steps):
            q_mid[:], w_mid[:] = q, w
            hung_mid, hung_w_mid, lag_mid = hung, hung_w, lagged
            for half in range(2):
                F[:] = u[row]
                extra[:] = 0.0
                pull = lag_rate = 0.0
                t_s = (row + (step + 0.5) / steps) * Ts_s
                for e in range(len(kinds)):
                    kind, place, s = kinds[e], places[e], four[e]
                    if kind == Kind.MAGNET:
                        i, gap = F[0] / s[1], q_mid[0] / s[2]
                        near = 1.0 - min(gap, 0.9)
                        extra[0] += s[0] * ((1.0 + i) ** 2 / near**2 - 1.0 - 2.0 * i - 2.0 * gap)
                    elif kind == Kind.BEARING:
                        i, x = F[0] / s[1], min(max(q_mid[0] / s[2], -0.9), 0.9)
                        pulls = ((1.0 + i) / (1.0 - x)) ** 2 - ((1.0 - i) / (1.0 + x)) ** 2
                        extra[0] += s[0] * (0.25 * pulls - i - q_mid[0] / s[2])
                    elif kind == Kind.LAG:
                        lag_rate = (F[place] - lag_mid) / s[0]
                        F[place] = lag_mid
                    elif kind == Kind.HYSTERESIS:
                        # The command is held, so that the play moves at once.
                        there = min(max(lag_mid, F[place] - s[1]), F[place] + s[1])
                        lag_rate = (there - lagged) / h
                        F[place] -= s[0] * (F[place] - there)
                    elif kind == Kind.SLEWED:
                        left, most = F[place] - lag_mid, 1.0 / s[0]
                        lag_rate = min(max(left / h, -most), most)
                        F[place] = lag_mid
                    elif kind == Kind.CREEP:
                        lag_rate = (q_mid[place] - lag_mid) / s[1]
                        extra[place] -= s[0] * (q_mid[place] - lag_mid)
                    elif kind == Kind.SECOND_ORDER:
                        pull = (hung_mid - F[place]) / s[0] ** 2 + 2.0 * s[1] * hung_w_mid / s[0]
                        F[place] = hung_mid
                    elif kind == Kind.DELAY:
                        if step < round(s[0] / h):
                            F[place] = before[place]
                    elif Kind.SQUARED <= kind < Kind.SHAFT and kind not in _FORCES_ON_DOF:
                        at = min(place, n - 1)
                        F[place] = _input_force(kind, s, F[place], q_mid[at], w_mid[at], t_s)
                    elif kind in (Kind.LOOSE_MASS, Kind.SHAFT):
                        rate = 2.0 * np.pi * s[1]
                        pull = rate * rate * (hung_mid - q_mid[place])
                        pull += 2.0 * s[2] * rate * (hung_w_mid - w_mid[place])
                        extra[place] += s[0] * pull
                        pull += s[3] * hung_w_mid
                    elif kind not in (Kind.NONE, Kind.DRIFTING_MASS, Kind.BENT):
                        extra[place] += _dof_force(kind, s, q_mid[place], w_mid[place], t_s)
                _accelerate(a, arrays, F, q_mid, w_mid, extra)
                for e in range(len(kinds)):
                    if kinds[e] == Kind.DRIFTING_MASS:
                        place, more = places[e], four[e, 0] * t_s
                        own = a[place] / (1.0 + more * Minv[place, place])
                        a -= more * own * Minv[:, place]
                        extra[place] -= more * own
                part = 0.5 * h if half == 0 else h
                for i in range(n):
                    q_mid[i] = q[i] + part * w_mid[i]
                    w_mid[i] = w[i] + part * a[i]
                hung_mid, hung_w_mid = hung + part * hung_w_mid, hung_w - part * pull
                lag_mid = lagged + part * lag_rate
            for i in range(n):
                qs[row, i] += 0.5 * (q[i] + q_mid[i]) / steps
                ws[row, i] += 0.5 * (w[i] + w_mid[i]) / steps
                accelerations[row, i] += (w_mid[i] - w[i]) / Ts_s
                effects[row, i] += extra[i] / steps
                for j in range(m):
                    effects[row, i] += B[i, j] * (F[j] - u[row, j]) / steps
            q[:], w[:] = q_mid, w_mid
            hung, hung_w, lagged = hung_mid, hung_w_mid, lag_mid
        before[:] = u[row]
    return u, y, qs, ws, accelerations, effects


_integrated = cast("Callable[..., tuple[Array, ...]]", njit(cache=True)(_integrate))
