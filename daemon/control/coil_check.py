"""Check each coil just after lift-off: push it and compare the measured motion with geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice
from math import comb

import numpy as np
from numpy.typing import NDArray

from ...config.rig import Geometry
from ...config.session import CoilCheck
from ...log.signals import Stale
from ...model.geometry import shape_matrix

Array = NDArray[np.float64]

_DELAY_CYCLES = 2
"""Cycles from a computed force to the first reading that it affects."""
_MAX_DEVIATION = 0.2
"""Largest deviation of a coil's motion, as a fraction of the expected motion. Noise and the effects
that the template neglects (stiffness, control) cause 0.04; a dead coil deviates by 1, swapped coils
by 0.6."""
LONGER = 1.1
"""Largest ratio of actual to planned push length, in late cycles, for a valid check: 3 ms longer.
The neglected effects, stiffness and control, grow with the square of the length."""
_MAX_TRIPLES = 500
"""Limits the evaluation, which runs between two polls of the loop, to about 50 ms. Nine coils have
84 triples."""
_FORCE_UNCONFIRMED = Stale.AMPLIFIERS | Stale.SETPOINTS
"""Flags of a row in which the amplifiers did not confirm that they applied the previous command."""
_IDLE = "let the daemon have the processors for itself"
_AMPLIFIERS = "check cable and load of the bus to the amplifiers"
_SENSORS = "check cable and load of the bus to the sensors"
_COLLINEAR_CONDITION = 1e4
"""Condition number above which three coils lie in a line and cannot determine both tilts."""


@dataclass(frozen=True)
class Pushes:
    """Schedule the push of each coil, in cycles: +, -, -, + of equal length, then a pause.

    The double integral of this force ends at zero: the platform is at rest again.
    """

    push: int
    pause: int
    force_n: float
    coils: int

    @classmethod
    def of(cls, check: CoilCheck, coils: int, rate_hz: float) -> Pushes:
        """Convert the times of `check` to whole cycles at `rate_hz`, at least one.

        Rounding makes a push of two cycles or more longer by a third at most. The neglected effects
        then cause a deviation of 0.07 instead of 0.04.
        """
        push, pause = (max(round(s * rate_hz), 1) for s in (check.push_s, check.pause_s))
        return cls(push, pause, check.push_n, coils)

    @property
    def turn(self) -> int:
        """Cycles from the start of one coil's push to the start of the next."""
        return 4 * self.push + self.pause

    @property
    def shape(self) -> Array:
        """Force of one turn divided by `force_n`, (turn,)."""
        signs = np.repeat([1.0, -1.0, -1.0, 1.0], self.push)
        return np.concatenate([signs, np.zeros(self.pause)])

    def excitation(self) -> Array:
        """Return the excitation that pushes the coils one after the other, (cycles, C) in N."""
        excitation = np.zeros((self.coils * self.turn, self.coils))
        for coil in range(self.coils):
            excitation[coil * self.turn : (coil + 1) * self.turn, coil] = self.force_n * self.shape
        return excitation


@dataclass(frozen=True)
class CoilCheckResult:
    """Result of a coil check: an error text, empty if none, and the coils that were not checked.

    `skipped` is a sentence about these coils: which, why, and what to do; empty if there are none.
    """

    error: str = ""
    unjudged: tuple[int, ...] = ()
    skipped: str = ""


def coil_check(rows: NDArray[np.void], pushes: Pushes, geometry: Geometry) -> CoilCheckResult:
    """Find coils that do not move the platform as the other coils do.

    `rows` are the cycle records of the check; they may start before it. Late cycles lengthen a
    push: it is evaluated at its actual length. A push longer than `LONGER` times its plan is
    skipped, and so are the coils whose motion it disturbs. The same applies if the amplifiers did
    not respond while the force changed.

    The platform is a mass: a push moves the pose by G s along the double integral of the push, s
    being the coil's row of the shape matrix. G is fitted to the coils that agree with each other:
    only the geometry has to be known.
    """
    pushed = np.flatnonzero(rows["coil_excitation_n"].any(axis=1))
    if not len(pushed) or len(rows) - pushed[0] < pushes.coils * pushes.turn - pushes.pause:
        late = "the rows of the check were overwritten before the daemon could evaluate them"
        return _skipped(range(pushes.coils), pushes.coils, [(late, _IDLE)])
    rows = rows[pushed[0] :]
    S = shape_matrix(geometry.coil_x_m, geometry.coil_y_m)
    S_sensors = shape_matrix(geometry.sensors_x_m, geometry.sensors_y_m)
    motion = np.array([_pose_motion(rows, coil, pushes) for coil in range(pushes.coils)])
    valid = np.isfinite(motion).all(axis=1)
    # A push that was too long disturbs the next coil. One that was held for twice its length, or a
    # control force held as long, disturbs all later coils.
    valid[1:] &= valid[:-1]
    cycle = rows["cycle"][: pushes.coils * pushes.turn : pushes.turn].astype(np.int64)
    unconfirmed = [_unconfirmed_rows(rows, coil, pushes) for coil in range(pushes.coils)]
    excess = np.maximum(np.append(np.diff(cycle), pushes.turn) - pushes.turn, unconfirmed)
    held = np.flatnonzero(excess > pushes.push)
    if len(held):
        valid[held[0] + 1 :] = False

    def deviation(reference: NDArray[np.int64]) -> Array:
        """Return each coil's relative deviation from the motion fitted to the reference coils."""
        G = np.linalg.lstsq(S[reference], motion[reference], rcond=None)[0]
        expected = S @ G @ S_sensors.T
        size = np.maximum(np.linalg.norm(expected, axis=1), 1e-12)
        return np.asarray(np.linalg.norm(motion @ S_sensors.T - expected, axis=1) / size)

    # Least median of squares: the triple with the smallest median deviation, then all coils that
    # agree with it.
    coils = np.flatnonzero(valid)
    every = max(-(-comb(len(coils), 3) // _MAX_TRIPLES), 1)
    chosen = islice(combinations(coils, 3), 0, None, every)
    triples = [np.array(t) for t in chosen if np.linalg.cond(S[list(t)]) < _COLLINEAR_CONDITION]
    causes = _disturbances(rows[: pushes.coils * pushes.turn])
    if not triples:
        return _skipped(range(pushes.coils), pushes.coils, causes)
    best = min(triples, key=lambda triple: float(np.median(deviation(triple)[coils])))
    deviations = deviation(np.flatnonzero(valid & (deviation(best) <= _MAX_DEVIATION)))
    errors = (
        f"coil {coil} moved the platform {100 * deviations[coil]:.0f} % off the expected motion"
        for coil in np.flatnonzero(valid & (deviations > _MAX_DEVIATION))
    )
    unjudged = np.flatnonzero(~valid).tolist()
    return replace(_skipped(unjudged, pushes.coils, causes), error=", ".join(errors))


def _skipped(
    coils: Sequence[int], count: int, causes: Sequence[tuple[str, str]]
) -> CoilCheckResult:
    """Return a result without error that skips `coils`, of `count`, for these causes."""
    if not coils:
        return CoilCheckResult()
    numbers = ", ".join(map(str, coils))
    which = f"coil {numbers}" if len(coils) == 1 else f"coils {numbers}"
    if len(coils) == count:
        which = f"all {count} coils"
    why = " and ".join(cause for cause, _ in causes) or "too few coils are left to compare"
    how = " and ".join(dict.fromkeys(remedy for _, remedy in causes)) or _IDLE
    return CoilCheckResult(
        unjudged=tuple(coils),
        skipped=f"coil check skipped for {which}: {why}. This is not a coil fault; {how}. The next "
        "lift-off repeats the check",
    )


def _disturbances(rows: NDArray[np.void]) -> list[tuple[str, str]]:
    """Return what disturbed the check in `rows`, each with a remedy, most frequent first."""
    stale, late = rows["stale"], int((np.diff(rows["cycle"].astype(np.int64)) > 1).sum())
    unconfirmed = int(((stale & _FORCE_UNCONFIRMED) != 0).sum())
    unread = int(((stale & Stale.SENSORS) != 0).sum())
    found = (
        (late, "{} late", _IDLE),
        (unconfirmed, "{} without an answer of the amplifiers", _AMPLIFIERS),
        (unread, "{} without sensor readings", _SENSORS),
    )
    return [
        (words.format(f"{n} cycle{'s' * (n != 1)} {'was' if n == 1 else 'were'}"), remedy)
        for n, words, remedy in sorted(found, key=lambda each: -each[0])
        if n
    ]


def _pose_motion(rows: NDArray[np.void], coil: int, pushes: Pushes) -> Array:
    """Fit the motion template to the pose during a push; return factors (3,), nan if invalid."""
    turn = rows[coil * pushes.turn : (coil + 1) * pushes.turn]
    n = min(4 * pushes.push + _DELAY_CYCLES, len(turn))
    period = turn["cycle"][:n].astype(np.int64) - int(turn["cycle"][0])
    too_long = period[-1] > LONGER * (n - 1)
    if n < 4 * pushes.push or too_long or _unconfirmed_rows(rows, coil, pushes):
        return np.full(3, np.nan)
    # A force acts from the next cycle to the one after that, late or not.
    force = np.repeat(pushes.shape[: n - _DELAY_CYCLES], np.diff(period[1:]))
    velocity = np.cumsum(np.concatenate([np.zeros(period[1]), force]))
    position = np.concatenate([[0.0], np.cumsum(velocity)])[period]
    k = 2.0 * period / period[-1] - 1.0
    # Over so short a time, the decaying motion after lift-off is a parabola.
    templates = np.stack([position, np.ones(n), k, k**2], axis=1)
    pose = np.stack([turn[name][:n] for name in ("psi_rad", "theta_rad", "z_m")], axis=1)
    fresh = ~(turn["stale"][:n] & Stale.SENSORS).astype(bool)
    if fresh.sum() <= templates.shape[1]:
        return np.full(3, np.nan)
    fitted = np.linalg.lstsq(templates[fresh], pose[fresh].astype(float), rcond=None)
    return np.asarray(fitted[0][0])


def _unconfirmed_rows(rows: NDArray[np.void], coil: int, pushes: Pushes) -> int:
    """Count the most rows in a row without amplifier confirmation after a change of the push."""
    begin = coil * pushes.turn
    unconfirmed = (rows["stale"][begin : begin + pushes.turn] & _FORCE_UNCONFIRMED).astype(bool)
    longest = 0
    for change in np.array([0, 1, 3, 4]) * pushes.push:
        # A force acts from the next row on: confirmation may be missing from that row or its own.
        for first in (change, change + 1):
            confirmed = np.flatnonzero(~unconfirmed[first:])
            missing = int(confirmed[0]) if len(confirmed) else len(unconfirmed) - first
            longest = max(longest, missing)
    return longest
