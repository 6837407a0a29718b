"""Schema of SIM.yaml: parameters and effects of the simulated rig, in SI units."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, field_validator, model_validator

from .base import Finite, NonNegative, Positive, Strict
from .error_messages import quoted
from .units import position_slip

Vector3 = tuple[Finite, Finite, Finite]


class SimConfig(Strict):
    """A simulated rig.

    `plant: declared` is the declared LPV model with noise and quantisation. `plant: nonlinear` is
    the full equations of motion with the imperfections in the section `nonlinear`, which is
    required then and rejected otherwise.
    """

    levid: Literal["sim"]
    seed: Annotated[int, Field(ge=0)]
    plant: Literal["declared", "nonlinear"]
    step_s: Annotated[float, Field(ge=1e-6, le=1e-4)] = 1e-4
    geometry: SimGeometry
    platform: Platform
    beam: Beam
    rotor: Rotor
    air: Air
    rods: Rods
    coils: Coils
    sensors: Sensors
    end_stops: EndStops
    drives: Drives
    nonlinear: Nonlinear | None = None
    effects: tuple[SimEffect, ...] = ()

    @model_validator(mode="after")
    def _level_and_sizes_agree(self) -> Self:
        if self.plant == "declared" and self.nonlinear is not None:
            raise ValueError(
                "nonlinear: expected no such section with plant: declared, found one; remove it or "
                "set plant: nonlinear"
            )
        if self.plant == "nonlinear":
            if self.nonlinear is None:
                raise ValueError("nonlinear: required section is missing with plant: nonlinear")
            widest = self.platform.j_psi_kg_m2 + self.platform.j_theta_kg_m2
            if self.nonlinear.j_z_kg_m2 >= widest:
                raise ValueError(
                    f"nonlinear.j_z_kg_m2: expected less than j_psi + j_theta = {widest:g}, as for "
                    f"every body with a thickness, found {self.nonlinear.j_z_kg_m2:g}"
                )
            for key, count, what in (
                ("coil_gain", self.geometry.n_coils, "coils"),
                ("sensor_gain", self.geometry.n_sensors, "sensors"),
                ("sensor_offset_m", self.geometry.n_sensors, "sensors"),
            ):
                found = len(getattr(self.nonlinear, key))
                if found not in (0, count):
                    raise ValueError(
                        f"nonlinear.{key}: expected {count} values, one for each of the {what}, "
                        f"or no values, found {found}"
                    )
        return self


class SimGeometry(Strict):
    """Positions of coils and sensors; default for sensors: under the coils."""

    r_m: Positive  # nominal arm of the grid
    coil_x_m: tuple[Finite, ...]
    coil_y_m: tuple[Finite, ...]
    sensor_x_m: tuple[Finite, ...] | None = None
    sensor_y_m: tuple[Finite, ...] | None = None

    @property
    def n_coils(self) -> int:
        """Return the number of coils C."""
        return len(self.coil_x_m)

    @property
    def n_sensors(self) -> int:
        """Return the number of sensors S."""
        return len(self.sensor_x)

    @property
    def sensor_x(self) -> tuple[float, ...]:
        """Return the sensors' x (S,), m."""
        return self.coil_x_m if self.sensor_x_m is None else self.sensor_x_m

    @property
    def sensor_y(self) -> tuple[float, ...]:
        """Return the sensors' y (S,), m."""
        return self.coil_y_m if self.sensor_y_m is None else self.sensor_y_m

    @model_validator(mode="after")
    def _in_metres(self) -> Self:
        for what, x, y in (
            ("coil", self.coil_x_m, self.coil_y_m),
            ("sensor", self.sensor_x, self.sensor_y),
        ):
            if slip := position_slip({f"{what}_x_m": x, f"{what}_y_m": y}):
                raise ValueError(slip)
        return self

    @model_validator(mode="after")
    def _reaches_three_dof(self) -> Self:
        for what, x, y in (
            ("coil", self.coil_x_m, self.coil_y_m),
            ("sensor", self.sensor_x, self.sensor_y),
        ):
            if len(x) != len(y):
                raise ValueError(
                    f"expected as many {what}_x_m as {what}_y_m, found {len(x)} and {len(y)}"
                )
            if not _spans_a_plane(x, y):
                raise ValueError(
                    f"expected three or more {what}s that are not on one line, so that they "
                    f"determine psi, theta and z, found {len(x)} at {what}_x_m and {what}_y_m"
                )
        return self


class Platform(Strict):
    """Rigid platform and the fixed parts on it, without the beam; inertias about the centre."""

    m_p_kg: Positive
    j_psi_kg_m2: Positive
    j_theta_kg_m2: Positive
    j_psitheta_kg_m2: Finite  # + integral of x y dm

    @model_validator(mode="after")
    def _positive_definite(self) -> Self:
        if self.j_psitheta_kg_m2 * self.j_psitheta_kg_m2 >= self.j_psi_kg_m2 * self.j_theta_kg_m2:
            raise ValueError(
                f"j_psitheta_kg_m2: expected its square below j_psi times j_theta, found "
                f"{self.j_psitheta_kg_m2:g}"
            )
        return self


class Beam(Strict):
    """Beam with rotor: a point mass at height z_b over O that moves along the platform's x."""

    m_b_kg: Positive
    z_b_m: Finite
    start_m: Finite = 0.0


class Rotor(Strict):
    """Bar on the beam that turns about the platform's normal; `m_b_kg` includes its mass."""

    j_kg_m2: Positive


class Air(Strict):
    """Air damping of the voice coils."""

    d_n_s_m: NonNegative  # each coil


class Rods(Strict):
    """Stiffness of the rods without gravity: a full symmetric matrix in [psi, theta, z]."""

    k_psi_n_m_rad: Finite
    k_theta_n_m_rad: Finite
    k_z_n_m: Finite
    k_psi_theta_n_m_rad: Finite
    k_psi_z_n_rad: Finite
    k_theta_z_n_rad: Finite


class Coils(Strict):
    """Voice coils and their amplifiers."""

    limit_n: Positive
    constant_n_a: Positive
    lag_s: Annotated[float, Field(ge=0, le=1.0)]
    noise_n: NonNegative  # rms, white, held for noise_hold_s
    noise_hold_s: Annotated[float, Field(ge=1e-6, le=1.0)]


class Sensors(Strict):
    """Position sensors with their converter; noise is independent from sample to sample."""

    range_m: Positive  # readings are clipped at plus and minus this
    bits: Annotated[int, Field(ge=2, le=32)]  # over the whole range
    noise_m: NonNegative  # rms


class EndStops(Strict):
    """Unilateral spring-dampers under and over points of the platform (default: its corners)."""

    travel_m: Positive  # both ways from the working point
    k_n_m: Positive  # each stop
    d_n_s_m: NonNegative  # each stop
    x_m: tuple[Finite, ...] | None = None
    y_m: tuple[Finite, ...] | None = None

    @model_validator(mode="after")
    def _both_or_neither(self) -> Self:
        if (self.x_m is None) != (self.y_m is None) or len(self.x_m or ()) != len(self.y_m or ()):
            found = [0 if v is None else len(v) for v in (self.x_m, self.y_m)]
            raise ValueError(f"expected as many x_m as y_m, found {found[0]} and {found[1]}")
        if not (self.x_m is None or self.y_m is None or _spans_a_plane(self.x_m, self.y_m)):
            raise ValueError(
                "expected three or more stops that are not on one line, found "
                f"{len(self.x_m)} at x_m and y_m"
            )
        return self


class Drives(Strict):
    """Encoders: one reading for the beam's two linear motors together, one for the rotary motor."""

    beam_encoder_m: Positive
    rotor_encoder_rad: Positive


class DriveLoop(Strict):
    """Position loop of one drive (PID with feed-forward at the internal step) and its bearing.

    Force limit and friction are in N (N s/m) for the beam, in N m (N m s/rad) for the rotor.
    """

    bandwidth_hz: Annotated[float, Field(gt=0, le=300)]  # RK4 with held force is stable beyond it
    limit: Positive
    coulomb: NonNegative
    coulomb_speed: Positive  # below this speed (m/s, rad/s) Coulomb friction fades to viscous
    viscous: NonNegative


class Nonlinear(Strict):
    """Small imperfections that `plant: nonlinear` adds to the declared model."""

    j_z_kg_m2: Positive  # about the vertical, with the rotor; acts when the platform is tilted
    com_m: Vector3  # platform's centre of mass
    rotor_imbalance_kg_m: NonNegative
    rotor_z_m: Finite  # height of the bar over O
    rods_cubic_psi_n_m_rad3: Finite
    rods_cubic_theta_n_m_rad3: Finite
    rods_cubic_z_n_m3: Finite
    coil_gain: tuple[Positive, ...] = ()  # true force constant / nominal one, at height zero
    coil_slope_1_m: Finite  # relative change of the force constant per metre of height
    sensor_gain: tuple[Positive, ...] = ()
    sensor_offset_m: tuple[Finite, ...] = ()
    beam_drive: DriveLoop
    rotor_drive: DriveLoop


class SimEffect(Strict):
    """An effect of the simulated plant that MODEL.yaml lacks: a class and its keyword arguments."""

    model_config = ConfigDict(extra="allow", frozen=True)

    use: str

    @field_validator("use")
    @classmethod
    def _names_a_class(cls, value: str) -> str:
        place, _, name = value.rpartition(":")
        if not place or not name.isidentifier():
            raise ValueError(
                "expected 'path/to/file.py:ClassName' or 'package.module:ClassName', "
                f"found {quoted(value)}"
            )
        return value

    @property
    def values(self) -> dict[str, Any]:
        """Return the class's keyword arguments."""
        return dict(self.model_extra or {})


def _spans_a_plane(x: tuple[float, ...], y: tuple[float, ...]) -> bool:
    """Return whether the points (x, y) are not all on one line."""
    if len(x) < 3:
        return False
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    # Products instead of powers: an overflow then gives inf instead of an exception.
    xx = sum((a - mean_x) * (a - mean_x) for a in x)
    yy = sum((b - mean_y) * (b - mean_y) for b in y)
    xy = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True))
    # Relative to (xx + yy)^2 the determinant is scale-free; 1e-9 is an aspect ratio of 1 to 30000.
    return xx * yy - xy * xy > 1e-9 * (xx + yy) * (xx + yy)
