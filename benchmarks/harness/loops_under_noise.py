"""A mass on a spring and a damper, in open loop or under a controller, for tests and benchmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete

from levid.identification.records.record import Record


@dataclass(frozen=True)
class Loop:
    """u = C (0 - y) + excitation, computed in the row of y, or a given u; 1 kg, 2 N s/m, 50 N/m.

    kp, ki, kd: gains of C; its derivative has a lag of three rows. delay: rows from u to the force.
    force, sensor: deviations of a held white force in N and of white reading noise in m. input:
    that of the noise of the recorded u.
    """

    kp: float = 30.0
    ki: float = 50.0
    kd: float = 0.0
    delay: int = 0
    force: float = 0.3
    sensor: float = 1e-4
    input: float = 0.0
    Ts_s: float = 0.01

    def record(
        self,
        rows: int,
        seed: int,
        excitation: np.ndarray | None = None,
        given: np.ndarray | None = None,
        feedback: bool = False,
    ) -> Record:
        """Return the record of one seed; `given` (rows,) is the input of an open loop."""
        rng = np.random.default_rng(seed)
        A, B, *_ = cont2discrete(
            (
                np.array([[0.0, 1.0], [-50.0, -2.0]]),
                np.array([[0.0], [1.0]]),
                np.eye(2),
                np.zeros((2, 1)),
            ),
            self.Ts_s,
        )
        w, n = self.force * rng.normal(size=rows), self.sensor * rng.normal(size=rows)
        r = np.zeros(rows) if excitation is None else excitation
        x, u, y = np.zeros(2), np.zeros(rows), np.zeros(rows)
        integral = rate = before = 0.0
        late = [0.0] * self.delay
        for k in range(rows):
            y[k] = x[0] + n[k]
            integral -= y[k] * self.Ts_s
            rate += (-(y[k] - before) / self.Ts_s - rate) / 3.0
            before = y[k]
            u[k] = self.kp * -y[k] + self.ki * integral + self.kd * rate + r[k]
            if given is not None:
                u[k] = given[k]
            late.append(u[k])
            x = A @ x + B[:, 0] * (late.pop(0) + w[k])
        u = u + self.input * u.std() * rng.normal(size=rows)
        return Record(
            "r", self.Ts_s, u[:, None], y[:, None], ("f_n",), ("N",), ("x_m",), ("m",),
            feedback=feedback, held=True,
        )  # fmt: skip


def multisine(rows: int, lines: int, seed: int) -> np.ndarray:
    """Return the sum (rows,) of the record's first lines, with random phases and unit deviation."""
    rng, t = np.random.default_rng(seed), np.arange(rows) / rows
    phases = rng.uniform(0.0, 2.0 * np.pi, lines)
    waves = [np.cos(2 * np.pi * (k + 1) * t + p) for k, p in enumerate(phases)]
    return np.asarray(np.sum(waves, axis=0) / np.sqrt(lines / 2.0))


def steps(rows: int, length: int, seed: int) -> np.ndarray:
    """Return random steps (rows,) between -1 and 1, each of `length` rows."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.choice([-1.0, 1.0], -(-rows // length)), length)[:rows]
