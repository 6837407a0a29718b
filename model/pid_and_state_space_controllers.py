"""Build the matrices of a controller from PID loops, cascades of them, or a state-space law."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from .controller import Controller

Array = NDArray[np.float64]
Step = Callable[[Array, Array], tuple[list[float], float]]
"""Advance one PID law: states and [references, outputs] to the next states and the output."""


@dataclass(frozen=True)
class PidLoop:
    """out = kp e + ki * sum of e Ts + kd * backward difference of e per second, e = reference - y.

    y is the mean of the last `average` samples of `measured`, or with `rate` its backward
    difference per second. The derivative has a first-order filter and may be that of -y.
    """

    measured: str
    gains: tuple[float, float, float]
    rate: bool = False
    average: int = 1
    derivative_filter_s: float = 0.0
    derivative_of: Literal["error", "measured"] = "error"


@dataclass(frozen=True)
class PidLaw:
    """Loops from outer to inner, each the reference of the next; limits, then the actuator.

    `tracking_s`: time constant of the back-calculation of the innermost integral. The actuator is a
    gain and a first-order lag from the output to the recorded input.
    """

    loops: tuple[PidLoop, ...]
    limits: tuple[float, float] = (-np.inf, np.inf)
    tracking_s: float | None = None
    actuator_gain: float = 1.0
    actuator_lag_s: float = 0.0


@dataclass(frozen=True)
class StateSpaceLaw:
    """x(k+1) = A x + B w, u = C x + D w; w and u by name; limits (2, p): low and high of each u."""

    drives: tuple[str, ...]
    w: tuple[str, ...]
    A: Array
    B: Array
    C: Array
    D: Array
    limits: Array | None = None

    def references(self, outputs: Sequence[str]) -> list[str]:
        """Return the signals of w that are no outputs."""
        return [name for name in self.w if name not in outputs]


def pid_controller(
    laws: Mapping[str, PidLaw], inputs: Sequence[str], outputs: Sequence[str], Ts_s: float
) -> Controller:
    """Return PID laws by the input that they drive; the r-th reference is that of the r-th law.

    Raises ValueError for a driven input or a measured output that is not among the names.
    """
    _check_names("drives", tuple(laws), inputs)
    for law in laws.values():
        _check_names("measured", [loop.measured for loop in law.loops], outputs)
    p, references = len(inputs), len(laws)
    blocks = []
    low, high = np.full(p, -np.inf), np.full(p, np.inf)
    B, C, D, L = [], [], np.zeros((p, references + len(outputs))), []
    for number, (name, law) in enumerate(laws.items()):
        row = inputs.index(name)
        states = _states(law)
        A_law, B_law, C_law, D_law = _matrices(
            _step(law, number, [references + outputs.index(q.measured) for q in law.loops], Ts_s),
            states,
            D.shape[1],
        )
        blocks.append(A_law)
        B.append(B_law)
        by_row = np.zeros((p, states))
        by_row[row] = C_law
        C.append(by_row)
        D[row] = D_law
        tracking = np.zeros((states, p))
        if law.tracking_s is not None:
            tracking[_last_integral(law), row] = Ts_s / law.tracking_s
        L.append(tracking)
        low[row], high[row] = law.limits
    return Controller(
        block_diag(*blocks), np.vstack(B), np.hstack(C), D, np.vstack(L), low, high, Ts_s,
        references,
    )  # fmt: skip


def state_space_controller(
    law: StateSpaceLaw, inputs: Sequence[str], outputs: Sequence[str], Ts_s: float
) -> Controller:
    """Return the controller of a state-space law; its references are those of `law.references`.

    Raises ValueError for a driven input that is not among `inputs`.
    """
    _check_names("drives", law.drives, inputs)
    references = law.references(outputs)
    s, p, width = len(law.A), len(inputs), len(references) + len(outputs)
    order = [*references, *outputs]
    columns = [order.index(name) for name in law.w]
    rows = [inputs.index(name) for name in law.drives]
    B, C, D = np.zeros((s, width)), np.zeros((p, s)), np.zeros((p, width))
    B[:, columns] = law.B
    C[rows] = law.C
    D[np.ix_(rows, columns)] = law.D
    low, high = np.full(p, -np.inf), np.full(p, np.inf)
    if law.limits is not None:
        low[rows], high[rows] = law.limits
    return Controller(law.A, B, C, D, np.zeros((s, p)), low, high, Ts_s, len(references))


def delayed(c: Controller) -> Controller:
    """Return the controller with its command one row later; the last command becomes a state."""
    s, p = len(c.A), len(c.C)
    return Controller(
        np.block([[c.A, np.zeros((s, p))], [c.C, np.zeros((p, p))]]),
        np.vstack([c.B, c.D]),
        np.hstack([np.zeros((p, s)), np.eye(p)]),
        np.zeros_like(c.D),
        np.vstack([c.L, np.zeros((p, p))]),
        c.low, c.high, c.Ts_s, c.references,
    )  # fmt: skip


def _check_names(key: str, found: Sequence[str], known: Sequence[str]) -> None:
    wrong = [name for name in found if name not in known]
    if wrong:
        raise ValueError(f"{key}: expected one of {', '.join(known)}, found {', '.join(wrong)}")


def _states(law: PidLaw) -> int:
    return sum(_loop_states(*_parts(loop)) for loop in law.loops) + (law.actuator_lag_s > 0.0)


def _parts(loop: PidLoop) -> tuple[int, bool, bool]:
    """Return the number of earlier samples, and whether there are an integral and a derivative."""
    _, ki, kd = loop.gains
    return loop.average - 1 + loop.rate, ki != 0.0, kd != 0.0


def _loop_states(earlier: int, integral: bool, derivative: bool) -> int:
    return earlier + integral + 2 * derivative


def _last_integral(law: PidLaw) -> int:
    """Return the index of the innermost loop's integral among the law's states."""
    before = sum(_loop_states(*_parts(loop)) for loop in law.loops[:-1])
    return before + _parts(law.loops[-1])[0]


def _step(law: PidLaw, reference: int, measured: Sequence[int], Ts_s: float) -> Step:
    """Return the law as a function of its states and of w; it is linear."""

    def step(x: Array, w: Array) -> tuple[list[float], float]:
        following: list[float] = []
        target = w[reference]
        for loop, column in zip(law.loops, measured, strict=True):
            kp, ki, kd = loop.gains
            earlier, has_integral, has_derivative = _parts(loop)
            i = len(following)
            samples = np.array([w[column], *x[i : i + earlier]])
            value = samples[: loop.average].mean()
            if loop.rate:
                value = (value - samples[1 : loop.average + 1].mean()) / Ts_s
            following += samples[:earlier].tolist()
            error = target - value
            target = kp * error
            if has_integral:
                following.append(x[len(following)] + ki * Ts_s * error)
                target += following[-1]
            if has_derivative:
                now = error if loop.derivative_of == "error" else -value
                last, filtered = x[len(following) : len(following) + 2]
                lag_s = loop.derivative_filter_s
                filtered = (lag_s * filtered + kd * (now - last)) / (lag_s + Ts_s)
                target += filtered
                following += [now, filtered]
        out = law.actuator_gain * target
        if law.actuator_lag_s > 0.0:
            decay, before = np.exp(-Ts_s / law.actuator_lag_s), x[len(following)]
            following.append(decay * before + (1.0 - decay) * out)
            out = before
        return following, out

    return step


def _matrices(step: Step, states: int, width: int) -> tuple[Array, Array, Array, Array]:
    """Return A, B, C, D of a linear step function, from its values at unit vectors."""
    size = states + width
    next_states, out = np.empty((states, size)), np.empty(size)
    for column, unit in enumerate(np.eye(size)):
        following, out[column] = step(unit[:states], unit[states:])
        next_states[:, column] = following
    return next_states[:, :states], next_states[:, states:], out[:states], out[states:]
