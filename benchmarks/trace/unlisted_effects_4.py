"""One more effect that no table of levid's has, at one of the rods, by a fourth such author."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

Vector = Sequence[float]


class LoadedRod:
    """The rod that takes the beam's push stiffens and slants with it: F_z = -m_b a_b (z - h) / L.

    Platforms that only tilt and lift are held along x by a rod with notch hinges at both ends, from
    below their middle to a post of the base at +x, L away. Whatever accelerates the beam pushes the
    platform back, and the rod carries it: m_b a_b along x, tension where a_b > 0 and compression
    where it is below. The rod points from the height z of the middle to h, that of its end at the
    post, so that (h - z) / L of its load acts upwards. A rod in tension draws the platform to the
    level h like a string, one in compression drives it off like a column on its way to buckle
    (Timoshenko and Gere, Theory of Elastic Stability, 1961); in flexures it is known as load
    stiffening (Awtar, Slocum and Sevincer, J. Mech. Des. 129 (2007) 625). So the beam, as it
    accelerates, changes the stiffness in z by m_b a_b / L and pushes by m_b a_b h / L besides, for
    rods are seldom mounted level to the tenth of a millimetre.

    What the hinges and a tension at rest add is a part of the model's stiffness. The middle is on
    the tilts' axes, so that neither tilt moves the rod's end up, nor feels it. Its stretch, which
    lets the platform sway along x at some hundred hertz, is left out.
    """

    def __init__(self, m_b_kg: float, length_m: float, level_m: float) -> None:
        if not length_m > 0.0:
            raise ValueError(f"length_m: expected a number above 0, found {length_m!r}")
        self.m_b_kg, self.length_m, self.level_m = m_b_kg, length_m, level_m

    def reset(self, plant: Any) -> None:
        self._half_step_s = 0.5 * plant.dt_s

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        # The force is held over the step: z in its middle, or a spring would be a negative damper.
        z = float(q[2]) + self._half_step_s * float(qd[2])
        load = self.m_b_kg * beam.a_m_s2
        return (0.0, 0.0, load * (self.level_m - z) / self.length_m)
