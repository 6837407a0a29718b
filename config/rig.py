"""Schema of RIG.yaml: geometry, controller gains, limits, buses, and the backend of each role."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    WithJsonSchema,
    model_validator,
)
from pydantic_core import PydanticKnownError

from .backends import ROLES, bus_schema, role_options
from .base import ConfigError, Finite, NonNegative, Positive, Strict, load_yaml
from .buses import Bus, CanBus, RoleOptions, SerialBus
from .daemon_settings import Live, Realtime, Recording, SelfTest, Service
from .escaping import MOST_NAME
from .model import ModelConfig, load_model
from .shipped import find_file
from .units import position_slip


def _not_near_zero(value: float) -> float:
    if abs(value) < _LEAST_SCALE:
        raise ValueError(f"expected a scale of at least {_LEAST_SCALE:g}, found {value:g}")
    return value


_LEAST_SCALE = 0.2
"""A channel that is weaker is broken: its scale would multiply noise and commands."""
Rate = Annotated[float, Field(ge=10.0, le=20_000.0)]
Scale = Annotated[
    float,
    Field(ge=-5.0, le=5.0, allow_inf_nan=False),
    AfterValidator(_not_near_zero),
]
_LEAST_PERIODS = 3
_SMALL_ANGLE = 0.1
"""rad, where a sine is 0.2 % off: the platform's equations are linear in its angles."""
Name = Annotated[str, Field(max_length=MOST_NAME, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
"""A name, which becomes part of file names."""


class Geometry(Strict):
    """Positions of coils and sensors on the platform; the lists' lengths give their numbers."""

    coil_x_m: Annotated[tuple[Finite, ...], Field(min_length=3)]
    coil_y_m: Annotated[tuple[Finite, ...], Field(min_length=3)]
    sensor_x_m: tuple[Finite, ...] = ()
    sensor_y_m: tuple[Finite, ...] = ()

    @model_validator(mode="after")
    def _pairs(self) -> Self:
        for what in ("coil", "sensor"):
            nx, ny = len(getattr(self, f"{what}_x_m")), len(getattr(self, f"{what}_y_m"))
            if nx != ny:
                raise ValueError(f"expected as many {what}_x_m as {what}_y_m, found {nx} and {ny}")
        return self

    @model_validator(mode="after")
    def _in_metres(self) -> Self:
        for what in ("coil", "sensor"):
            keys = f"{what}_x_m", f"{what}_y_m"
            if slip := position_slip({key: getattr(self, key) for key in keys}):
                raise ValueError(slip)
        return self

    @property
    def sensors_x_m(self) -> tuple[float, ...]:
        """Sensor positions along x in m; default: under the coils."""
        return self.sensor_x_m or self.coil_x_m

    @property
    def sensors_y_m(self) -> tuple[float, ...]:
        """Sensor positions along y in m; default: under the coils."""
        return self.sensor_y_m or self.coil_y_m


class TiltGains(Strict):
    """PI gains of psi or theta: C(z) = kp + ki Ts z / (z - 1)."""

    kp_n_m_rad: NonNegative
    ki_n_m_rad_s: NonNegative


class HeightGains(Strict):
    """PI gains of z: C(z) = kp + ki Ts z / (z - 1)."""

    kp_n_m: NonNegative
    ki_n_m_s: NonNegative


class Control(Strict):
    """The three SISO PI controllers of the pose."""

    psi: TiltGains
    theta: TiltGains
    z: HeightGains

    @property
    def kp(self) -> tuple[float, float, float]:
        """Proportional gains of psi, theta, z in N m/rad, N m/rad, N/m."""
        return self.psi.kp_n_m_rad, self.theta.kp_n_m_rad, self.z.kp_n_m

    @property
    def ki(self) -> tuple[float, float, float]:
        """Integral gains of psi, theta, z in N m/(rad s), N m/(rad s), N/(m s)."""
        return self.psi.ki_n_m_rad_s, self.theta.ki_n_m_rad_s, self.z.ki_n_m_s


class FeedForward(Strict):
    """Feed-forward of a rig without a model: weight, beam torque, stiffness of the rods in z.

    The rods' force is zero at the working point. During lift-off and landing its feed-forward
    keeps the platform on its reference.
    """

    mass_kg: NonNegative
    beam_mass_kg: NonNegative
    rods_n_m: NonNegative
    gravity_m_s2: Positive = 9.81


class Limits(Strict):
    """Limits of the control loop: coil forces are clipped, any other excess is a fault."""

    coil_n: Positive
    coil_rate_n_s: Positive
    gap_m: Positive
    beam_m: Annotated[float, Field(gt=0, le=2.1, allow_inf_nan=False)]  # 32 bits of 1 nm
    beam_velocity_m_s: Positive
    beam_acceleration_m_s2: Positive
    rotor_velocity_rad_s: Positive = 20.0
    rotor_acceleration_rad_s2: Positive = 200.0
    late_cycles: Annotated[int, Field(ge=1, le=10_000)] = 20
    """Cycles late by a period or more before the fault LATE; ten punctual cycles cancel one."""
    stall_s: Positive | None = None
    """Longest single stall of the loop without a fault; default: until amplifiers expire or a
    falling platform would leave `gap_m`."""
    late_in_window: Annotated[int, Field(ge=1, le=1_000_000)] = 500
    """Late cycles within `late_window_s`, consecutive or not."""
    late_window_s: Annotated[float, Field(gt=0, le=3600.0)] = 60.0
    total_n: Positive | None = None
    """Sum of the absolute coil forces; above it all forces are scaled down."""
    tilt_rad: Positive | None = None
    gap_m_s: Positive | None = None
    plane_m: Positive | None = None
    """Distance of a sensor's reading from the plane through the others, averaged over 0.1 s;
    default: that of the self-test."""
    coil_rms_n: Positive | None = None
    coil_time_constant_s: Positive = 60.0
    coil_follow_n: Positive | None = None
    """Largest deviation of a coil's readback from its command; default: 2.5 % of `coil_n`."""
    coil_lag_s: Annotated[float, Field(gt=0, le=1.0)] | None = None
    """Longest time constant of the amplifiers; default: twice the model's lag, at least 1 ms."""
    beam_follow_m: Positive | None = None
    """Largest deviation of the beam from its setpoint; default: from its weight, kp and `gap_m`."""
    rotor_follow_rad: Positive = 0.05
    drive_lag_s: Annotated[float, Field(gt=0, le=10.0)] = 0.02
    """Longest time constant of the drives' position loops."""


class Channels(Strict):
    """Scales of single channels against what they should be; `levid commission` finds them."""

    sensor_scale: tuple[Scale, ...] = ()
    """Reading over the true height of each sensor, negative for a wrong sign; default: 1."""
    coil_scale: tuple[Scale, ...] = ()
    """Force over the command of each coil, negative for a wrong polarity; default: 1."""


class Role(BaseModel):
    """Backend of a role; the backend defines and validates all further keys."""

    model_config = ConfigDict(extra="allow", frozen=True)

    backend: Annotated[str, Field(min_length=1)]

    @property
    def options(self) -> dict[str, Any]:
        """The backend's own keys."""
        return dict(self.model_extra or {})


class _Section(NamedTuple):
    """A key of RIG.yaml that is not a field: perhaps the buses of another package's backend."""

    key: str
    value: Any
    used: bool
    """Whether a role names the key as its backend."""


def _buses(section: _Section) -> Any:
    """Parse the buses of another package's backend.

    If that package is not installed, they are left as they are: a log can be identified on a
    machine that lacks it, and opening the devices reports the missing backend.
    """
    try:
        schema = bus_schema(section.key)
    except ConfigError as error:
        raise ValueError(str(error)) from None
    if schema is not None:
        buses: Any = TypeAdapter(dict[Name, schema])  # type: ignore[valid-type]
        return buses.validate_python(section.value)
    if section.used:
        return section.value
    raise PydanticKnownError("extra_forbidden")


class RigConfig(Strict):
    """RIG.yaml: a rig's geometry, control, limits, devices, and how the daemon runs it."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Annotated[Any, BeforeValidator(_buses)]]

    levid: Literal["rig"]
    name: Name
    rate_hz: Rate
    geometry: Geometry
    control: Control
    model: Annotated[
        Annotated[str, Field(min_length=1)] | ModelConfig | None,
        # docs/configuration.md describes the model's keys in their own section.
        WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "null"}]}),
    ] = None
    """MODEL.yaml, relative to this file or by its shipped name, or the model itself, as `load_rig`
    returns it."""
    feedforward: FeedForward | None = None
    """Feed-forward of a rig without `model`."""
    limits: Limits
    channels: Channels = Channels()
    amplifiers: Role
    sensors: Role
    drives: Role
    can: dict[Name, CanBus] = Field(default_factory=dict)
    """CAN buses by the names that roles use."""
    serial: dict[Name, SerialBus] = Field(default_factory=dict)
    """Serial ports by the names that roles use."""
    sim: str | None = None
    """SIM.yaml of the loopback backend and of emulated electronics, relative to this file or by its
    shipped name."""
    socket: str | None = None
    """Path of the daemon's control socket; default: in a runtime directory of the user."""
    realtime: Realtime = Realtime()
    service: Service = Service()
    recording: Recording = Recording()
    live: Live | None = None
    """Live view; None: there is none."""
    self_test: SelfTest = SelfTest()

    @model_validator(mode="before")
    @classmethod
    def _name_sections(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        roles = [data[role] for role in ROLES if role in data]
        used = [role.get("backend") for role in roles if isinstance(role, Mapping)]
        return {
            key: value if key in cls.model_fields else _Section(key, value, key in used)
            for key, value in data.items()
        }

    @model_validator(mode="after")
    def _one_feed_forward(self) -> Self:
        if (self.model is None) == (self.feedforward is None):
            found = "neither" if self.model is None else "both"
            raise ValueError(
                f"expected either 'model' (path of a MODEL.yaml) or 'feedforward', found {found}"
            )
        return self

    @model_validator(mode="after")
    def _scale_of_each_channel(self) -> Self:
        own = self.geometry
        for key, count in (("sensor", len(own.sensors_x_m)), ("coil", len(own.coil_x_m))):
            found = getattr(self.channels, f"{key}_scale")
            if found and len(found) != count:
                raise ValueError(
                    f"channels.{key}_scale: expected {count} numbers, one for each {key}, found "
                    f"{len(found)}"
                )
        return self

    @model_validator(mode="after")
    def _loop_has_time(self) -> Self:
        # The loop reports once a period; a healthy loop may be late by two more periods.
        least_s = _LEAST_PERIODS / self.rate_hz
        if self.service.loop_s < least_s * (1.0 - 1e-9):
            raise ValueError(
                f"service.loop_s: expected at least {least_s:g} s, {_LEAST_PERIODS} periods at "
                f"{self.rate_hz:g} Hz, found {self.service.loop_s:g} s"
            )
        return self

    @model_validator(mode="after")
    def _small_angles(self) -> Self:
        own = self.geometry
        arm_m = max(abs(x) for x in (*own.coil_x_m, *own.coil_y_m))
        for name, unit, limit, of in (
            ("gap_m", "m", _SMALL_ANGLE * arm_m, f", {_SMALL_ANGLE:g} rad at the longest arm"),
            ("tilt_rad", "rad", _SMALL_ANGLE, ""),
        ):
            found = getattr(self.limits, name)
            if found is not None and found > limit > 0.0:
                slip = f"; is it in m{unit}?" if found <= 1e3 * limit else ""
                raise ValueError(
                    f"limits.{name}: expected at most {limit:.3g} {unit}{of}, found {found:g}{slip}"
                )
        return self

    @model_validator(mode="after")
    def _one_name_each(self) -> Self:
        """Reject two names for one bus: each would get the capacity of the whole bus."""
        for backend, buses in self.buses.items():
            roles = (self.amplifiers, self.sensors, self.drives)
            used = [role.options.get("bus") for role in roles if role.backend == backend]
            named: dict[str, str] = {}
            for name, bus in buses.items():
                other = named.setdefault(bus.place, name) if name in used else name
                if other != name:
                    raise ValueError(
                        f"{backend}: expected one name for the bus {bus.place}, found '{other}' "
                        f"and '{name}'; use one of these names in all roles on this bus"
                    )
        return self

    @property
    def buses(self) -> Mapping[str, Mapping[str, Any]]:
        """Buses, each a subclass of Bus, by backend and name."""
        more = {key: buses for key, buses in (self.model_extra or {}).items() if _is_parsed(buses)}
        return {"can": self.can, "serial": self.serial, **more}

    @classmethod
    def extra_schema(cls, key: str) -> Any:
        """Return the schema of a bus in section `key`, None if no backend has such a section."""
        try:
            return bus_schema(key)
        except ConfigError:
            return None

    @property
    def plane_m(self) -> float:
        """Distance in m of a sensor from the plane through the others that is a fault."""
        return self.limits.plane_m if self.limits.plane_m is not None else self.self_test.plane_m

    @property
    def device_limits(self) -> Limits:
        """The limits in the units of the amplifiers' commands, of which weak coils need more."""
        least = min(map(abs, self.channels.coil_scale), default=1.0)
        scaled = {key: getattr(self.limits, key) / least for key in ("coil_n", "coil_rate_n_s")}
        return self.limits.model_copy(update=scaled)

    def on_bus(self, role: str) -> tuple[str, RoleOptions] | None:
        """Return backend and options of a role on a bus, None if its backend has no bus.

        Raises:
            ConfigError: an option is wrong, or no bus has that name.
        """
        played: Role = getattr(self, role)
        options = role_options(played.backend, role, played.options)
        if options is None:
            return None
        known = self.buses.get(played.backend, {})
        if options.bus not in known:
            raise ConfigError(
                f"{role}.bus: expected a bus that the key '{played.backend}' defines "
                f"({', '.join(sorted(known)) or 'it defines none'}), found '{options.bus}'"
            )
        return played.backend, options


def _is_parsed(buses: Any) -> bool:
    return isinstance(buses, dict) and all(isinstance(bus, Bus) for bus in buses.values())


def load_rig(path: Path | str) -> RigConfig:
    """Read a RIG.yaml file and the model that it names; raises ConfigError."""
    return with_model(load_yaml(path, RigConfig), Path(path))


def with_model(rig: RigConfig, rig_file: Path) -> RigConfig:
    """Replace the model's path in a rig read from `rig_file` by the model.

    Raises:
        ConfigError: the model cannot be read.
    """
    if not isinstance(rig.model, str):
        return rig
    try:
        model = load_model(find_file(rig.model, "model", folder=rig_file.parent))
    except ConfigError as error:
        lines = str(error).splitlines()
        raise ConfigError("\n".join(f"{rig_file}: model: {line}" for line in lines)) from None
    return rig.model_copy(update={"model": model})


def model_path(rig_file: Path) -> Path | None:
    """Return the path of the MODEL.yaml that a rig file names, None if it names none."""
    model = load_yaml(rig_file, RigConfig).model
    if not isinstance(model, str):
        return None
    return find_file(model, "model", folder=rig_file.parent).resolve()
