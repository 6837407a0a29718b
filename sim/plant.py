"""Simulate the plant: advance it by a control period with a held command, and read its sensors."""

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
    """The simulated rig, advanced by whole control periods.

    After `sample()`: `gap_m` (S,) m, `coil_readback_n` (C,) N, `beam` (3,) m, m/s, N and `rotor`
    (3,) rad, rad/s, N m. The next `sample()` overwrites these arrays in place.

    Args:
        config: parameters of the plant.
        period_s: control period; it is divided into equal internal steps of at most config.step_s.
        source: path of the SIM.yaml, for error messages; files of effects are searched in its
            folder first.

    Raises:
        EffectError: an effect cannot be loaded or returns an invalid result.
        ValueError: the period is not a positive number.
    """

    def __init__(self, config: SimConfig, period_s: float, *, source: Path | None = None) -> None:
        self._a = Arrays.build(config, period_s)
        self._level = LEVELS[config.plant]
        # Compile now, with separate arrays, instead of in the first real-time cycle.
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
        self._set_gaps(0.0)
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
        """Return a copy of the true pose [psi, theta, z] (3,); do not log it."""
        return self._a.st[k.Q : k.Q + 3].copy()

    @property
    def pose_rate(self) -> Array:
        """Return a copy of the true pose rate (3,) in rad/s, rad/s, m/s."""
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
            coil_n: commanded coil forces (C,) in N; clipped at the coils' limit.
            beam_ref: setpoint of the beam at the end of the period (3,): position, speed,
                acceleration in m, m/s, m/s^2; a quintic connects it to the previous setpoint.
            rotor_ref: setpoint of the rotor, likewise, in rad, rad/s, rad/s^2.

        Raises:
            ValueError: a command has the wrong size or is not finite.
            EffectError: an effect fails or returns an invalid result.
        """
        a = self._a
        # Draw the noise of one period at a time: large draws would cause late cycles, and the noise
        # must not depend on the division of a flight into calls.
        self._rng.standard_normal(out=a.noise)
        if self._effects:
            self._advance_by_steps(coil_n, beam_ref, rotor_ref)
        else:
            self._level.advance(
                a.par, a.st, a.coils, a.sensors, a.noise, a.out, coil_n, beam_ref, rotor_ref
            )
        self._periods += 1

    def push(self, wrench: Array) -> None:
        """Apply an external wrench (3,) in N m, N m, N to the platform from now on."""
        self._push[:] = wrench
        self._a.st[k.WRENCH : k.WRENCH + 3] = wrench

    def sample(self) -> None:
        """Publish the present readings; a second call gives the same values."""
        self._published[:] = self._a.out

    def _advance_by_steps(self, coil_n: Array, beam_ref: Array, rotor_ref: Array) -> None:
        """Integrate one period step by step, with the hooks of the effects."""
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
                    f"{effects.source}: the plant's motion is not finite after {t_s} s: an effect "
                    "makes the mass matrix not positive definite, or a force diverges; check the "
                    "effects' values"
                )
            if gap:
                sensors[k.GAP] = effects.gap(t_s + dt_s, sensors[k.GAP])
        self._level.measure(a.par, st, coils, sensors, a.noise, a.out)

    def _set_gaps(self, t_s: float) -> None:
        """Set the sensors' gaps from the pose, changed by the effects."""
        sensors = self._a.sensors
        self._level.gaps(self._a.st, sensors)
        if self._effects.uses("gap"):
            sensors[k.GAP] = self._effects.gap(t_s, sensors[k.GAP])


@dataclass(frozen=True)
class Level:
    """Compiled functions of one plant level; see plant_kernels."""

    advance: Callable[..., None]
    move: Callable[..., bool]
    accelerations: Callable[..., None]
    gaps: Callable[..., None]
    measure: Callable[..., None]

    def warm_up(self, arrays: Arrays, by_steps: bool) -> None:
        """Call the functions of a cycle once, so that they are compiled or read from the cache."""
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
