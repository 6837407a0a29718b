"""What remembers: lags, hysteresis, play and oscillators along samples, as compiled loops."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BEFORE_S = 4.0
_ELEMENTS = 20
"""Of a spring that yields: as good as a curve."""
_RADIANS = 0.15
"""Of a resonance, in a step: it is off by a 24th of the square of that."""
_STEP = 0.2
"""Of the break-away displacement: Bouc and Wen's equation is solved in steps no longer."""


def lagged(values: Array, tau_s: float, Ts_s: float) -> Array:
    """Return samples (N,) behind a first-order lag, exact where they are straight in between.

    It starts settled at the first of them.
    """
    return np.asarray(_lagged(np.ascontiguousarray(values), tau_s, Ts_s))


def lagged_mean(held: Array, tau_s: float, Ts_s: float) -> Array:
    """Return means (N,) over each period of commands, each held for a period, behind a lag."""
    decay = math.exp(-Ts_s / tau_s)
    behind = tau_s / Ts_s * (1 - decay)
    return np.asarray(_lagged_held(np.ascontiguousarray(held), decay, behind))


def lagged_within(held: Array, tau_s: float, Ts_s: float, share: float) -> Array:
    """Return commands (N,), each held for a period, behind a lag, `share` of each period on."""
    decay, behind = math.exp(-Ts_s / tau_s), math.exp(-share * Ts_s / tau_s)
    return np.asarray(_lagged_held(np.ascontiguousarray(held), decay, behind))


def held_for(mean: Array, tau_s: float, Ts_s: float) -> Array:
    """Return the commands (N,) whose means over each period behind a lag are these.

    The inverse of lagged_mean. What an error leaves shrinks from period to period.
    """
    return np.asarray(_held_for(np.ascontiguousarray(mean), tau_s, Ts_s))


def heat(power: Array, tau_s: float, Ts_s: float, start: float) -> Array:
    """Return power (N,) behind a first-order lag that starts anywhere."""
    return np.asarray(_heat(np.ascontiguousarray(power), tau_s, Ts_s, start))


def dahl(x: Array, break_away: float, Ts_s: float) -> Array:
    """Return Dahl's friction (N,), between -1 and 1: df = (1 - f sign dx) dx / break_away.

    Exact for steps. What was before row 0 nobody knows: it has been through the first seconds once.
    """
    return _with_past(_dahl, x, break_away, Ts_s)


def slip(x: Array, break_away: float, Ts_s: float) -> Array:
    """Return a Maxwell-slip element's force (N,): a spring that slips at 1, at `break_away`.

    What was before row 0 nobody knows: it has been through the first seconds once.
    """
    return _with_past(_slip, x, break_away, Ts_s)


def slip_range(x: Array, break_away: float) -> tuple[Array, Array]:
    """Return the middle and half the range (N,) of what such an element may do.

    Whatever it held before row 0, within its break-away, it does something in between; where x has
    gone to and fro by twice that the range is nothing.
    """
    x = np.ascontiguousarray(x)
    high, low = _slip(x, break_away, 1.0), _slip(x, break_away, -1.0)
    return 0.5 * (high + low), 0.5 * (high - low)


def bouc_wen(x: Array, break_away: float, sharpness: float, shape: float, Ts_s: float) -> Array:
    """Return Bouc and Wen's hysteresis (N,): dz = (1 - |z|^n (b sign(z dx) + 1 - b)) dx / x_s.

    n is `sharpness`, b is `shape`; n = 1, b = 1 is Dahl's. Within a step by the midpoint rule. What
    was before row 0 nobody knows: it has been through the first seconds once.
    """
    before = _before(x, Ts_s)
    path = np.concatenate([x[:before], x])
    return np.asarray(_bouc_wen(path, break_away, sharpness, shape)[before:])


def lugre(x: Array, v: Array, break_away: float, peak: float, slow: float, Ts_s: float) -> Array:
    """Return LuGre's friction (N,) in units of Coulomb's: df = (1 - f sign dx / g) dx / x_s.

    g = 1 + peak exp(-(v / slow)^2) is what it slips at; without damping of the bristles. What was
    before row 0 nobody knows: it has been through the first seconds once.
    """
    before = _before(x, Ts_s)
    level = 1 + peak * np.exp(-((v / slow) ** 2))
    path = np.concatenate([x[:before], x])
    return np.asarray(_lugre(path, np.concatenate([level[:before], level]), break_away)[before:])


def play(x: Array, half_width: float, Ts_s: float) -> Array:
    """Return what is pushed along (N,) by x with play: it moves when x is half_width away."""
    return _with_past(_play, x, half_width, Ts_s)


def jumping(x: Array, width: float, Ts_s: float) -> Array:
    """Return a reading (N,) that stays until x is further than width away, then catches up."""
    return _with_past(_jumping, x, width, Ts_s)


def held(x: Array, standing: NDArray[np.bool_]) -> Array:
    """Return x (N,), but where it is standing (N,) its value of the last row where it is not."""
    rows = np.arange(len(x))
    return np.asarray(x[np.maximum.accumulate(np.where(standing, 0, rows))])


def oscillator(force: Array, frequency_hz: float, damping: float, Ts_s: float) -> Array:
    """Return (N, 2) position and velocity of eta'' + 2 zeta w eta' + w^2 eta = force.

    Each sample of force (N,) is held from its row to the next: exact. It starts at rest where the
    first sample would hold it.
    """
    w = 2 * math.pi * frequency_hz
    wd = w * math.sqrt(max(1 - damping**2, 1e-12))
    decay = math.exp(-damping * w * Ts_s)
    c, s = decay * math.cos(wd * Ts_s), decay * math.sin(wd * Ts_s) / wd
    a, b = c + damping * w * s, s
    step = np.array([a, b, -(w**2) * s, c - damping * w * s, (1 - a) / w**2, b])
    return np.asarray(_oscillator(np.ascontiguousarray(force), step, force[0] / w**2))


def yielding(
    q: Array, qd: Array, pull: Array, w: float, zeta: float, x_s: float, Ts_s: float
) -> tuple[Array, Array]:
    """Return shift x of a unit mass on a yielding spring, and what the spring takes of it (N,).

    x'' + 2 zeta w x' + w^2 r = pull - q''; taken is w^2 r + 2 zeta w x'. The spring r(x) is Iwan's:
    elements of one stiffness in parallel, which slip one after the other up to a shift of x_s; for
    small shifts r is x, and it is never more than half of x_s. The mass begins at rest where the
    spring carries the pull. Steps leap over each other, and are so short that the resonance is
    off by a thousandth.
    """
    parts = max(math.ceil(w * Ts_s / _RADIANS), 1)
    q, qd, pull = (np.ascontiguousarray(v) for v in (q, qd, pull))
    slips = x_s * (np.arange(_ELEMENTS) + 0.5) / _ELEMENTS
    shift, taken = _yielding(q, qd, pull, w, zeta, slips, Ts_s / parts, parts)
    return np.asarray(shift), np.asarray(taken)


def _before(x: Array, Ts_s: float) -> int:
    return min(round(_BEFORE_S / Ts_s), len(x))


def _with_past(
    kernel: Callable[[Array, float], Array], x: Array, size: float, Ts_s: float
) -> Array:
    before = _before(x, Ts_s)
    return np.asarray(kernel(np.concatenate([x[:before], x]), size)[before:])


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
def _lagged_held(held, decay, behind):  # type: ignore[no-untyped-def]
    out = np.empty_like(held)
    state = held[0]
    for k in range(len(held)):
        out[k] = held[k] + behind * (state - held[k])
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
            z = half
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
            # The speed is that of half a step before and after, everything else that of now.
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
            share = (i + 1) / parts
            # A cubic through places and speeds: straight lines would have kinks to answer to.
            rest = 1 - share
            carried_by = rest * rest * ((1 + 2 * share) * q[k] + share * parts * dt_s * qd[k])
            carried_by += (
                share * share * ((1 + 2 * rest) * q[later] - rest * parts * dt_s * qd[later])
            )
            now = p - carried_by
            r = 0.0
            for j in range(len(slips)):
                elements[j] = min(max(elements[j] + now - x, -slips[j]), slips[j])
                r += elements[j] / len(slips)
            x = now
    return shift, taken


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
def _oscillator(force, step, start):  # type: ignore[no-untyped-def]
    out = np.empty((len(force), 2))
    eta, rate = start, 0.0
    for k in range(len(force)):
        out[k, 0] = eta
        out[k, 1] = rate
        eta, rate = (
            step[0] * eta + step[1] * rate + step[4] * force[k],
            step[2] * eta + step[3] * rate + step[5] * force[k],
        )
    return out
