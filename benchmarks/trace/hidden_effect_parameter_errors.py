"""Compare parameters that a trace finds with those of the simulator, where their equations agree.

The simulator states a force at one point of a DOF, a candidate the generalised force: a force F at
the arm r (1 for z) is a torque r F, a distance s an angle s / r. If plant and candidate have
different equations (a one-sided spring as a parabola), only what both have in common is compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from levid.benchmarks.harness.virtual_flight import SIM
from levid.config.base import read_mapping
from levid.identification.subspace.response_uncertainty import SURE_95

Values = Mapping[str, Any]
Found = Mapping[str, float]

_SIM = read_mapping(SIM)
_ARM_M = float(_SIM["geometry"]["r_m"])
_BEAM_M = float(_SIM["beam"]["z_b_m"])
_GRAVITY_M_S2 = 9.81
_RECORD_S = 24.0
"""A payload's time is relative to a record of trace-short.yaml, not to the session's clock."""
_SAME_LINE_HZ = 0.3
_POSE = ("psi", "theta", "z")


@dataclass(frozen=True)
class Known:
    """One true number: the candidate and places it belongs to, and how to read it there.

    read: a parameter's name, or a function of all parameters that returns None for another effect.
    where None: any place. The error is relative to `unit`, or to the value.
    """

    key: str
    where: Sequence[str] | None
    value: float
    read: str | Callable[[Found], float | None]
    unit: float | None = None

    def in_(self, effect: Mapping[str, Any]) -> float | None:
        """Return this number in an effect of a model, None if it is not there."""
        if not is_called(effect["effect"], self.key):
            return None
        if self.where is not None and set(effect["where"]) != set(self.where):
            return None
        found = {name: p["value"] for name, p in effect["parameters"].items()}
        return found.get(self.read) if isinstance(self.read, str) else self.read(found)


def known(entry: Values) -> list[Known]:
    """Return the numbers that are known of an entry of a SIM.yaml's `effects`."""
    return _KNOWN.get(entry["use"].rpartition(":")[2], lambda _: [])(entry)


def relative_errors(
    entries: Sequence[Values], summary: Mapping[str, Any], placed: Sequence[Mapping[str, Any]]
) -> list[float]:
    """Return the relative errors of all known numbers of these entries that a trace found.

    summary: the output of `levid trace --json`. placed: effects of the model that it ends with
    (effect, where, parameters). Random forces are in no such model; the summary names them.
    """
    random = [
        {"effect": "vibration.random", "where": e["where"], "parameters": e["parameters"]}
        for e in summary["effects"]
        if e["class"] == "vibration" and "rms" in e.get("parameters", {})
    ]
    return [
        abs(number - one.value) / abs(one.value if one.unit is None else one.unit)
        for entry in entries
        for one in known(entry)
        for effect in (*placed, *random)
        if (number := one.in_(effect)) is not None
    ]


def intervals(
    entries: Sequence[Values], placed: Sequence[Mapping[str, Any]]
) -> list[tuple[bool, float]]:
    """Return for each known number that has a standard error: whether its interval has the truth.

    The interval is that of 95 %; its half width over the true number follows. Numbers that are
    computed from several parameters have none.
    """
    found = []
    for one in (one for entry in entries for one in known(entry)):
        for effect in placed:
            number = one.in_(effect)
            if number is None or not isinstance(one.read, str):
                continue
            error = effect["parameters"][one.read].get("se")
            if error is not None and math.isfinite(error):
                half = SURE_95 * error
                found.append((abs(number - one.value) <= half, half / abs(one.value)))
    return found


def is_called(effect: str, key: str) -> bool:
    """Return whether an effect of the table is `key` or belongs to the group `key`."""
    return effect == key or effect.startswith(f"{key}.")


def _at(where: Sequence[str] | None, key: str, **numbers: float) -> list[Known]:
    return [Known(key, where, value, name) for name, value in numbers.items()]


def _on_dof(v: Values, key: str, arms: int, **numbers: float) -> list[Known]:
    """Return numbers at a DOF that go with the power `arms` of its arm."""
    by = _arm(v) ** arms
    return _at([v["dof"]], key, **{name: by * value for name, value in numbers.items()})


def _arm(v: Values) -> float:
    return 1.0 if v["dof"] == "z" else _ARM_M


def _coils(v: Values) -> list[str]:
    return [f"coil:{i}" for i in range(9)] if v["coil"] == "all" else [f"coil:{v['coil']}"]


def _sensor(v: Values) -> list[str]:
    return [f"sensor:{v['sensor']}"]


def _amplitude(found: Found) -> float | None:
    """Return the amplitude of a cosine and a sine."""
    return math.hypot(found["a"], found["b"]) if {"a", "b"} <= set(found) else None


def _line(f_hz: float) -> Callable[[Found], float | None]:
    """Return what reads the amplitude of the spectral line at f_hz, and of no other."""

    def amplitude(found: Found) -> float | None:
        near = abs(found.get("frequency", -1.0) - f_hz) < _SAME_LINE_HZ
        return _amplitude(found) if near else None

    return amplitude


def _sliding(v: Values) -> list[Known]:
    laws = ("coulomb", "stribeck", "dahl", "lugre")
    return [
        one for law in laws for one in _on_dof(v, f"friction.{law}", 1, friction=v["coulomb_n"])
    ]


def _bouc_wen(v: Values) -> list[Known]:
    force = (1.0 - v.get("left", 0.0)) * v["stiffness_n_m"] * v["yield_m"]
    return [
        *_on_dof(v, "friction.bouc_wen", 1, friction=force),
        *_on_dof(v, "friction.dahl", 1, friction=force),
        *_on_dof(v, "friction.bouc_wen", -1, x_s=v["yield_m"]),
    ]


def _payload(v: Values) -> list[Known]:
    when = Known("payload", _POSE, v["begin_s"], "time", _RECORD_S)
    return [*_at(_POSE, "payload", m=v["mass_kg"], x=v["x_m"], y=v["y_m"]), when]


def _imbalance(v: Values) -> list[Known]:
    s = abs(v["imbalance_kg_m"])
    return [
        Known("rotor.imbalance", ["rotor", "psi"], s * v["rotor_z_m"], _amplitude),
        Known("rotor.imbalance", ["rotor", "theta"], s * v["rotor_z_m"], _amplitude),
        Known("rotor.weight", ["rotor", "psi", "theta"], s * _GRAVITY_M_S2, _amplitude),
    ]


def _lag_or_delay(v: Values, time_s: float) -> list[Known]:
    # A slow platform shows only what a lag and a delay of one time have in common.
    lag = _at(_coils(v), "actuator_lag", lag=time_s)
    return lag + _at(_coils(v), "delay", delay=time_s)


def _bent(v: Values) -> list[Known]:
    one_m = 1.0 / v["distance_m"]
    quadratic = _at(_sensor(v), "sensor_nonlinearity.quadratic", a=-one_m)
    return quadratic + _at(_sensor(v), "sensor_nonlinearity.inverse", a=-one_m, k=one_m)


def _mains(v: Values, key: str, where: Sequence[str], amplitudes: Sequence[float]) -> list[Known]:
    first_hz = v.get("freq_hz", 50.0)
    return [
        Known(key, where, abs(amplitude), _line(k * first_hz))
        for k, amplitude in enumerate(amplitudes, 1)
        if amplitude
    ]


_KNOWN: dict[str, Callable[[Values], list[Known]]] = {
    "CubicRods": lambda v: _on_dof(v, "rod_stiffness.cubic", 4, k3=v["k3_n_m3"]),
    "QuadraticRods": lambda v: _on_dof(v, "rod_stiffness.asymmetric", 3, k2=v["k2_n_m2"]),
    "BilinearRods": lambda v: _on_dof(v, "rod_stiffness.one_sided", 2, k=v["k_n_m"]),
    "QuadraticDamping": lambda v: _on_dof(v, "air_damping.quadratic", 3, d2=v["d2_n_s2_m2"]),
    "SqueezeFilm": lambda v: [
        # As long as the film moves little in its thickness, only d / h0 shows.
        Known("air_damping.squeeze_film", _POSE, v["d_n_s_m"] / v["film_m"],
              lambda f: f["d"] / f["h0"])
    ],
    "Coulomb": lambda v: _sliding(v) + _on_dof(v, "friction.coulomb", -1, v_s=v["speed_m_s"]),
    "Stribeck": _sliding,
    "Dahl": lambda v: (
        _sliding(v) + _on_dof(v, "friction.dahl", -1, x_s=v["coulomb_n"] / v["stiffness_n_m"])
    ),
    "LuGre": _sliding,
    "BoucWen": _bouc_wen,
    "MaxwellSlip": lambda v: [
        Known("friction.maxwell_slip", [v["dof"]], sum(v["slip_n"]) * _arm(v),
              lambda f: f["friction_1"] + f["friction_2"] + f["friction_3"])
    ],
    "BeamCable": lambda v: _at(["z"], "cable_pull.linear", a=v["weight_n_m"]),
    "FlexibleMode": lambda v: _at(
        None, "flexible_mode", frequency=v["freq_hz"], damping=v["damping"]
    ),
    "CentreOfMass": lambda v: (
        _at(["psi", "z"], "centre_of_mass", a=v["m_p_kg"] * v["y_m"])
        + _at(["theta", "z"], "centre_of_mass", a=v["m_p_kg"] * v["x_m"])
    ),
    "Payload": _payload,
    "BearingPresliding": lambda v: _at(
        None, "friction.bearing", m=v["m_b_kg"] * _BEAM_M**2, height=_BEAM_M
    ),
    "BearingPlay": lambda v: _at(
        None, "backlash.bearing", m=v["m_b_kg"] * _BEAM_M**2, half=0.5 * v["play_m"] / _BEAM_M
    ),
    "MotorFriction": lambda v: (
        _at(["beam"], "friction.beam", friction=v["coulomb_n"], v_s=v["speed_m_s"])
        + _at(["beam"], "friction.beam_presliding", friction=v["coulomb_n"])
    ),
    "MotorCogging": lambda v: [
        Known("cogging", ["beam"], abs(v["amplitude_n"]), _amplitude),
        *_at(["beam"], "cogging", pitch=v["pitch_m"]),
    ],
    "MagnetField": lambda v: [
        Known("external_field", ["z"], abs(v["amplitude_n"]), _amplitude),
        *_at(["z"], "external_field", period=v["pitch_m"]),
    ],
    "BeamReaction": lambda v: _at(
        ["theta"], "beam_motion.reaction", a=v["excess"] * v["m_b_kg"] * _BEAM_M
    ),
    "BeamCoriolis": lambda v: _at(
        ["z"], "beam_motion.coriolis_lift", a=v["excess"] * v["m_b_kg"]
    ),
    "BeamGravity": lambda v: _at(
        ["theta"], "beam_motion.gravity", a=v["excess"] * v["m_b_kg"] * _GRAVITY_M_S2
    ),
    "RotorImbalance": _imbalance,
    "BarTorque": lambda v: (
        _at(["rotor", "psi"], "rotor.bar", a=v["j_kg_m2"] * v["lean_x_rad"])
        + _at(["rotor", "theta"], "rotor.bar", a=-v["j_kg_m2"] * v["lean_y_rad"])
    ),
    "CoilGain": lambda v: _at(_coils(v), "coil_gain", gain=v["excess"]),
    "ForceConstant": lambda v: (
        _at(_coils(v), "force_constant.linear", a=v["slope_1_m"])
        if v["slope_1_m"]
        else _at(_coils(v), "force_constant.quadratic", b=v["curve_1_m2"])
    ),
    "ActuatorLag": lambda v: _lag_or_delay(v, v["lag_s"]),
    "ExtraDelay": lambda v: _lag_or_delay(v, v["delay_s"]),
    "DeadZone": lambda v: _at(_coils(v), "dead_zone", width=v["width_n"]),
    "ThermalDrift": lambda v: _at(
        _coils(v), "thermal_drift.heat", a=v["loss"] / v["rated_n"] ** 2, tau=v["time_constant_s"]
    ),
    "SoftSaturation": lambda v: _at(_coils(v), "saturation", limit=v["limit_n"]),
    "SensorGain": lambda v: _at(_sensor(v), "sensor_gain", gain=v["excess"]),
    "SensorNonlinearity": _bent,
    "SensorDrift": lambda v: _at(
        _sensor(v), "sensor_offset.warm_up", a=v["offset_m"], tau=v["time_constant_s"]
    ),
    "SensorCrosstalk": lambda v: _at(
        [*_sensor(v), f"sensor:{v['other']}"], "sensor_crosstalk", share=v["share"]
    ),
    "SensorLag": lambda v: _at(_sensor(v), "sensor_lag", lag=v["lag_s"]),
    "StickingSensor": lambda v: _at(_sensor(v), "sensor_stuck.jump", width=v["step_m"]),
    "MainsForce": lambda v: _mains(
        v, "vibration.force", [v["dof"]], [_arm(v) * a for a in v["amplitudes_n"]]
    ),
    "MainsPickup": lambda v: _mains(v, "vibration.reading", _sensor(v), v["amplitudes_m"]),
    "GroundTone": lambda v: [
        Known("vibration.force", ["z"], abs(v["acceleration_m_s2"]) * v["mass_kg"],
              _line(v["freq_hz"]))
    ],
    # All power is in the band: the force's rms is the floor's acceleration times the mass.
    "GroundNoise": lambda v: _at(["z"], "vibration.random", rms=v["rms_m_s2"] * v["mass_kg"]),
}  # fmt: skip
"""By the simulator's class."""
