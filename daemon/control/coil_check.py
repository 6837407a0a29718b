"""Just after lift-off: does each coil move the sensors that it should? A small push tells."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, islice
from math import comb

import numpy as np
from numpy.typing import NDArray

from ...config.rig import Geometry
from ...config.session import CoilCheck
from ...log.signals import Stale
from ...model.geometry import shape_matrix

Array = NDArray[np.float64]

_DELAY = 2
"""Cycles from a force computed to the first reading that it has moved."""
_OFF = 0.2
"""Share of what a coil should have moved by which it may be off. Noise and what the template leaves
out, stiffness and control, make 0.04; a dead coil is off by 1, two that changed places by 0.6."""
LONGER = 1.1
"""How much longer than planned a push may take, cycles being late, to be judged: 3 ms. Stiffness
and control, which the template leaves out, grow with the square of its length."""
_MOST_TRIPLES = 500
"""The check is judged between two looks at the loop, in some 50 ms: nine coils make 84."""
_UNHEARD = Stale.AMPLIFIERS | Stale.SETPOINTS
"""In such a row nobody knows whether the amplifiers have taken over what they were told before."""
_FLAT = 1e4
"""Condition of three coils in a line: they say nothing of one tilt."""


@dataclass(frozen=True)
class Pushes:
    """When each coil is pushed, in cycles: +, -, -, + of one length, after which all is at rest."""

    push: int
    pause: int
    force_n: float
    coils: int

    @classmethod
    def of(cls, check: CoilCheck, coils: int, rate_hz: float) -> Pushes:
        """Return the pushes at a rate."""
        push, pause = (max(round(s * rate_hz), 1) for s in (check.push_s, check.pause_s))
        return cls(push, pause, check.push_n, coils)

    @property
    def turn(self) -> int:
        """Cycles from one coil's push to the next one's."""
        return 4 * self.push + self.pause

    @property
    def shape(self) -> Array:
        """One turn's force over `force_n`, (turn,)."""
        signs = np.repeat([1.0, -1.0, -1.0, 1.0], self.push)
        return np.concatenate([signs, np.zeros(self.pause)])

    def excitation(self) -> Array:
        """Return the excitation of all coils, one after the other, (turns, C) in N."""
        found = np.zeros((self.coils * self.turn, self.coils))
        for coil in range(self.coils):
            found[coil * self.turn : (coil + 1) * self.turn, coil] = self.force_n * self.shape
        return found


@dataclass(frozen=True)
class Verdict:
    """What a check of coils has found: `wrong` in words, and which coils it could not judge."""

    wrong: str = ""
    unjudged: tuple[int, ...] = ()


def coil_check(rows: NDArray[np.void], pushes: Pushes, geometry: Geometry) -> Verdict:
    """Return which coils do not move the platform as the others do.

    `rows` are the cycle records of the check, and may begin before it. Where cycles were late, a
    push lasted as much longer, and is judged as it was; by more than `LONGER` it is not judged, nor
    is what it shakes. Nor are they where the amplifiers said nothing while the force changed.

    The platform is a mass: a push moves the pose by G s, s the coil's row of the shape matrix,
    along the push's double integral. G is what fits the coils that agree with each other, so that
    nothing but geometry has to be known.
    """
    begun = np.flatnonzero(rows["coil_excitation_n"].any(axis=1))
    if not len(begun) or len(rows) - begun[0] < pushes.coils * pushes.turn - pushes.pause:
        return Verdict(unjudged=tuple(range(pushes.coils)))
    rows = rows[begun[0] :]
    S = shape_matrix(geometry.coil_x_m, geometry.coil_y_m)
    S_sensors = shape_matrix(geometry.sensors_x_m, geometry.sensors_y_m)
    moved = np.array([_moved(rows, coil, pushes) for coil in range(pushes.coils)])
    judged = np.isfinite(moved).all(axis=1)
    # What a push that was held for long has set going shakes the next one; one that was held for
    # as long again as it should last, or a force of control, all that come after it.
    judged[1:] &= judged[:-1]
    cycle = rows["cycle"][: pushes.coils * pushes.turn : pushes.turn].astype(np.int64)
    unheard_of = [_unheard_of(rows, coil, pushes) for coil in range(pushes.coils)]
    longer = np.maximum(np.append(np.diff(cycle), pushes.turn) - pushes.turn, unheard_of)
    held = np.flatnonzero(longer > pushes.push)
    if len(held):
        judged[held[0] + 1 :] = False

    def off(among: NDArray[np.int64]) -> Array:
        """Return by which share each coil is off what these coils say."""
        G = np.linalg.lstsq(S[among], moved[among], rcond=None)[0]
        expected = S @ G @ S_sensors.T
        size = np.maximum(np.linalg.norm(expected, axis=1), 1e-12)
        return np.asarray(np.linalg.norm(moved @ S_sensors.T - expected, axis=1) / size)

    # Least median of squares: three coils that most others agree with, then all who do.
    sound = np.flatnonzero(judged)
    every = max(-(-comb(len(sound), 3) // _MOST_TRIPLES), 1)
    chosen = islice(combinations(sound, 3), 0, None, every)
    triples = [np.array(t) for t in chosen if np.linalg.cond(S[list(t)]) < _FLAT]
    if not triples:
        return Verdict(unjudged=tuple(range(pushes.coils)))
    best = min(triples, key=lambda triple: float(np.median(off(triple)[sound])))
    found = off(np.flatnonzero(judged & (off(best) <= _OFF)))
    wrong = np.flatnonzero(judged & (found > _OFF))
    words = (
        f"coil {coil} moved the sensors otherwise than it should, by {100 * found[coil]:.0f} %"
        for coil in wrong
    )
    return Verdict(", ".join(words), tuple(np.flatnonzero(~judged).tolist()))


def _moved(rows: NDArray[np.void], coil: int, pushes: Pushes) -> Array:
    """Return by how much the push of a coil moved the pose (3,), as a multiple of the template."""
    turn = rows[coil * pushes.turn : (coil + 1) * pushes.turn]
    n = min(4 * pushes.push + _DELAY, len(turn))
    period = turn["cycle"][:n].astype(np.int64) - int(turn["cycle"][0])
    if n < 4 * pushes.push or period[-1] > LONGER * (n - 1) or _unheard_of(rows, coil, pushes):
        return np.full(3, np.nan)
    # What a cycle computes acts from the next one on, until the one after that, late or not.
    force = np.repeat(pushes.shape[: n - _DELAY], np.diff(period[1:]))
    velocity = np.cumsum(np.concatenate([np.zeros(period[1]), force]))
    moved = np.concatenate([[0.0], np.cumsum(velocity)])[period]
    k = 2.0 * period / period[-1] - 1.0
    # What the platform does anyway, ringing out from lift-off, is a parabola over so short a time.
    templates = np.stack([moved, np.ones(n), k, k**2], axis=1)
    pose = np.stack([turn[name][:n] for name in ("psi_rad", "theta_rad", "z_m")], axis=1)
    fresh = ~(turn["stale"][:n] & Stale.SENSORS).astype(bool)
    if fresh.sum() <= templates.shape[1]:
        return np.full(3, np.nan)
    fitted = np.linalg.lstsq(templates[fresh], pose[fresh].astype(float), rcond=None)
    return np.asarray(fitted[0][0])


def _unheard_of(rows: NDArray[np.void], coil: int, pushes: Pushes) -> int:
    """Return for how many rows at most the amplifiers said nothing from a change of the push on."""
    begin = coil * pushes.turn
    unheard = (rows["stale"][begin : begin + pushes.turn] & _UNHEARD).astype(bool)
    longest = 0
    for change in np.array([0, 1, 3, 4]) * pushes.push:
        # A force acts from the next row on: from that or from its own they may be silent.
        for first in (change, change + 1):
            heard = np.flatnonzero(~unheard[first:])
            longest = max(longest, int(heard[0]) if len(heard) else len(unheard) - first)
    return longest
