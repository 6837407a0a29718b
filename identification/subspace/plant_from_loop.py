"""Compute the plant from the identified loop, eq. (14), with the controller cancelled exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...model.second_order import StateSpace
from ..records.record import IdentificationError, PiController

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class IdentifiedPlant:
    """P(z) = z^-d (1 - a) / (1 - a z^-1) Q(z): known delay d and lag a, identified core Q.

    `core` is Q in state space (six states for the rig); `delay_steps` d includes the hold's step;
    `lag_pole` a is 0 without a known lag.
    """

    core: StateSpace
    delay_steps: int = 0
    lag_pole: float = 0.0

    def response(self, freq_hz: Array) -> Complex:
        """Return the frequency response (F, m, p) of P at freq_hz (F,)."""
        return np.asarray(self.known(freq_hz)[:, None, None] * self.core.response(freq_hz))

    def known(self, freq_hz: Array) -> Complex:
        """Return the response (F,) of delay and lag."""
        z = np.exp(2j * np.pi * np.asarray(freq_hz) * self.core.Ts_s)
        return np.asarray(z**-self.delay_steps * (1 - self.lag_pole) / (1 - self.lag_pole / z))

    def slopes(self, freq_hz: Array) -> tuple[Complex, Complex]:
        """Return L (F, m, n + m) and R (F, n + p, p): dP = L d[A B; C D] R."""
        core = self.core
        n, m, p = len(core.A), len(core.C), len(core.B[0])
        z = np.exp(2j * np.pi * np.asarray(freq_hz) * core.Ts_s)
        inverse = np.linalg.inv(z[:, None, None] * np.eye(n) - core.A)
        ones = np.ones((len(z), 1, 1))
        left = np.concatenate([core.C @ inverse, np.eye(m) * ones], axis=2)
        right = np.concatenate([inverse @ core.B, np.eye(p) * ones], axis=1)
        return np.asarray(self.known(freq_hz)[:, None, None] * left), np.asarray(right)

    def state_space(self) -> StateSpace:
        """Return P in state space, with delay and lag as states."""
        model = self.core
        if self.lag_pole:
            model = series(_lag(len(model.B[0]), self.lag_pole, model.Ts_s), model)
        for _ in range(self.delay_steps):
            model = series(_delay(len(model.B[0]), model.Ts_s), model)
        return model


def plant_from_loop(loop: StateSpace, controller: PiController) -> StateSpace:
    """Return P = G (I - C G)^-1 (14) without the modes that cancel between G and C.

    Closing the loop again with +C gives n + 3 states, of which 3 + 3 are integrators of C: three
    unreachable from u and three unobservable in y, all at z = 1. The Popov-Belevitch-Hautus test
    finds them there, without a search for nearby poles, and they are removed. With noise they are
    only near z = 1; forcing them to z = 1 first, by the zeros that integral action gives G, makes
    errors up to 25 times larger. The result has n - 3 states for three integrators. The plant may
    be unstable.

    Raises IdentificationError if G has no more states than cancel.
    """
    integrators = int(np.sum(controller.ki > 0))
    n = len(loop.A)
    if n <= integrators:
        raise IdentificationError(
            f"expected a loop of more states than its controller's {integrators} integrators, "
            f"found order {n}"
        )
    return _without_integrators(_closed_with(loop, controller), integrators)


def closed_loop(plant: StateSpace, controller: PiController) -> StateSpace:
    """Return G = P (I + C P)^-1 from v to y for u = v - C y, integrators as the last states."""
    return _closed_with(plant, PiController(-controller.kp, -controller.ki))


def series(first: StateSpace, second: StateSpace) -> StateSpace:
    """Return second * first: the output of `first` drives `second`."""
    n = len(first.A)
    A = np.block([[first.A, np.zeros((n, len(second.A)))], [second.B @ first.C, second.A]])
    return StateSpace(
        A,
        np.vstack([first.B, second.B @ first.D]),
        np.hstack([second.D @ first.C, second.C]),
        second.D @ first.D,
        first.Ts_s,
    )


def _closed_with(model: StateSpace, controller: PiController) -> StateSpace:
    """Return the loop of `model` with the input u + C y; the model's states come first."""
    active = np.flatnonzero(controller.ki)
    m = len(model.C)
    pick = np.eye(m)[active]  # integrators' inputs
    direct = np.diag(controller.kp + controller.ki * model.Ts_s)
    integral = (np.diag(controller.ki * model.Ts_s))[:, active]
    solve = np.linalg.inv(np.eye(len(direct)) - direct @ model.D)
    # w = solve (u + direct C x + integral s) enters the model, y = C x + D w, s+ = s + pick y
    wx, ws, wu = solve @ direct @ model.C, solve @ integral, solve
    yx, ys, yu = model.C + model.D @ wx, model.D @ ws, model.D @ wu
    A = np.block(
        [
            [model.A + model.B @ wx, model.B @ ws],
            [pick @ yx, np.eye(len(active)) + pick @ ys],
        ]
    )
    return StateSpace(A, np.vstack([model.B @ wu, pick @ yu]), np.hstack([yx, ys]), yu, model.Ts_s)


def _without_integrators(model: StateSpace, count: int) -> StateSpace:
    """Remove `count` unreachable and `count` unobservable modes at z = 1."""
    if count == 0:
        return model
    observable = _without_unobservable(model, count)
    return _transposed(_without_unobservable(_transposed(observable), count))


def _without_unobservable(model: StateSpace, count: int) -> StateSpace:
    """Remove the `count` directions x with (A - I) x = 0 and C x = 0 (in least squares)."""
    n = len(model.A)
    stack = np.vstack(
        [(model.A - np.eye(n)) / _size(model.A - np.eye(n)), model.C / _size(model.C)]
    )
    keep = np.linalg.svd(stack)[2][: n - count]  # orthonormal rows, unobservable directions last
    return StateSpace(
        keep @ model.A @ keep.T, keep @ model.B, model.C @ keep.T, model.D, model.Ts_s
    )


def _transposed(model: StateSpace) -> StateSpace:
    return StateSpace(model.A.T, model.C.T, model.B.T, model.D.T, model.Ts_s)


def _size(matrix: Array) -> float:
    return float(np.linalg.norm(matrix)) or 1.0


def _delay(p: int, Ts_s: float) -> StateSpace:
    return StateSpace(np.zeros((p, p)), np.eye(p), np.eye(p), np.zeros((p, p)), Ts_s)


def _lag(p: int, pole: float, Ts_s: float) -> StateSpace:
    # (1 - a) / (1 - a z^-1) = (1 - a) + a (1 - a) / (z - a)
    eye = np.eye(p)
    return StateSpace(pole * eye, eye, pole * (1 - pole) * eye, (1 - pole) * eye, Ts_s)
