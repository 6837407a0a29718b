"""Friction of a cable chain to the fixed frame: Coulomb, Stribeck, Dahl, LuGre, Bouc-Wen, Iwan.

All resist the motion s of one DOF (see OnDof): the force on the platform is -F. Models with memory
are integrated over the displacement ds since the last step, exactly or with fourth order, so that a
rate-independent model stays rate-independent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from .effect_interface import EffectPlant
from .places import Dof, OnDof, positive

_LONGEST = 0.5
"""Step of the Bouc-Wen integration over its yield displacement."""
_FARTHEST = 50.0
"""Longest integrated displacement over the yield displacement; memory is lost far earlier."""


class Coulomb(OnDof):
    """F = F_c tanh(v / v_0): dry friction, smooth below the speed v_0 (Armstrong et al. 1994)."""

    def __init__(self, dof: Dof, coulomb_n: float, speed_m_s: float) -> None:
        super().__init__(dof)
        positive(coulomb_n=coulomb_n, speed_m_s=speed_m_s)
        self.coulomb_n, self.speed_m_s = coulomb_n, speed_m_s

    def force(self, s: float, v: float) -> float:
        """Return the force on the platform in N."""
        return -self.coulomb_n * math.tanh(v / self.speed_m_s)


class Stribeck(OnDof):
    """F = (F_c + (F_s - F_c) exp(-(v / v_s)^2)) tanh(v / v_0): a peak at low speed.

    Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994) 1083.
    """

    def __init__(
        self, dof: Dof, coulomb_n: float, static_n: float, stribeck_m_s: float, speed_m_s: float
    ) -> None:
        super().__init__(dof)
        positive(stribeck_m_s=stribeck_m_s, speed_m_s=speed_m_s)
        self.coulomb_n, self.static_n = coulomb_n, static_n
        self.stribeck_m_s, self.speed_m_s = stribeck_m_s, speed_m_s

    def force(self, s: float, v: float) -> float:
        """Return the force on the platform in N."""
        slow = math.exp(-((v / self.stribeck_m_s) ** 2))
        level = self.coulomb_n + (self.static_n - self.coulomb_n) * slow
        return -level * math.tanh(v / self.speed_m_s)


class WithMemory(OnDof):
    """Base of friction that depends on the displacement; it starts unstrained."""

    def reset(self, plant: EffectPlant) -> None:
        """Start at an unknown position."""
        super().reset(plant)
        self._last_m: float | None = None

    def force(self, s: float, v: float) -> float:
        """Return the force on the platform in N."""
        ds = 0.0 if self._last_m is None else s - self._last_m
        self._last_m = s
        return -self.resistance(ds, v)

    def resistance(self, ds: float, v: float) -> float:
        """Return F in N after a further displacement ds in m, at the speed v in m/s."""
        raise NotImplementedError


class Dahl(WithMemory):
    """dF/ds = k (1 - F sgn(ds) / F_c): elastic, then sliding (Dahl 1968). Exact for any ds."""

    def __init__(self, dof: Dof, coulomb_n: float, stiffness_n_m: float) -> None:
        super().__init__(dof)
        positive(coulomb_n=coulomb_n, stiffness_n_m=stiffness_n_m)
        self.coulomb_n, self.stiffness_n_m = coulomb_n, stiffness_n_m

    def reset(self, plant: EffectPlant) -> None:
        """Start unstrained."""
        super().reset(plant)
        self._force_n = 0.0

    def resistance(self, ds: float, v: float) -> float:
        """Return F in N."""
        end = math.copysign(self.coulomb_n, ds)
        self._force_n = end + (self._force_n - end) * math.exp(
            -self.stiffness_n_m * abs(ds) / self.coulomb_n
        )
        return self._force_n


class LuGre(WithMemory):
    """z' = v - k |v| z / g(v), F = k z + c z', g = F_c + (F_s - F_c) exp(-(v / v_s)^2).

    Bristles that bend and slip: Canudas de Wit et al., IEEE Trans. Autom. Control 40 (1995) 419.
    Exact for a constant speed over the step.
    """

    def __init__(
        self,
        dof: Dof,
        coulomb_n: float,
        static_n: float,
        stribeck_m_s: float,
        stiffness_n_m: float,
        damping_n_s_m: float,
    ) -> None:
        super().__init__(dof)
        positive(coulomb_n=coulomb_n, static_n=static_n, stribeck_m_s=stribeck_m_s)
        positive(stiffness_n_m=stiffness_n_m)
        self.coulomb_n, self.static_n, self.stribeck_m_s = coulomb_n, static_n, stribeck_m_s
        self.stiffness_n_m, self.damping_n_s_m = stiffness_n_m, damping_n_s_m

    def reset(self, plant: EffectPlant) -> None:
        """Start with undeflected bristles."""
        super().reset(plant)
        self._bristle_m = 0.0

    def resistance(self, ds: float, v: float) -> float:
        """Return F in N."""
        slow = math.exp(-((v / self.stribeck_m_s) ** 2))
        g = self.coulomb_n + (self.static_n - self.coulomb_n) * slow
        end = math.copysign(g / self.stiffness_n_m, ds)
        bent = end + (self._bristle_m - end) * math.exp(-self.stiffness_n_m * abs(ds) / g)
        rate = (bent - self._bristle_m) / self._dt_s
        self._bristle_m = bent
        return self.stiffness_n_m * bent + self.damping_n_s_m * rate


class BoucWen(WithMemory):
    """F = k (a s + (1 - a) y z), y dz/ds = 1 - |z|^n (g + b sgn(z ds)), g = 1 - b.

    k is the initial stiffness, y the yield displacement, a the remaining share of k after yield, n
    the sharpness of the knee, b the dissipation (0.5: unloading begins with the stiffness k). s is
    relative to the first position. Wen, J. Eng. Mech. 102 (1976) 249; Ismail, Ikhouane and
    Rodellar, Arch. Comput. Methods Eng. 16 (2009) 161.
    """

    def __init__(
        self,
        dof: Dof,
        stiffness_n_m: float,
        yield_m: float,
        left: float = 0.0,
        exponent: float = 1.0,
        loss: float = 0.5,
    ) -> None:
        super().__init__(dof)
        positive(yield_m=yield_m)
        if exponent < 1.0:
            raise ValueError(f"exponent: expected 1 or more, found {exponent!r}")
        if not 0.0 <= left <= 1.0:
            raise ValueError(
                f"left: expected a share of the stiffness, 0 .. 1, found {left!r}; outside this "
                "range the hysteresis could generate energy"
            )
        if not 0.5 <= loss <= 1.0:
            raise ValueError(
                f"loss: expected 0.5 .. 1, found {loss!r}; below 0.5 the hysteresis could generate "
                "energy"
            )
        self.stiffness_n_m, self.yield_m, self.left = stiffness_n_m, yield_m, left
        self.exponent, self.loss = exponent, loss

    def reset(self, plant: EffectPlant) -> None:
        """Start unstrained."""
        super().reset(plant)
        self._z, self._way_m = 0.0, 0.0

    def resistance(self, ds: float, v: float) -> float:
        """Return F in N, by short Runge-Kutta steps of fourth order along ds."""
        whole = min(max(ds / self.yield_m, -_FARTHEST), _FARTHEST)
        steps = 1 + int(abs(whole) / _LONGEST)
        for _ in range(steps):
            self._step(whole / steps)
        self._way_m += ds
        own = (1.0 - self.left) * self.yield_m * self._z
        return self.stiffness_n_m * (self.left * self._way_m + own)

    def _step(self, h: float) -> None:
        z = self._z
        a = self._slope(z, h)
        b = self._slope(z + 0.5 * h * a, h)
        c = self._slope(z + 0.5 * h * b, h)
        d = self._slope(z + h * c, h)
        self._z = min(max(z + h * (a + 2.0 * (b + c) + d) / 6.0, -1.0), 1.0)

    def _slope(self, z: float, h: float) -> float:
        side = self.loss if z * h > 0.0 else -self.loss
        size = abs(z) if self.exponent == 1.0 else abs(z) ** self.exponent
        return 1.0 - size * (1.0 - self.loss + side)


class MaxwellSlip(WithMemory):
    """F = sum of f_j, df_j = k_j ds with |f_j| at most W_j: springs that slip one after the other.

    Iwan, J. Appl. Mech. 33 (1966) 893; Lampaert, Al-Bender and Swevers 2003. Exact.
    """

    def __init__(self, dof: Dof, stiffness_n_m: Sequence[float], slip_n: Sequence[float]) -> None:
        super().__init__(dof)
        self._springs = Springs(stiffness_n_m, slip_n)

    def reset(self, plant: EffectPlant) -> None:
        """Start with unstrained springs."""
        super().reset(plant)
        self._springs.slacken()

    def resistance(self, ds: float, v: float) -> float:
        """Return F in N."""
        return self._springs.force(ds)


class Springs:
    """Parallel springs k_j, each of which slips at the force W_j.

    Raises:
        ValueError: the lists are empty or have different lengths.
    """

    def __init__(self, stiffness_n_m: Sequence[float], slip_n: Sequence[float]) -> None:
        if len(stiffness_n_m) != len(slip_n) or not slip_n:
            raise ValueError(
                "stiffness_n_m and slip_n: expected lists of one length, found "
                f"{len(stiffness_n_m)} and {len(slip_n)}"
            )
        for k, slip in zip(stiffness_n_m, slip_n, strict=True):
            positive(stiffness_n_m=k, slip_n=slip)
        self._pairs = list(zip(map(float, stiffness_n_m), map(float, slip_n), strict=True))
        self.slacken()

    def slacken(self) -> None:
        """Set all spring forces to zero."""
        self._forces = [0.0] * len(self._pairs)

    def force(self, ds: float) -> float:
        """Return F in N after a further displacement ds in m."""
        total = 0.0
        for j, (k, slip) in enumerate(self._pairs):
            f = min(max(self._forces[j] + k * ds, -slip), slip)
            self._forces[j] = f
            total += f
        return total
