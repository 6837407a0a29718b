"""More effects that no table of levid's has, by an author who did not know what it looks for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

Vector = Sequence[float]

_AIR_KG_M3 = 1.2


class ClosedCover:
    """The beam is a piston under a cover of the base: tau_theta = -B dp (L^2 - x_b^2) / 2.

    dp = rho / 2 zeta v_b |v_b| drives the air past the beam, as in a train's tunnel, for the cover,
    B wide and 2 L long, is closed at both ends (zeta: Idelchik, Handbook of Hydraulic Resistance;
    about 1.5 / (1 - b)^2 where the beam fills the share b). Along the cover's edges a narrow slit
    is left to the platform; as much leaks out ahead of the beam as comes in behind, so that dp
    (L + x_b) / 2 L presses down on the length L - x_b ahead, and dp (L - x_b) / 2 L lifts the
    length L + x_b behind: as much one way as the other, and a torque remains. The drag on the beam
    itself turns the platform by less than a tenth of it, under a cover 2 cm high, and is left out.
    """

    def __init__(self, zeta: float, width_m: float, half_length_m: float) -> None:
        self.half_length_m = half_length_m
        self._n_s2_m3 = 0.5 * width_m * 0.5 * _AIR_KG_M3 * zeta

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        spread_m2 = self.half_length_m**2 - beam.x_m * beam.x_m
        return (0.0, -self._n_s2_m3 * beam.v_m_s * abs(beam.v_m_s) * spread_m2, 0.0)


class PulledOscillator:
    """A sensor's oscillator is pulled to its neighbour's frequency: h_a = h_a - L g(s).

    s = (h_a - h_b - d) / L; g = s where |s| < 1, s - sgn(s) sqrt(s^2 - 1) beyond. Each sensor is
    the coil of an oscillator whose frequency is counted and tells the gap, and the two have one
    frequency where h_a = h_b + d. Within L of that the first is locked and shows h_b + d; outside
    it slips past, and its mean frequency is off by less and less, L / 2 s (Adler, Proc. IRE 34
    (1946) 351). The count lasts longer than a beat. The neighbour, stronger, is not pulled. No
    force acts on the platform.
    """

    def __init__(self, sensor: int, neighbour: int, lock_m: float, apart_m: float) -> None:
        self.sensor, self.neighbour = sensor, neighbour
        self.lock_m, self.apart_m = lock_m, apart_m

    def gap(self, t_s: float, gap_m: Any) -> Any:
        off = float(gap_m[self.sensor] - gap_m[self.neighbour]) - self.apart_m
        beat = math.sqrt(max(off * off - self.lock_m * self.lock_m, 0.0))
        gap_m[self.sensor] -= off - math.copysign(beat, off)
        return gap_m


class SecondStage:
    """An amplifier switches to its stage for large currents: F = F + u e, u = 1 or 0.

    u becomes 1 once F is `on_n` or more, and 0 once it is `off_n` or less; in between it stays, so
    that the relay does not chatter. e is by how much the second stage's offset differs from the
    first one's: ranges of a source of current, or the rails of an amplifier of class G. F is the
    force that the coil was asked for, as its amplifier follows it. It begins switched off.
    """

    def __init__(self, coil: int, step_n: float, on_n: float, off_n: float) -> None:
        if not off_n <= on_n:
            raise ValueError(f"off_n: expected on_n = {on_n!r} or less, found {off_n!r}")
        self.coil, self.step_n = coil, step_n
        self.on_n, self.off_n = on_n, off_n

    def reset(self, plant: Any) -> None:
        self._on = False

    def coil_force(self, t_s: float, q: Vector, force_n: Any) -> Any:
        force = float(force_n[self.coil])
        self._on = force > self.off_n if self._on else force >= self.on_n
        if self._on:
            force_n[self.coil] += self.step_n
        return force_n
