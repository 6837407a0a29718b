"""Find numbers of a rig that are valid one by one and make no physical sense together.

An error is a rig that cannot fly; a warning is a rig that would be unusual. Both name the key, what
was expected and the likely slip of the unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...config.model import ModelConfig
from ...config.rig import RigConfig
from ...config.session import Levitate
from ...config.sim import SimConfig
from ...identification.greybox.declared_model_from_config import declared_model
from ...identification.subspace.simulation import Simulation
from ...model.geometry import decoupling_matrix, shape_matrix
from ..control.feed_forward import FeedForwardLaw, beam_at_limits, feed_forward
from .predicted_motion import loop_from_wrench

Array = NDArray[np.float64]

_G_M_S2 = 9.81
_UNLIKE_WEIGHT = 2.0
"""Factor between declared and simulated weight above which one of them is wrong."""
_DOF = ("psi", "theta", "z")
_KP, _KI = ("kp_n_m_rad", "kp_n_m_rad", "kp_n_m"), ("ki_n_m_rad_s", "ki_n_m_rad_s", "ki_n_m_s")
_UNUSUAL = 5.0
"""Factor between lengths of one rig above which one of them is probably in another unit."""
_OF_ANOTHER_BODY = 10.0
"""Factor between the coils' arm and the radius of gyration of the model, at most 2 for a plate."""
_WEIGHT_ERROR, _LEAST_WEIGHT_ERROR = 0.1, 0.01
"""Share of the weight that a declared model usually errs by, and that none is better than."""
_FORCE_MARGIN = 1.1
"""Coil force limit over the force at rest: below, nothing is left to control with."""
_LEAST_STIFFNESS = 0.01
"""Stiffness of a controller over that of the rods, below which the rods alone hold the platform."""
_LEAST_MOVING = 1e-3
"""Share of the weight that any loop holds within gap_m by its stiffness alone."""
_PERIODS = 10.0
"""Shortest integral time kp / ki in periods: below, the proportional part has no effect."""
_SWING_S = 0.2
"""Longest time from zero to the coil force limit at the limit of its rate."""
_SETTLE_S = 2.0


@dataclass(frozen=True)
class Problem:
    """A number that makes no sense beside others: its key, and what to do; or an error."""

    key: str
    text: str
    fatal: bool = False

    def __str__(self) -> str:
        return f"{self.key}: {self.text}"


def rig_problems(rig: RigConfig, sim: SimConfig | None = None) -> list[Problem]:
    """Return what is implausible about a rig with its model and simulator, errors first.

    Raises:
        ConfigError: the model does not fit the rig.
    """
    law = feed_forward(rig, 1.0 / rig.rate_hz)
    found = [*_geometry(rig), *_forces(rig, law), *_beam(rig), *_gaps(rig)]
    if isinstance(rig.model, ModelConfig):
        at = declared_model(rig.model).at()
        stiffness = np.diag(np.linalg.solve(at.B, at.K)).tolist()
        found += [*_inertia(rig, at.M), *_gains(rig, law, stiffness), *_hold(rig, law)]
    if sim is not None:
        found += _simulator(rig, law, sim)
    if rig.feedforward is not None:
        found += _gains(rig, law, [np.nan, np.nan, rig.feedforward.rods_n_m])
    return sorted(found, key=lambda problem: not problem.fatal)


def _arms(x_m: tuple[float, ...], y_m: tuple[float, ...]) -> Array:
    """Return the distances of points from the centre in m."""
    return np.hypot(x_m, y_m)


def _geometry(rig: RigConfig) -> Iterator[Problem]:
    place = rig.geometry
    coils = _arms(place.coil_x_m, place.coil_y_m)
    sensors = _arms(place.sensors_x_m, place.sensors_y_m)
    for what, arms in (("coil", coils), ("sensor", sensors) if place.sensor_x_m else ("", coils)):
        usual = float(np.median(arms[arms > 0.0]))
        if what and arms.max() > _UNUSUAL * usual:
            yield Problem(
                f"geometry.{what}_x_m, {what}_y_m",
                f"{what} {int(arms.argmax())} is {arms.max():.3g} m from the centre, others about "
                f"{usual:.3g} m; is one position in another unit?",
            )
    ratio = float(sensors.max() / coils.max())
    if not 1.0 / _UNUSUAL <= ratio <= _UNUSUAL:
        yield Problem(
            "geometry.sensor_x_m, sensor_y_m",
            f"sensors are within {sensors.max():.3g} m of the centre, coils within "
            f"{coils.max():.3g} m; are both in m?",
        )
    points = list(zip(place.coil_x_m, place.coil_y_m, strict=True))
    for number, point in enumerate(points):
        if point in points[:number]:
            yield Problem(
                "geometry.coil_x_m, coil_y_m",
                f"coils {points.index(point)} and {number} have one position, x = {point[0]:g} m, "
                f"y = {point[1]:g} m; expected a position for each",
            )
            return


def _forces(rig: RigConfig, law: FeedForwardLaw) -> Iterator[Problem]:
    """Compare the forces that carry the platform with the limits of forces."""
    limits = rig.limits
    T = decoupling_matrix(rig.geometry.coil_x_m, rig.geometry.coil_y_m)
    centre = law.wrench(np.zeros((1, 3)))[0]
    beside = law.wrench(beam_at_limits(rig) * np.array([1.0, 0.0, 0.0]))
    rest = centre @ T
    rest_n, beside_n = float(np.abs(rest).max()), float(np.abs(beside @ T).max())
    total_n = float(np.abs(rest).sum())
    if rest_n == 0.0:
        return
    if centre[2] < 0.0:
        yield Problem(
            "model" if rig.model is not None else "feedforward",
            f"the platform at rest needs {centre[2]:.3g} N, which pulls it down; expected a force "
            "up: is the sign of the weight in the model's force wrong?",
        )
    if limits.total_n is not None and total_n > limits.total_n:
        yield Problem(
            "limits.total_n",
            f"expected at least {total_n:.3g} N, which carries the platform, found "
            f"{limits.total_n:g} N: it cannot lift off",
            fatal=True,
        )
    if limits.coil_rms_n is not None and rest_n > limits.coil_rms_n:
        yield Problem(
            "limits.coil_rms_n",
            f"expected at least {rest_n:.3g} N, which a coil gives at rest, found "
            f"{limits.coil_rms_n:g} N: it cannot hover",
            fatal=True,
        )
    elif limits.coil_rms_n is not None and beside_n > limits.coil_rms_n:
        yield Problem(
            "limits.coil_rms_n",
            f"with the beam at beam_m a coil gives {beside_n:.3g} N at rest, found "
            f"{limits.coil_rms_n:g} N: the beam must not stay there",
        )
    if limits.coil_rms_n is not None and limits.coil_rms_n > limits.coil_n:
        yield Problem(
            "limits.coil_rms_n",
            f"expected at most coil_n, {limits.coil_n:g} N, found {limits.coil_rms_n:g} N, which "
            "is never reached",
        )
    moving_n = float(np.abs(law.wrench(beam_at_limits(rig)) @ T).max())
    if moving_n > limits.coil_n >= beside_n * _FORCE_MARGIN:
        yield Problem(
            "limits.beam_acceleration_m_s2",
            f"with the beam at its limits of position, speed and acceleration a coil needs "
            f"{moving_n:.3g} N, more than coil_n, {limits.coil_n:g} N",
        )
    if beside_n * _FORCE_MARGIN > limits.coil_n:
        yield Problem(
            "limits.coil_n",
            f"expected {_FORCE_MARGIN * beside_n:.3g} N or more, found {limits.coil_n:g} N: with "
            f"the beam at beam_m a coil gives {beside_n:.3g} N at rest, and nothing is left to "
            "control with",
        )
    swing_s = limits.coil_n / limits.coil_rate_n_s
    if swing_s > _SWING_S:
        yield Problem(
            "limits.coil_rate_n_s",
            f"expected {limits.coil_n / _SWING_S:.3g} N/s or more, found {limits.coil_rate_n_s:g} "
            f"N/s: a coil takes {swing_s:.2g} s to coil_n, longer than the platform falls; is it "
            "in kN/s?",
        )


def _beam(rig: RigConfig) -> Iterator[Problem]:
    limits = rig.limits
    speed, acceleration = limits.beam_velocity_m_s, limits.beam_acceleration_m_s2
    reached = float(np.sqrt(2.0 * limits.beam_m * acceleration))
    if speed > 2.0 * _UNUSUAL * reached:
        yield Problem(
            "limits.beam_velocity_m_s",
            f"found {speed:g} m/s; with beam_acceleration_m_s2 {acceleration:g} the beam reaches "
            f"{reached:.2g} m/s between +-beam_m; is one of them in mm?",
        )
    if speed < acceleration / rig.rate_hz:
        yield Problem(
            "limits.beam_acceleration_m_s2",
            f"found {acceleration:g} m/s2, with which the beam has its largest velocity, {speed:g} "
            "m/s, within one period; is one of them in mm?",
        )


def _gaps(rig: RigConfig) -> Iterator[Problem]:
    limits, lift = rig.limits, Levitate()
    fastest = 1.875 * limits.gap_m / lift.ramp_s  # of a smooth step
    if limits.gap_m_s is not None and limits.gap_m_s < fastest:
        yield Problem(
            "limits.gap_m_s",
            f"expected {fastest:.2g} m/s or more, with which the platform rises at lift-off, found "
            f"{limits.gap_m_s:g} m/s",
        )
    if limits.gap_m < rig.self_test.still_m:
        yield Problem(
            "limits.gap_m",
            f"expected more than self_test.still_m, {rig.self_test.still_m:g} m, which a platform "
            f"at rest may move, found {limits.gap_m:g} m; is it in m?",
        )


def _simulator(rig: RigConfig, law: FeedForwardLaw, sim: SimConfig) -> Iterator[Problem]:
    """Compare the rig with the simulated plant that it flies on."""
    weight_n = float(law.wrench(np.zeros((1, 3)))[0, 2])
    true_n = _G_M_S2 * (sim.platform.m_p_kg + sim.beam.m_b_kg)
    if not weight_n / _UNLIKE_WEIGHT <= true_n <= weight_n * _UNLIKE_WEIGHT:
        yield Problem(
            "sim",
            f"the simulated platform weighs {true_n:.3g} N, the declared one {weight_n:.3g} N; "
            "check the masses and their units",
        )
    if rig.limits.gap_m > sim.end_stops.travel_m:
        yield Problem(
            "limits.gap_m",
            f"found {rig.limits.gap_m:g} m, beyond the simulated end stops at "
            f"{sim.end_stops.travel_m:g} m: the platform touches them before the fault GAP",
        )
    needed_n = true_n / sim.geometry.n_coils
    if needed_n > sim.coils.limit_n:
        yield Problem(
            "sim: coils.limit_n",
            f"expected at least {needed_n:.3g} N, which carries the simulated platform, found "
            f"{sim.coils.limit_n:g} N",
            fatal=True,
        )


def _inertia(rig: RigConfig, M: Array) -> Iterator[Problem]:
    """Compare the radii of gyration of the model with the coils' arms."""
    place = rig.geometry
    for k, (dof, arms) in enumerate(zip(_DOF, (place.coil_y_m, place.coil_x_m), strict=False)):
        radius = float(np.sqrt(max(M[k, k] / M[2, 2], 0.0)))
        arm = float(np.sqrt(np.mean(np.square(arms))))
        if not arm / _OF_ANOTHER_BODY <= radius <= arm * _OF_ANOTHER_BODY:
            yield Problem(
                f"model: M: {dof}",
                f"mass {M[2, 2]:.3g} kg and moment of inertia {M[k, k]:.3g} kg m^2 are those of a "
                f"body with a radius of gyration of {radius:.3g} m; the coils' arms are "
                f"{arm:.3g} m; check the units of both",
            )


def _gains(rig: RigConfig, law: FeedForwardLaw, stiffness: Sequence[float]) -> Iterator[Problem]:
    """Compare the gains with the stiffness of the rods, the weight and the period."""
    control = rig.control
    moved_n = _LEAST_MOVING * float(abs(law.wrench(np.zeros((1, 3)))[0, 2]))
    soft = (control.kp[2] + stiffness[2]) * rig.limits.gap_m
    if 0.0 < soft < moved_n:
        yield Problem(
            "control.z.kp_n_m",
            f"found {control.kp[2]:g} with rods of {stiffness[2]:.3g} N/m: {soft:.2g} N, less than "
            f"{100.0 * _LEAST_MOVING:g} % of the weight, moves the platform by gap_m; is it in "
            "N/mm?",
        )
    for dof, kp_key, ki_key, kp, ki, rods in zip(
        _DOF, _KP, _KI, control.kp, control.ki, stiffness, strict=True
    ):
        key, slip = f"control.{dof}.{kp_key}", "N/mm" if dof == "z" else "N m/mrad"
        if kp + rods <= 0.0:
            yield Problem(
                key,
                f"found {kp:g} with rods of {rods:.3g}: nothing holds {dof}; expected a gain above "
                f"{-rods:.3g}",
                fatal=True,
            )
        elif kp == 0.0 and ki == 0.0:
            yield Problem(key, f"found 0 and {ki_key} 0: no controller holds {dof}")
        elif 0.0 < kp < _LEAST_STIFFNESS * rods:
            yield Problem(
                key,
                f"found {kp:g}, {100.0 * kp / rods:.2g} % of the rods' stiffness, {rods:.3g}: the "
                f"rods alone hold {dof}; is it in {slip}?",
            )
        if ki > 0.0 and kp * rig.rate_hz < _PERIODS * ki:
            yield Problem(
                f"control.{dof}.{ki_key}",
                f"found {ki:g} with {kp_key} {kp:g}: the integral time kp / ki is {kp / ki:.2g} s; "
                f"expected {_PERIODS:g} periods or more, {_PERIODS / rig.rate_hz:.2g} s",
            )


def _hold(rig: RigConfig, law: FeedForwardLaw) -> Iterator[Problem]:
    """Predict the height after lift-off if the real weight differs from the declared one."""
    period_s, lift = 1.0 / rig.rate_hz, Levitate()
    loop = loop_from_wrench(rig, 0.0, period_s)
    if loop is None or np.abs(np.linalg.eigvals(loop.A)).max() > 1.0:
        return
    weight = law.wrench(np.zeros((1, 3)))
    lifted = round((lift.unload_s + lift.ramp_s) * rig.rate_hz)
    rows = lifted + round(_SETTLE_S * rig.rate_hz)
    unload = max(round(lift.unload_s * rig.rate_hz), 1)
    share = np.minimum(np.arange(1, rows + 1) / unload, 1.0)
    pose = Simulation(loop).respond(share[:, None] * weight)
    sensors = shape_matrix(rig.geometry.sensors_x_m, rig.geometry.sensors_y_m)
    off_m = float(np.abs(pose[lifted:] @ sensors.T).max())
    if _WEIGHT_ERROR * off_m <= rig.limits.gap_m:
        return
    held = rig.limits.gap_m / off_m
    yield Problem(
        "control.z",
        f"these gains hold the platform within gap_m only if the declared weight is right within "
        f"{100.0 * held:.2g} %; expected {100.0 * _WEIGHT_ERROR:g} %: raise kp_n_m and ki_n_m_s",
        fatal=held < _LEAST_WEIGHT_ERROR,
    )
