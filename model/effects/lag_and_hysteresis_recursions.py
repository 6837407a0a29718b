"""Compiled recursions over samples: lags, hysteresis, play, oscillators."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BEFORE_S = 4.0
"""Initial part of a record that a hysteresis is run through first, to set its initial state."""
_ELEMENTS = 20
"""Number of elements of a yielding spring, enough for a smooth curve."""
_POINTS, _GAUSS = 6, 8
"""Rows of a polynomial between rows, and Gauss points of its integral over a period."""
_RADIANS = 0.15
"""Largest phase of a resonance per step; the relative frequency error is its square over 24."""
_SAME_POLES = 1e-6
"""Half of the distance between two poles, in radians per period, below which they are one."""
_CRITICAL = 1e-6
"""Damped over undamped frequency that stands for none: what this changes is its square."""
_STEP, _RESTS = 0.2, 1e-12
"""Largest step of the Bouc-Wen equation over the break-away displacement, and least change of its
force by a step: with less it has come to its limit."""


def lagged(values: Array, tau_s: float, Ts_s: float) -> Array:
    """Return samples (N,) after a first-order lag, exact for inputs linear between samples.

    The lag starts in steady state at the first sample.
    """
    return np.asarray(_lagged(np.ascontiguousarray(values), tau_s, Ts_s))


def lagged_motion(values: Array, tau_s: float, Ts_s: float) -> Array:
    """Return samples (N,) after a first-order lag, exact for inputs whose curvature changes slowly.

    What the constant curvature of each period adds to `lagged`: samples of a mass lie on parabolas.
    """
    ratio = Ts_s / tau_s
    mean = -math.expm1(-ratio) / ratio  # of the weights e^(-ratio (1 - s)), s from 0 to 1
    first = (1.0 - mean) / ratio  # with the factor s
    bend = 0.5 * ratio * ((1.0 - 2.0 * first) / ratio - first)  # with s (s - 1) / 2
    curvature = np.zeros(len(values))  # of the period before each sample
    turn = values[3:] - values[2:-1] - values[1:-2] + values[:-3]
    curvature[2:-1] = 0.5 * turn
    more = _decaying(bend * curvature, math.exp(-ratio))
    return np.asarray(lagged(values, tau_s, Ts_s) + more)


def lagged_mean(held: Array, tau_s: float, Ts_s: float) -> Array:
    """Return the mean (N,) over each period of held commands after a first-order lag."""
    decay = math.exp(-Ts_s / tau_s)
    weight = tau_s / Ts_s * (1 - decay)
    return np.asarray(_lagged_held(np.ascontiguousarray(held), decay, weight))


def lagged_moment(held: Array, tau_s: float, Ts_s: float) -> Array:
    """Return the moment (N,) over each period of held commands after a first-order lag.

    It is the mean of the command times (t / Ts - 1/2), t from the begin of the period.
    """
    ratio = Ts_s / tau_s
    left = -math.expm1(-ratio)  # of a transient after a period
    state = _lagged_held(np.ascontiguousarray(held), 1.0 - left, 1.0)  # at the begin
    share = (left - ratio * (1.0 - left)) / ratio**2 - left / (2.0 * ratio)
    return np.asarray(share * (state - held))


def resonant(held: Array, frequency_hz: float, damping: float, Ts_s: float) -> tuple[Array, Array]:
    """Return mean and moment (N,) over each period of held commands after a second-order lag.

    It starts in steady state. damping: its ratio, 1 at the critical one, at which there is a limit.
    """
    w = 2.0 * math.pi * frequency_hz
    A = np.array([[0.0, 1.0], [-w * w, -2.0 * damping * w]])
    spread = w * complex(damping**2 - 1.0) ** 0.5
    slope = Ts_s if abs(spread) * Ts_s < _SAME_POLES else np.sinh(spread * Ts_s) / spread
    E = math.exp(-damping * w * Ts_s) * np.real(
        np.cosh(spread * Ts_s) * np.eye(2) + slope * (A + damping * w * np.eye(2))
    )
    # Means of e^(A t), and of it times t / Ts - 1/2.
    whole = np.linalg.solve(A, E - np.eye(2)) / Ts_s
    late = np.linalg.solve(A, E - whole) / Ts_s - 0.5 * whole
    before = np.asarray(_deviations(np.ascontiguousarray(held), E))
    return np.asarray(held + before @ whole[0]), np.asarray(before @ late[0])


def with_moment(mean: Array, moment: Array) -> Array:
    """Return held commands (N,) that move a mass as commands with these means and moments do.

    Both may be (..., N, C), of several commands.

    A command that acts late in its period gives the same speed and less way. So does a pair of
    commands with no mean, one period before and one after.
    """
    rows = 0 if moment.ndim == 1 else -2
    ends = (np.take(moment, [k], rows) for k in (0, -1))
    wide = np.moveaxis(np.concatenate([next(ends), moment, next(ends)], rows), rows, 0)
    return np.asarray(mean + 0.5 * np.moveaxis(wide[:-2] - wide[2:], 0, rows))


def lagged_within(held: Array, tau_s: float, Ts_s: float, share: float) -> Array:
    """Return held commands (N,) after a first-order lag, at the fraction `share` of each period."""
    decay, weight = math.exp(-Ts_s / tau_s), math.exp(-share * Ts_s / tau_s)
    return np.asarray(_lagged_held(np.ascontiguousarray(held), decay, weight))


def held_for(mean: Array, tau_s: float, Ts_s: float) -> Array:
    """Return the held commands (N,) with the given means over each period after a first-order lag.

    This is the inverse of lagged_mean; errors decay from period to period.
    """
    return np.asarray(_held_for(np.ascontiguousarray(mean), tau_s, Ts_s))


def heat(power: Array, tau_s: float, Ts_s: float, start: float) -> Array:
    """Return power (N,) after a first-order lag with the initial state `start`."""
    return np.asarray(_heat(np.ascontiguousarray(power), tau_s, Ts_s, start))


def dahl(x: Array, break_away: float, Ts_s: float) -> Array:
    """Return Dahl's friction (N,), between -1 and 1: df = (1 - f sign dx) dx / break_away.

    Exact for steps. The unknown initial state is that after the first seconds.
    """
    return _with_past(_dahl, x, break_away, Ts_s)


def slip(x: Array, break_away: float, Ts_s: float) -> Array:
    """Return a Maxwell-slip element's force (N,): a spring that slips at force 1.

    `break_away` is the displacement at slip. The initial state, which is unknown, is that after the
    record's first seconds.
    """
    return _with_past(_slip, x, break_away, Ts_s)


def slip_range(x: Array, break_away: float) -> tuple[Array, Array]:
    """Return the middle and half width (N,) of a slip element's force for all initial states.

    The range is zero once x has moved by twice `break_away`.
    """
    x = np.ascontiguousarray(x)
    high, low = _slip(x, break_away, 1.0), _slip(x, break_away, -1.0)
    return 0.5 * (high + low), 0.5 * (high - low)


def bouc_wen(x: Array, break_away: float, sharpness: float, shape: float, Ts_s: float) -> Array:
    """Return Bouc-Wen hysteresis (N,): dz = (1 - |z|^n (b sign(z dx) + 1 - b)) dx / x_s.

    x_s is `break_away`, n is `sharpness`, b is `shape`; n = 1, b = 1 is Dahl friction. Steps use
    the midpoint rule. The unknown initial state is that after the first seconds.
    """
    before = _before(x, Ts_s)
    path = np.concatenate([x[:before], x])
    return np.asarray(_bouc_wen(path, break_away, sharpness, shape)[before:])


def lugre(x: Array, v: Array, break_away: float, peak: float, slow: float, Ts_s: float) -> Array:
    """Return LuGre friction (N,) in units of Coulomb friction: df = (1 - f sign dx / g) dx / x_s.

    It slips at g = 1 + peak exp(-(v / slow)^2); the bristles have no damping. The initial state,
    which is unknown, is that after the record's first seconds.
    """
    before = _before(x, Ts_s)
    level = 1 + peak * np.exp(-((v / slow) ** 2))
    path = np.concatenate([x[:before], x])
    return np.asarray(_lugre(path, np.concatenate([level[:before], level]), break_away)[before:])


def play(x: Array, half_width: float, Ts_s: float) -> Array:
    """Return the output (N,) of a play operator: it follows x at the distance half_width."""
    return _with_past(_play, x, half_width, Ts_s)


def jumping(x: Array, width: float, Ts_s: float) -> Array:
    """Return a reading (N,) that stays until x is more than `width` away, then jumps to x."""
    return _with_past(_jumping, x, width, Ts_s)


def held(x: Array, stuck: NDArray[np.bool_]) -> Array:
    """Return x (N,) with rows marked in `stuck` (N,) replaced by the last unmarked value."""
    rows = np.arange(len(x))
    return np.asarray(x[np.maximum.accumulate(np.where(stuck, 0, rows))])


def oscillator(
    force: Array, frequency_hz: float, damping: float, Ts_s: float, tau_s: float = 0.0
) -> Array:
    """Return (N, 2) position and velocity of eta'' + 2 zeta w eta' + w^2 eta = force.

    Exact for a force (N,) that is held from row to row, then lagged by tau_s. It starts at rest in
    the equilibrium of the first sample.
    """
    w = 2 * math.pi * frequency_hz
    wd = w * math.sqrt(max(1 - damping**2, 1e-12))
    decay = math.exp(-damping * w * Ts_s)
    c, s = decay * math.cos(wd * Ts_s), decay * math.sin(wd * Ts_s) / wd
    a, b = c + damping * w * s, s
    step = [a, b, -(w**2) * s, c - damping * w * s, (1 - a) / w**2, b, 0.0, 0.0]
    force = np.ascontiguousarray(force)
    fading = np.zeros_like(force)
    if tau_s > 0.0:
        # In each period the lagged force is the held one and what fades of the difference before:
        # for exp(-t / tau), exp(-t / tau) / (1 / tau^2 - 2 zeta w / tau + w^2) is a solution.
        rate, left = 1.0 / tau_s, math.exp(-Ts_s / tau_s)
        static = 1.0 / (rate * (rate - 2.0 * damping * w) + w**2)
        step[6] = static * (left - (step[0] - rate * step[1]))
        step[7] = static * (-rate * left - (step[2] - rate * step[3]))
        fading = _lagged_held(force, left, 1.0) - force
    return np.asarray(_oscillator(force, fading, np.array(step), force[0] / w**2))


def smooth_oscillator(force: Array, frequency_hz: float, damping: float, Ts_s: float) -> Array:
    """Return (N, 2) position and velocity of eta'' + 2 zeta w eta' + w^2 eta = force.

    Between rows the force (N,) is the polynomial through the six rows around: of a force that is
    smooth, a tenth of the sampling rate included, the error is 10^-4. It starts at rest in the
    equilibrium of the first sample.
    """
    w = 2 * math.pi * frequency_hz
    wd = w * (cmath.sqrt(1.0 - damping**2) or _CRITICAL)
    rows, points = len(force), min(_POINTS, len(force))
    if points < 2:
        return np.stack([force / w**2, np.zeros(rows)], axis=1)
    nodes, weights = np.polynomial.legendre.leggauss(_GAUSS)
    along = 0.5 + 0.5 * nodes
    left_s = Ts_s * np.append(1.0 - along, 1.0)  # what acts then moves it for so long
    decay = np.exp(-damping * w * left_s)
    moved = decay * np.real(np.sin(wd * left_s) / wd)
    speed = decay * np.real(np.cos(wd * left_s)) - damping * w * moved
    impulses = 0.5 * Ts_s * weights * np.stack([moved, speed])[:, :-1]
    to_powers = np.linalg.inv(np.vander(np.arange(points), points, increasing=True))
    begins = np.clip(np.arange(rows - 1) - (points // 2 - 1), 0, rows - points)
    around = sliding_window_view(np.ascontiguousarray(force), points)[begins]
    drive = np.empty((rows - 1, 2))
    for place in range(points - 1):
        there = np.arange(rows - 1) - begins == place
        polynomials = np.vander(place + along, points, increasing=True) @ to_powers
        drive[there] = around[there] @ (impulses @ polynomials).T
    b, d = float(moved[-1]), float(speed[-1])
    step = np.array([d + 2.0 * damping * w * b, b, -(w**2) * b, d])
    return np.asarray(_driven(step, drive, force[0] / w**2))


def yielding(
    q: Array, qd: Array, pull: Array, w: float, zeta: float, x_s: float, Ts_s: float
) -> tuple[Array, Array]:
    """Return shift x of a unit mass on a yielding spring, and the spring force on it (N,).

    x'' + 2 zeta w x' + w^2 r = pull - q''; the spring force is w^2 r + 2 zeta w x'. The spring r(x)
    is Iwan's: parallel elements of equal stiffness that slip one after the other up to a shift of
    x_s. For small shifts r equals x; its maximum is half of x_s. The mass starts at rest in
    equilibrium. Leapfrog integration; the step limits the resonance frequency error to 0.1 %.
    """
    parts = max(math.ceil(w * Ts_s / _RADIANS), 1)
    q, qd, pull = (np.ascontiguousarray(v) for v in (q, qd, pull))
    slips = x_s * (np.arange(_ELEMENTS) + 0.5) / _ELEMENTS
    shift, spring = _yielding(q, qd, pull, w, zeta, slips, Ts_s / parts, parts)
    return np.asarray(shift), np.asarray(spring)


def between_stops(
    q: Array,
    qd: Array,
    pull: Array,
    w: float,
    zeta: float,
    half: float,
    Ts_s: float,
    lets_go: bool = True,
    slowing: float = 0.0,
) -> tuple[Array, Array]:
    """Return shift x of a unit mass between two stops, and the contact force on it (N,).

    x'' = pull - q'' - f - slowing (q' + x'), f = w^2 p + 2 zeta w x' where p = x - clip(x, -half,
    half) is not zero. If it `lets_go`, a contact does not pull: f is zero where it has not the sign
    of p. The mass starts in the middle, or in equilibrium on the stop to which it is pulled.
    Integration as in `yielding`.
    """
    parts = max(math.ceil(w * Ts_s / _RADIANS), 1)
    q, qd, pull = (np.ascontiguousarray(v) for v in (q, qd, pull))
    shift, contact = _between_stops(
        q, qd, pull, w, zeta, half, Ts_s / parts, parts, lets_go, slowing
    )
    return np.asarray(shift), np.asarray(contact)


def _before(x: Array, Ts_s: float) -> int:
    return min(round(_BEFORE_S / Ts_s), len(x))


def _with_past(
    kernel: Callable[[Array, float], Array], x: Array, size: float, Ts_s: float
) -> Array:
    before = _before(x, Ts_s)
    return np.asarray(kernel(np.concatenate([x[:before], x]), size)[before:])


@njit(cache=True, nogil=True)
def _driven(step, drive, start):  # type: ignore[no-untyped-def]
    out = np.empty((len(drive) + 1, 2))
    x, v = start, 0.0
    out[0] = x, v
    for k in range(len(drive)):
        x, v = step[0] * x + step[1] * v + drive[k, 0], step[2] * x + step[3] * v + drive[k, 1]
        out[k + 1] = x, v
    return out


@njit(cache=True, nogil=True)
def _deviations(held, E):  # type: ignore[no-untyped-def]
    """Return value less command, and its rate, (N, 2) at the begin of each period."""
    found = np.zeros((len(held), 2))
    value, rate = held[0], 0.0
    for row in range(len(held)):
        off = value - held[row]
        found[row, 0], found[row, 1] = off, rate
        value = held[row] + E[0, 0] * off + E[0, 1] * rate
        rate = E[1, 0] * off + E[1, 1] * rate
    return found


@njit(cache=True, nogil=True)
def _lagged(x, tau_s, Ts_s):  # type: ignore[no-untyped-def]
    decay = math.exp(-Ts_s / tau_s)
    mean = tau_s / Ts_s * (1 - decay)
    out = np.empty_like(x)
    out[0] = x[0]
    for k in range(len(x) - 1):
        out[k + 1] = decay * out[k] + (mean - decay) * x[k] + (1 - mean) * x[k + 1]
    return out


@njit(cache=True, nogil=True)
def _decaying(given, decay):  # type: ignore[no-untyped-def]
    out = np.empty_like(given)
    left = 0.0
    for k in range(len(given)):
        left = decay * left + given[k]
        out[k] = left
    return out


@njit(cache=True, nogil=True)
def _lagged_held(held, decay, weight):  # type: ignore[no-untyped-def]
    out = np.empty_like(held)
    state = held[0]
    for k in range(len(held)):
        out[k] = held[k] + weight * (state - held[k])
        state = held[k] + decay * (state - held[k])
    return out


@njit(cache=True, nogil=True)
def _held_for(means, tau_s, Ts_s):  # type: ignore[no-untyped-def]
    decay = math.exp(-Ts_s / tau_s)
    mean = tau_s / Ts_s * (1 - decay)
    out = np.empty_like(means)
    state = means[0]
    for k in range(len(means)):
        out[k] = (means[k] - mean * state) / (1 - mean)
        state = out[k] + decay * (state - out[k])
    return out


@njit(cache=True, nogil=True)
def _heat(power, tau_s, Ts_s, start):  # type: ignore[no-untyped-def]
    decay = math.exp(-Ts_s / tau_s)
    out = np.empty_like(power)
    state = start
    for k in range(len(power)):
        out[k] = state
        state = power[k] + decay * (state - power[k])
    return out


@njit(cache=True, nogil=True)
def _dahl(x, break_away):  # type: ignore[no-untyped-def]
    out = np.empty_like(x)
    f = 0.0
    out[0] = f
    for k in range(1, len(x)):
        dx = (x[k] - x[k - 1]) / break_away
        end = 1.0 if dx > 0 else -1.0
        f = end + (f - end) * math.exp(-abs(dx))
        out[k] = f
    return out


@njit(cache=True, nogil=True)
def _bouc_wen(x, break_away, sharpness, shape):  # type: ignore[no-untyped-def]
    out = np.empty_like(x)
    z = 0.0
    out[0] = z
    for k in range(1, len(x)):
        whole = (x[k] - x[k - 1]) / break_away
        parts = 1 + int(abs(whole) / _STEP)
        dx = whole / parts
        for _ in range(parts):
            half = z
            for share in (0.5, 1.0):
                turned = shape if half * dx > 0 else -shape
                half = z + share * dx * (1 - abs(half) ** sharpness * (turned + 1 - shape))
            moved, z = abs(half - z), half
            if moved < _RESTS:  # all further steps of this row are in the same direction
                break
        out[k] = z
    return out


@njit(cache=True, nogil=True)
def _lugre(x, level, break_away):  # type: ignore[no-untyped-def]
    out = np.empty_like(x)
    f = 0.0
    out[0] = f
    for k in range(1, len(x)):
        dx = x[k] - x[k - 1]
        end = level[k] if dx > 0 else -level[k]
        f = end + (f - end) * math.exp(-abs(dx) / (break_away * level[k]))
        out[k] = f
    return out


@njit(cache=True, nogil=True)
def _slip(x, break_away, f=0.0):  # type: ignore[no-untyped-def]
    out = np.empty_like(x)
    out[0] = f
    for k in range(1, len(x)):
        f = min(max(f + (x[k] - x[k - 1]) / break_away, -1.0), 1.0)
        out[k] = f
    return out


@njit(cache=True, nogil=True)
def _yielding(q, qd, pull, w, zeta, slips, dt_s, parts):  # type: ignore[no-untyped-def]
    shift, taken, elements = np.empty_like(q), np.empty_like(q), np.empty_like(slips)
    most = 2 * slips.mean()
    carried = min(abs(pull[0]) / (w * w), 0.49 * most)
    x = math.copysign(most * (1 - math.sqrt(1 - 2 * carried / most)), pull[0])
    r = 0.0
    for j in range(len(slips)):
        elements[j] = min(max(x, -slips[j]), slips[j])
        r += elements[j] / len(slips)
    p, rate = q[0] + x, qd[0]
    damp = zeta * w * dt_s
    for k in range(len(q)):
        later = min(k + 1, len(q) - 1)
        for i in range(parts):
            # Leapfrog: speeds at half steps, everything else at full steps.
            share = i / parts
            carrier = qd[k] + share * (qd[later] - qd[k])
            outer = pull[k] + share * (pull[later] - pull[k])
            before = rate
            rate = (1 - damp) * rate + dt_s * (outer - w * w * r) + 2 * damp * carrier
            rate /= 1 + damp
            if i == 0:
                shift[k] = x
                taken[k] = w * w * r + 2 * zeta * w * (0.5 * (before + rate) - carrier)
            p += dt_s * rate
            now = p - _on_cubic(q, qd, k, later, (i + 1) / parts, parts * dt_s)
            r = 0.0
            for j in range(len(slips)):
                elements[j] = min(max(elements[j] + now - x, -slips[j]), slips[j])
                r += elements[j] / len(slips)
            x = now
    return shift, taken


@njit(cache=True, nogil=True)
def _between_stops(q, qd, pull, w, zeta, half, dt_s, parts, lets_go, slowing):  # type: ignore[no-untyped-def]
    shift, contact = np.empty_like(q), np.empty_like(q)
    x = half * np.sign(pull[0]) + pull[0] / (w * w)
    p, rate = q[0] + x, qd[0]
    damp, slow = zeta * w * dt_s, 0.5 * slowing * dt_s
    for k in range(len(q)):
        later = min(k + 1, len(q) - 1)
        for i in range(parts):
            share, before = i / parts, rate
            carrier = qd[k] + share * (qd[later] - qd[k])
            outer = pull[k] + share * (pull[later] - pull[k])
            pressed = x - min(max(x, -half), half)
            rate = ((1 - slow) * before + dt_s * outer) / (1 + slow)
            force = 0.0
            if pressed != 0.0:
                touching = (1 - damp - slow) * before + dt_s * (outer - w * w * pressed)
                touching = (touching + 2 * damp * carrier) / (1 + damp + slow)
                force = w * w * pressed + 2 * zeta * w * (0.5 * (before + touching) - carrier)
                if force * pressed > 0.0 or not lets_go:
                    rate = touching
                else:
                    force = 0.0
            if i == 0:
                shift[k], contact[k] = x, force
            p += dt_s * rate
            x = p - _on_cubic(q, qd, k, later, (i + 1) / parts, parts * dt_s)
    return shift, contact


@njit(cache=True, nogil=True)
def _on_cubic(q, qd, k, later, share, period_s):  # type: ignore[no-untyped-def]
    """Cubic Hermite interpolation: the kinks of a linear one would excite a resonance."""
    rest = 1 - share
    return rest * rest * ((1 + 2 * share) * q[k] + share * period_s * qd[k]) + share * share * (
        (1 + 2 * rest) * q[later] - rest * period_s * qd[later]
    )


@njit(cache=True, nogil=True)
def _play(x, half_width):  # type: ignore[no-untyped-def]
    out = np.empty_like(x)
    p = x[0]
    for k in range(len(x)):
        p = min(max(p, x[k] - half_width), x[k] + half_width)
        out[k] = p
    return out


@njit(cache=True, nogil=True)
def _jumping(x, width):  # type: ignore[no-untyped-def]
    out = np.empty_like(x)
    shown = x[0]
    for k in range(len(x)):
        if abs(x[k] - shown) > width:
            shown = x[k]
        out[k] = shown
    return out


@njit(cache=True, nogil=True)
def _oscillator(force, fading, step, start):  # type: ignore[no-untyped-def]
    out = np.empty((len(force), 2))
    eta, rate = start, 0.0
    for k in range(len(force)):
        out[k, 0] = eta
        out[k, 1] = rate
        eta, rate = (
            step[0] * eta + step[1] * rate + step[4] * force[k] + step[6] * fading[k],
            step[2] * eta + step[3] * rate + step[5] * force[k] + step[7] * fading[k],
        )
    return out
