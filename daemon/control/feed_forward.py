"""Compute the feed-forward wrench that carries platform and moving beam, from the rig's model."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ...config.base import ConfigError
from ...config.model import ModelConfig
from ...config.rig import RigConfig
from ...identification.greybox.declared_model_from_config import declared_model
from ...model.declared_model import DeclaredModel, ModelError
from ...model.expression import ExpressionError
from ...model.geometry import decoupling_matrix
from .watchdog_times import fall_s

Array = NDArray[np.float64]

_DOF = (("psi", "rad"), ("theta", "rad"), ("z", "m"))
_INPUT_UNITS = ("N m", "N m", "N")
_BEAM = {"beam_m": 0, "beam_m_s": 1, "beam_ref_m": 0, "beam_ref_m_s": 1, "beam_ref_m_s2": 2}
"""Log fields of the beam motion, and the order of the position derivative of each."""
_ACTS_AFTER = 1.5
"""Periods from a reading to the middle of the period in which its force acts."""
_GRID = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Fractions of the limits at which the model's force is compared with its linear part."""

_MOST_OVER_REST = 100.0
"""Largest coil limit over the coil force that carries the platform: 4 for the shipped rigs. A limit
a thousand times as large is one in other units."""


@dataclass(frozen=True)
class FeedForwardLaw:
    """Define the feed-forward of a rig, linear in references and beam motion.

    With x the measured position of the beam, v and a the planned velocity and acceleration, in SI
    units, the wrench (3,) is

        [0, beam_weight x, weight + rods z_ref] + by_model [1, psi_ref, theta_ref, z_ref, x, v, a]

    For a rig with a model the first part is zero, otherwise by_model (3, 7) is zero. left_over (3,)
    is the largest nonlinear part of the model's wrench within the rig's limits. lag_s: the model's
    lag of the coil forces.
    """

    weight_n: float = 0.0
    beam_weight_n: float = 0.0
    rods_n_m: float = 0.0
    by_model: Array = field(default_factory=lambda: np.zeros((3, 7)))
    left_over: Array = field(default_factory=lambda: np.zeros(3))
    lag_s: float = 0.0

    @property
    def per_beam_m(self) -> Array:
        """Wrench (3,) per metre of beam position, in N, N, N/m."""
        per_m: Array = self.by_model[:, 4] + np.array([0.0, self.beam_weight_n, 0.0])
        return per_m

    def wrench(self, beam: Array) -> Array:
        """Return the wrench (n, 3) at the working point for setpoints (n, 3) of the beam."""
        found: Array = beam @ self.by_model[:, 4:].T + self.by_model[:, 0]
        found[:, 1] += self.beam_weight_n * beam[:, 0]
        found[:, 2] += self.weight_n
        return found

    @property
    def numbers(self) -> Array:
        """Parameters of the compiled cycle, (24,): by_model row by row, then the three others."""
        own = (self.weight_n, self.beam_weight_n, self.rods_n_m)
        return np.concatenate([self.by_model.ravel(), own])


def feed_forward(rig: RigConfig, period_s: float) -> FeedForwardLaw:
    """Return the feed-forward of `rig`, from its model or its `feedforward` parameters.

    The model M q'' + D q' + K q = B u + f gives u = B^-1 (K q_ref - f). K holds for the beam at
    rest in the centre. f is linearised in the beam motion between the centre and the rig's limits.
    The beam position is extrapolated to the time at which the force acts: by 1.5 periods plus the
    model's lag and delay. D q_ref' and M q_ref'' are neglected, see docs/configuration.md.

    Raises:
        ConfigError: the model does not fit the rig, or needs more than the coil force limit.
    """
    if rig.feedforward is not None:
        own = rig.feedforward
        g = own.gravity_m_s2
        law = FeedForwardLaw(own.mass_kg * g, own.beam_mass_kg * g, own.rods_n_m)
        _check_coil_limit(rig, largest_coil_n(rig, law.wrench(np.zeros((1, 3)))))
        return law
    if not isinstance(rig.model, ModelConfig):
        raise ConfigError(f"model: {rig.model} is not loaded: load the rig with load_rig")
    try:
        return _of_model(rig, rig.model, period_s)
    except (ModelError, ExpressionError, ConfigError) as error:
        raise ConfigError(f"rig {rig.name}: model {rig.model.name}: {error}") from None


def largest_coil_n(rig: RigConfig, wrench: Array) -> float:
    """Return the largest coil force in N caused by wrenches (n, 3)."""
    T = decoupling_matrix(rig.geometry.coil_x_m, rig.geometry.coil_y_m)
    return float(np.abs(wrench @ T).max())


def beam_at_limits(rig: RigConfig, shares: tuple[float, ...] = (-1.0, 1.0)) -> Array:
    """Return beam motions (n, 3): all combinations of these fractions of the rig's limits."""
    limits = rig.limits
    most = limits.beam_m, limits.beam_velocity_m_s, limits.beam_acceleration_m_s2
    return np.array(list(product(shares, repeat=3))) * most


def _of_model(rig: RigConfig, config: ModelConfig, period_s: float) -> FeedForwardLaw:
    model = declared_model(config)
    derivative = beam_derivatives(config, model)
    limits = rig.limits
    most = np.array([limits.beam_m, limits.beam_velocity_m_s, limits.beam_acceleration_m_s2])
    alone = np.vstack([np.zeros(3), np.diag(most), -np.diag(most)])
    wrench, stiffness = _wrench(model, derivative, alone)
    slopes = 0.5 * (wrench[1:4] - wrench[4:7]).T / most
    grid = beam_at_limits(rig, _GRID)
    curved = _wrench(model, derivative, grid)[0] - grid @ slopes.T - wrench[0]
    at_rest_n = largest_coil_n(rig, wrench[[0, 1, 4]])
    if not at_rest_n <= limits.coil_n:
        raise ConfigError(
            f"carrying the platform at rest needs {at_rest_n:.3g} N in a coil, expected at most "
            f"limits.coil_n, {limits.coil_n:g} N; check the masses and units of the model's force"
        )
    _check_coil_limit(rig, at_rest_n)
    values = {**model.values, **model.scheduling}
    late_s = model.lag(values) + model.delay(values)
    if late_s > fall_s(rig):
        raise ConfigError(
            f"lag_s and delay_s: expected at most {fall_s(rig):.3g} s together, in which a falling "
            f"platform leaves limits.gap_m, found {late_s:.3g} s"
        )
    ahead_s = _ACTS_AFTER * period_s + late_s
    slopes[:, 1] += ahead_s * slopes[:, 0]
    by_model = np.hstack([wrench[:1].T, stiffness, slopes])
    return FeedForwardLaw(
        by_model=by_model, left_over=np.abs(curved).max(axis=0), lag_s=model.lag(values)
    )


def _check_coil_limit(rig: RigConfig, at_rest_n: float) -> None:
    """Raise ConfigError for a coil limit that no rig has which these forces carry."""
    limit_n = rig.limits.coil_n
    if limit_n > _MOST_OVER_REST * at_rest_n > 0.0:
        slip = "; is it in mN?" if limit_n <= 1e3 * _MOST_OVER_REST * at_rest_n else ""
        raise ConfigError(
            f"limits.coil_n: expected at most {_MOST_OVER_REST * at_rest_n:.3g} N, "
            f"{_MOST_OVER_REST:g} times what carries the platform at rest, found {limit_n:g}{slip}"
        )


def _wrench(model: DeclaredModel, derivative: dict[str, int], beam: Array) -> tuple[Array, Array]:
    """Return B^-1 (-f) (n, 3) for beam motions (n, 3), and B^-1 K (3, 3) for the first one."""
    at = model.over({name: beam[:, which] for name, which in derivative.items()})
    try:
        wrench = np.linalg.solve(at.B, -at.force[:, :, None])[:, :, 0]
        return np.broadcast_to(wrench, beam.shape), np.linalg.solve(at.B[0], at.K[0])
    except np.linalg.LinAlgError:
        raise ConfigError("B: expected an invertible matrix, found a singular one") from None


def beam_derivatives(config: ModelConfig, model: DeclaredModel) -> dict[str, int]:
    """Return the order of the beam position derivative of each scheduling variable.

    Raises:
        ConfigError: DOF, inputs or scheduling variables differ from those of a rig.
    """
    dof = tuple((axis.name, axis.unit) for axis in config.dof)
    if dof != _DOF or tuple(axis.unit for axis in config.inputs) != _INPUT_UNITS:
        raise ConfigError(
            f"expected the DOF of a rig, {_listed(_DOF)}, and inputs in {', '.join(_INPUT_UNITS)}, "
            f"found {_listed(dof)} and inputs in {', '.join(a.unit for a in config.inputs)}"
        )
    found = {
        name: _BEAM[variable.signal] + variable.derivative
        for name, variable in config.scheduling.items()
        if _BEAM.get(variable.signal, 3) + variable.derivative < 3
    }
    used = {name for formula in model.force for name in formula.names}
    if strange := sorted(used & set(config.scheduling) - set(found)):
        raise ConfigError(
            f"force: expected position, velocity or acceleration of the beam (signals beam_m, "
            f"beam_m_s and its derivative), found '{strange[0]}', which is not one of them"
        )
    return found


def _listed(axes: tuple[tuple[str, str], ...]) -> str:
    return ", ".join(f"{name} in {unit}" for name, unit in axes)
