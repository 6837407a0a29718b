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


class StrayField:
    """A sensor's core feels the field of a coil: h = h + e ((F / F_0)^2 - 1), F that coil's force.

    A field across the ferrite lowers its permeability, whatever its sign (Snelling, Soft Ferrites,
    1988, on superposed fields), so that an inductive sensor reads more the stronger the current. e
    is what it reads more at the force F_0 that a coil carries at rest, where sensors are zeroed. No
    force acts on the platform.
    """

    def __init__(self, sensor: int, coil: int, offset_m: float, rest_n: float) -> None:
        self.sensor, self.coil = sensor, coil
        self.offset_m, self.rest_n = offset_m, rest_n

    def reset(self, plant: Any) -> None:
        # `gap` is asked once before the first step, when the coils are off.
        self._seen_m = -self.offset_m

    def coil_force(self, t_s: float, q: Vector, force_n: Any) -> Any:
        share = float(force_n[self.coil]) / self.rest_n
        self._seen_m = self.offset_m * (share * share - 1.0)
        return force_n

    def gap(self, t_s: float, gap_m: Any) -> Any:
        gap_m[self.sensor] += self._seen_m
        return gap_m


class SharedYoke:
    """The flux of coil b goes through the iron of coil a: F_a = F_a (1 - e (F_b - F_0) / F_0).

    It drives the iron towards saturation, and less of the magnet's flux is left in the gap of a:
    the armature reaction of electric machines, but of a neighbour, and to first order in its
    current. e is the loss at the force F_0 that a coil carries at rest; constants are measured
    there, so that no coil has a gain of its own.
    """

    def __init__(self, coil: int, neighbour: int, loss: float, rest_n: float) -> None:
        self.coil, self.neighbour = coil, neighbour
        self.loss, self.rest_n = loss, rest_n

    def coil_force(self, t_s: float, q: Vector, force_n: Any) -> Any:
        beyond = float(force_n[self.neighbour]) / self.rest_n - 1.0
        force_n[self.coil] *= 1.0 - self.loss * beyond
        return force_n


class CableLoop:
    """The loop of a cable follows the beam with a play b: tau_theta = -m g (u - x_b).

    u = min(max(u, x_b - b), x_b + b) is where the loop lies: it stays where friction holds it until
    the beam takes it along, a play operator (Krasnosel'skii and Pokrovskii 1989), which depends on
    where the beam turned last and not on how fast it goes. The loop's weight is the model's, a part
    of the beam's; that it lies behind is not. Its inertia is left out.
    """

    def __init__(self, mass_kg: float, play_m: float) -> None:
        self.weight_n, self.play_m = mass_kg * 9.81, play_m

    def reset(self, plant: Any) -> None:
        self._at_m = 0.0

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        self._at_m = min(max(self._at_m, beam.x_m - self.play_m), beam.x_m + self.play_m)
        return (0.0, -self.weight_n * (self._at_m - beam.x_m), 0.0)
