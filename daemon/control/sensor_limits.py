"""Say of a rig which errors of its sensors the daemon can find, and which it cannot."""

from __future__ import annotations

from ...config.rig import RigConfig
from .force_without_motion import least_force_n
from .plane_residual import residual_projector
from .standing_readings import COUNTED_NOISE

_DOF = 3


def undetectable(rig: RigConfig) -> list[str]:
    """Return what the plane through the readings cannot tell, in words; empty if it tells all."""
    x, y = rig.geometry.sensors_x_m, rig.geometry.sensors_y_m
    found, count = residual_projector(x, y), len(x)
    if count <= _DOF:
        return [
            f"sensors: {count} sensors measure {_DOF} DOF: a sensor that is off cannot be "
            "detected, because no other sensor contradicts it"
        ]
    said = []
    if found.unseen:
        said.append(
            f"sensors: if {_either(found.unseen)} is off, it cannot be detected: no other sensors "
            "measure its height"
        )
    if found.alike:
        groups = "; ".join(_either(group) for group in found.alike)
        said.append(
            f"sensors: a sensor that is off is detected, but it may be any of these: {groups}. "
            "Another sensor would tell which one"
        )
    return said


def standing_text(rig: RigConfig, period_s: float, step_m: float | None) -> str:
    """Return from which noise on readings that stand still are found, and else by which force.

    step_m: smallest change of a reading in m, None if unknown.
    """
    share = COUNTED_NOISE
    if step_m is None:
        per_um = least_force_n(rig, period_s, 1e-6)
        return (
            f"readings that stand still are found if their noise is at least {share:g} of their "
            f"step, else once the lift force changes by {per_um:.2g} N per um of step"
        )
    force_n = least_force_n(rig, period_s, step_m)
    return (
        f"readings that stand still are found with {1e9 * share * step_m:.2g} nm RMS of noise or "
        f"more, else once the lift force changes by {force_n:.2g} N"
    )


def standing_warning(
    rig: RigConfig, period_s: float, step_m: float | None, noise_m: float | None
) -> str:
    """Return a warning if the noise of the simulated sensors is below their step; else empty."""
    if step_m is None or noise_m is None or noise_m >= COUNTED_NOISE * step_m:
        return ""
    return (
        f"sensors: their noise of {1e9 * noise_m:.2g} nm RMS is small against their step of "
        f"{1e9 * step_m:.3g} nm, so readings repeat: that all stand still cannot be detected until "
        f"the lift force changes by {least_force_n(rig, period_s, step_m):.2g} N"
    )


def _either(numbers: list[int]) -> str:
    *names, last = map(str, numbers)
    return f"sensor {', '.join(names)} or {last}" if names else f"sensor {last}"
