"""One more effect that no table of levid's has, at one coil's amplifier, by another such author."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

Vector = Sequence[float]

_STOPS = 10


class TransducerCore:
    """An amplifier sees its current by an iron core's field: F = F + e (s_1 + ... + s_n) / n.

    s_k = min(max(s_k + dF, -r_k), r_k), r_k = (k - 1/2) w / n, dF the change of F since the step
    before. The amplifier holds what its open-loop Hall transducer shows (Ripka, Meas. Sci. Technol.
    21 (2010) 112001), the flux density in the slit of a ring that carries the coil's current N
    times: N i = B g / mu_0 + H l. So the coil gets the current asked for, B g / mu_0 N, and H l / N
    on top, which the ring takes and nobody sees. H follows B with hysteresis, here Prandtl's stop
    operators of even density (Brokate and Sprekels, Hysteresis and Phase Transitions, 1996): on
    turning, H changes by the slope e, l / mu_i g, and ever less, as a parabola, until B has gone
    2 w back, as on the loops of Rayleigh (Phil. Mag. 23 (1887) 225) with H and B exchanged. It
    depends on where the coil's own force turned, and not on how fast it goes. w is a force too. F
    is the force that the coil was asked for, as its amplifier follows it, and what the amplifier
    tells of its current is not changed. The ring begins without magnetisation.
    """

    def __init__(self, coil: int, share: float, width_n: float) -> None:
        self.coil, self.share = coil, share
        self._reach_n = [(k + 0.5) * width_n / _STOPS for k in range(_STOPS)]

    def reset(self, plant: Any) -> None:
        self._last_n = 0.0
        self._stop_n = [0.0] * _STOPS

    def coil_force(self, t_s: float, q: Vector, force_n: Any) -> Any:
        force = float(force_n[self.coil])
        change, self._last_n = force - self._last_n, force
        total = 0.0
        for k, reach in enumerate(self._reach_n):
            stop = min(max(self._stop_n[k] + change, -reach), reach)
            self._stop_n[k] = stop
            total += stop
        force_n[self.coil] += self.share * total / _STOPS
        return force_n
