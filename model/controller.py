"""Discrete controller of a loop as matrices: from references and outputs to inputs, with limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .second_order import StateSpace

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Controller:
    """x(k+1) = A x + B w + L (u - u0), u0 = C x + D w + v, u = u0 clipped to low and high.

    w = [r, y]: r references and n outputs. A (s, s), B (s, r + n), C (p, s), D (p, r + n);
    v is the excitation and feed-forward (p,), low and high (p,) may be infinite. L (s, p) is the
    back-calculation of the integrators.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    L: Array
    low: Array
    high: Array
    Ts_s: float
    references: int

    @property
    def limited(self) -> bool:
        """Whether any input has a limit."""
        return bool(np.any(np.isfinite(self.low) | np.isfinite(self.high)))

    @property
    def by_output(self) -> tuple[Array, Array]:
        """Columns (s, n) of B and (p, n) of D that belong to the outputs."""
        return self.B[:, self.references :], self.D[:, self.references :]

    def response(self, freq_hz: Array) -> NDArray[np.complex128]:
        """Return C (F, p, n) of u = -C y at freq_hz (F,), without limits; infinite at 0 Hz."""
        B, D = self.by_output
        z = np.exp(2j * np.pi * np.asarray(freq_hz, float) * self.Ts_s)[:, None, None]
        shifted = z * np.eye(len(self.A)) - self.A
        return np.asarray(-(self.C @ np.linalg.solve(shifted, np.broadcast_to(
            B.astype(complex), (len(z), *B.shape))) + D))  # fmt: skip

    def output(
        self, reference: Array, y: Array, v: Array, x0: Array | None = None
    ) -> tuple[Array, Array]:
        """Return the commands (N, p) and the state (s,) after the last row.

        reference (N, r), outputs y (N, n) and excitation v (N, p) by row; x0 (s,) is zero unless
        given.
        """
        from .controller_kernels import run_rows  # numba would delay the start of a daemon

        w = np.ascontiguousarray(np.hstack([reference, y]), float)
        x = np.zeros(len(self.A)) if x0 is None else np.array(x0, float)
        u = np.empty((len(w), len(self.C)))
        run_rows(self.A, self.B, self.C, self.D, self.L, self.low, self.high, w,
                 np.ascontiguousarray(v, float), x, u)  # fmt: skip
        return u, x

    def state_from(self, reference: Array, y: Array, v: Array, u: Array) -> Array:
        """Estimate the state (s,) before row 0 from recorded commands u (N, p), by least squares.

        Rows with a command at a limit do not count. A state that the commands do not show is zero.
        """
        if not len(self.A):
            return np.zeros(0)
        forced, _ = self.unlimited().output(reference, y, v)
        free = np.empty((len(u), len(self.C), len(self.A)))
        power = np.eye(len(self.A))
        for k in range(len(u)):
            free[k] = self.C @ power
            power = self.A @ power
        inside = (u > self.low) & (u < self.high)
        # After a limited row, back-calculation has changed the state: only the rows before it.
        until = len(u) if inside.all() else int(np.argmin(inside.all(axis=1)))
        rows = slice(0, until)
        flat = free[rows].reshape(-1, len(self.A))
        if not len(flat):
            return np.zeros(len(self.A))
        return np.asarray(np.linalg.lstsq(flat, (u - forced)[rows].reshape(-1), rcond=1e-9)[0])

    def unlimited(self) -> Controller:
        """Return the controller without limits."""
        wide = np.full(len(self.C), np.inf)
        return Controller(
            self.A, self.B, self.C, self.D, self.L, -wide, wide, self.Ts_s, self.references
        )


def pi_controller(kp: Array, ki: Array, Ts_s: float) -> Controller:
    """Return diagonal PI controllers u = kp e + I, I += ki Ts e, e = r - y; kp and ki are (p,)."""
    p = len(kp)
    one = np.eye(p)
    by_error, at_once = np.diag(ki * Ts_s), np.diag(kp + ki * Ts_s)
    wide = np.full(p, np.inf)
    return Controller(
        one, np.hstack([by_error, -by_error]), one.copy(), np.hstack([at_once, -at_once]),
        np.zeros((p, p)), -wide, wide, Ts_s, p,
    )  # fmt: skip


def closed_loop(plant: StateSpace, controller: Controller) -> Array:
    """Return the state matrix (m + s, m + s) of a sampled plant in its loop, without limits.

    The plant's states (m) come first, then the controller's; the plant has D = 0.
    """
    B_y, D_y = controller.by_output
    A = plant.A + plant.B @ D_y @ plant.C
    return np.block([[A, plant.B @ controller.C], [B_y @ plant.C, controller.A]])
