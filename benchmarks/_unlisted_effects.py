"""Effects that no table of levid's has in this form, for asking how it speaks of the unknown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

Vector = Sequence[float]


class HungPlug:
    """A plug hangs at (x, y) on a springy cable: m u'' = -k (u - h) - c (u' - h').

    h is the height of the point it hangs from, k = m (2 pi f)^2, c = 2 zeta m 2 pi f; the platform
    gets k (u - h) + c (u' - h') there: an absorber (Den Hartog 1934) that takes up its frequency.
    The plug's weight is the model's, for it hangs there whenever it is weighed.
    """

    def __init__(
        self, mass_kg: float, freq_hz: float, damping: float, x_m: float, y_m: float
    ) -> None:
        w = 2.0 * math.pi * freq_hz
        self.mass_kg, self.x_m, self.y_m = mass_kg, x_m, y_m
        self.k_n_m, self.c_n_s_m = mass_kg * w * w, 2.0 * damping * mass_kg * w

    def reset(self, plant: Any) -> None:
        self.dt_s = plant.dt_s
        self.u_m: float | None = None
        self.rate_m_s = 0.0

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        rate = float(qd[2]) + self.y_m * float(qd[0]) + self.x_m * float(qd[1])
        h = float(q[2]) + self.y_m * float(q[0]) + self.x_m * float(q[1]) + 0.5 * self.dt_s * rate
        if self.u_m is None:
            self.u_m = h
        self.u_m += self.dt_s * self.rate_m_s
        force = self.k_n_m * (self.u_m - h) + self.c_n_s_m * (self.rate_m_s - rate)
        self.rate_m_s -= self.dt_s * force / self.mass_kg
        return (self.y_m * force, self.x_m * force, force)


class EddyBrake:
    """A magnet of the base brakes the beam's vertical motion while it is near: F = -d e^(-s^2) v.

    s = (x_b - x_0) / w, v = z' + x_b theta': eddy currents in the beam, which are no function of
    one DOF, nor of the beam's place alone.
    """

    def __init__(self, damping_n_s_m: float, at_m: float, width_m: float) -> None:
        self.damping_n_s_m, self.at_m, self.width_m = damping_n_s_m, at_m, width_m

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        near = math.exp(-(((beam.x_m - self.at_m) / self.width_m) ** 2))
        force = -self.damping_n_s_m * near * (float(qd[2]) + beam.x_m * float(qd[1]))
        return (0.0, beam.x_m * force, force)


class Gyroscope:
    """The turning rotor resists tilting: with H = J phi', tau_psi = H theta', tau_theta = -H psi'.

    About +x and +y the platform turns with (psi', -theta'), and gets -w x H e_z; J is the whole
    turning inertia about the upright, motor included, which the model has nowhere.
    """

    def __init__(self, j_kg_m2: float) -> None:
        self.j_kg_m2 = j_kg_m2

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        h = self.j_kg_m2 * beam.phi_rad_s
        return (h * float(qd[1]), -h * float(qd[0]), 0.0)


class PassingBeam:
    """A sensor also sees the magnets of the passing beam: h = h + y0 e^(-s^2), s = (x_b - x_0) / w.

    Nothing acts on the platform, but the controller follows what it is shown.
    """

    def __init__(self, sensor: int, offset_m: float, at_m: float, width_m: float) -> None:
        self.sensor, self.offset_m = sensor, offset_m
        self.at_m, self.width_m = at_m, width_m

    def reset(self, plant: Any) -> None:
        self._seen_m = 0.0

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        s = (beam.x_m - self.at_m) / self.width_m
        self._seen_m = self.offset_m * math.exp(-s * s)
        return (0.0, 0.0, 0.0)

    def gap(self, t_s: float, gap_m: Any) -> Any:
        gap_m[self.sensor] += self._seen_m
        return gap_m
