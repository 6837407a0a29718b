"""The simulated plant: command in, one period of motion, readings out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..config.sim import SimConfig
from . import plant_kernels as k
from .effects import HOOKS, BeamState, EffectError, Effects
from .plant_arrays import Arrays
from .plant_kernels import Array


class Plant:
    """The rig in software, advanced by whole control periods.

    After `sample()`: `gap_m` (S,) m, `coil_readback_n` (C,) N, `beam` (3,) m, m/s, N and `rotor`
    (3,) rad, rad/s, N m. The arrays stay the same objects and are overwritten by the next sample.

    Args:
        config: what the plant is made of.
        period_s: control period; it is cut into equal internal steps of at most config.step_s.
        source: the SIM.yaml, in whose folder files of effects are looked for first, and which
            errors name.

    Raises:
        EffectError: an effect that cannot be loaded or answers wrongly.
        ValueError: a period that is not a positive number.
    """

    def __init__(self, config: SimConfig, period_s: float, *, source: Path | None = None) -> None:
        self._a = Arrays.build(config, period_s)
        self._level = LEVELS[config.plant]
        # Compile now, on arrays of no consequence, and not in the first cycle of a real clock.
        self._level.warm_up(Arrays.build(config, period_s), by_steps=bool(config.effects))
        self._period_s, self._periods = period_s, 0
        self._push = np.zeros(3)
        self._dt_s = period_s / self._a.n_steps

        self._effects = Effects(config.effects, source)
        seeds = np.random.SeedSequence(config.seed).spawn(1 + len(config.effects))
        self._rng = np.random.default_rng(seeds[0])
        self._effects.reset(
            self._dt_s,
            [np.random.default_rng(seed) for seed in seeds[1:]],
            config.geometry,
            config.beam.z_b_m,
        )

        n_sensors, n_coils = config.geometry.n_sensors, config.geometry.n_coils
        self._published = np.zeros(n_sensors + n_coils + 6)
        self.gap_m, self.coil_readback_n, self.beam, self.rotor = np.split(
            self._published, np.cumsum([n_sensors, n_coils, 3])
        )
        a = self._a
        self._rng.standard_normal(out=a.noise)
        self._look(0.0)
        self._level.measure(a.par, a.st, a.coils, a.sensors, a.noise, a.out)
        self.sample()

    @property
    def time_s(self) -> float:
        """Return the time since the start, s."""
        return self._periods * self._period_s

    @property
    def dt_s(self) -> float:
        """Return the internal step, s."""
        return self._dt_s

    @property
    def pose(self) -> Array:
        """Return a copy of the true [psi, theta, z] (3,): for tests and figures, not for a log."""
        return self._a.st[k.Q : k.Q + 3].copy()

    @property
    def pose_rate(self) -> Array:
        """Return a copy of the true rate of the pose (3,), rad/s, rad/s, m/s."""
        return self._a.st[k.V : k.V + 3].copy()

    @property
    def beam_state(self) -> BeamState:
        """Return the true motion of beam and rotor."""
        st = self._a.st
        values = [float(st[at + j]) for j in (3, 4) for at in (k.Q, k.V, k.A)]
        return BeamState(*values)

    def advance(self, coil_n: Array, beam_ref: Array, rotor_ref: Array) -> None:
        """Integrate one period with this command held.

        Args:
            coil_n: force commanded to each coil (C,), N; clipped at the coils' limit.
            beam_ref: position, speed, acceleration (3,) in m, m/s, m/s^2 that the beam is to have
                at the end of the period; in between, a quintic leads there from the last setpoint.
            rotor_ref: the same for the rotor, rad, rad/s, rad/s^2.

        Raises:
            ValueError: a command of the wrong size, or not finite.
            EffectError: an effect went wrong.
        """
        a = self._a
        # One small draw a period, all noise of its steps: bursts of bulk draws would make late
        # cycles, and the noise must not depend on how a flight is cut into calls.
        self._rng.standard_normal(out=a.noise)
        if self._effects:
            self._advance_by_steps(coil_n, beam_ref, rotor_ref)
        else:
            self._level.advance(
                a.par, a.st, a.coils, a.sensors, a.noise, a.out, coil_n, beam_ref, rotor_ref
            )
        self._periods += 1

    def push(self, wrench: Array) -> None:
        """Have this (3,) [N m, N m, N] act on the platform from outside, from here on."""
        self._push[:] = wrench
        self._a.st[k.WRENCH : k.WRENCH + 3] = wrench

    def sample(self) -> None:
        """Publish the readings of this instant; asking twice gives the same numbers."""
        self._published[:] = self._a.out

    def _advance_by_steps(self, coil_n: Array, beam_ref: Array, rotor_ref: Array) -> None:
        """Integrate one period phase by phase, asking the effects."""
        a, effects, move = self._a, self._effects, self._level.move
        st, coils, sensors = a.st, a.coils, a.sensors
        coil_force, wrench, mass, beam_force, gap = map(effects.uses, HOOKS[1:])
        k.begin(a.par, st, coils, coil_n, beam_ref, rotor_ref)
        begin_s, dt_s, n_steps = self.time_s, self._dt_s, a.n_steps
        beam = self.beam_state
        for i in range(n_steps):
            t_s = begin_s + i * dt_s
            # Views: the hooks get copies.
            q, qd = st[k.Q : k.Q + 3], st[k.V : k.V + 3]
            if coil_force:
                k.mean_forces(a.par, st, coils, a.noise, i)
                mean = coils[k.MEAN]
                coils[k.DELTA] = effects.coil_force(t_s, q, mean) - mean
            if wrench or beam_force:
                beam = self.beam_state
            if wrench:
                st[k.WRENCH : k.WRENCH + 3] = effects.wrench(t_s, q, qd, beam) + self._push
            if mass:
                st[k.MASS : k.MASS + 9] = effects.mass(t_s).ravel()
            if beam_force:
                st[k.BEAM_FORCE] = effects.beam_force(t_s, beam, q, qd)
            if not move(a.par, st, coils, sensors, a.noise, i, n_steps):
                raise EffectError(
                    f"{effects.source}: the plant's motion is not finite after {t_s} s: with the "
                    "effects' mass the mass matrix is not positive definite, or a force grew "
                    "without bound"
                )
            if gap:
                sensors[k.GAP] = effects.gap(t_s + dt_s, sensors[k.GAP])
        self._level.measure(a.par, st, coils, sensors, a.noise, a.out)

    def _look(self, t_s: float) -> None:
        """Set what the sensors see of the platform, through the effects."""
        sensors = self._a.sensors
        self._level.gaps(self._a.st, sensors)
        if self._effects.uses("gap"):
            sensors[k.GAP] = self._effects.gap(t_s, sensors[k.GAP])


@dataclass(frozen=True)
class Level:
    """The compiled functions of one plant level; see kernels."""

    advance: Callable[..., None]
    move: Callable[..., bool]
    accelerations: Callable[..., None]
    gaps: Callable[..., None]
    measure: Callable[..., None]

    def warm_up(self, arrays: Arrays, by_steps: bool) -> None:
        """Call once what a cycle calls, so that it is compiled (or fetched from the cache)."""
        a = arrays
        command, ref = np.zeros(a.coils.shape[1]), np.zeros(3)
        if by_steps:
            k.begin(a.par, a.st, a.coils, command, ref, ref)
            k.mean_forces(a.par, a.st, a.coils, a.noise, 0)
            self.move(a.par, a.st, a.coils, a.sensors, a.noise, 0, a.n_steps)
        else:
            self.advance(a.par, a.st, a.coils, a.sensors, a.noise, a.out, command, ref, ref)


LEVELS = {
    "declared": Level(
        k.advance_declared,
        k.move_declared,
        k.accelerations_declared,
        k.gaps_declared,
        k.measure_declared,
    ),
    "nonlinear": Level(
        k.advance_nonlinear,
        k.move_nonlinear,
        k.accelerations_nonlinear,
        k.gaps_nonlinear,
        k.measure_nonlinear,
    ),
}
