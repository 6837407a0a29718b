"""The parameters that a trace should find, from what the simulator was told, where forms agree.

The simulator says forces at one point of a DOF, the candidates generalised ones: a force F at the
arm r (1 for z) is a torque r F, a way s an angle s / r. Where plant and candidate are written in
different forms (a one-sided spring as a parabola, several springs that slip for one that yields)
what both have in common is compared, or nothing.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from levid.benchmarks.trace.zoo_cases import is_called
from levid.benchmarks.trace.zoo_fly import SESSION, SIM
from levid.config.base import read_mapping
from levid.config.session import RecordStep, load_session

Values = Mapping[str, Any]
Found = Mapping[str, float]

_SIM = read_mapping(SIM)
_ARM_M = float(_SIM["geometry"]["r_m"])
_BEAM_M = float(_SIM["beam"]["z_b_m"])
_GRAVITY_M_S2 = 9.81
_SAME_LINE_HZ = 0.3


@dataclass(frozen=True)
class Known:
    """One number that is known of an effect: in which candidate, where, and how to read it there.

    `of` returns the number from a candidate's parameters, None if it is not about this one. Without
    places it is known wherever the candidate is. An error is over `unit`, None for over the value.
    """

    key: str
    where: frozenset[str] | None
    label: str
    value: float
    of: Callable[[Found], float | None]
    unit: float | None = None


@dataclass(frozen=True)
class Compared:
    """A number found beside the true one; `error` is relative to `unit`, or to the true one."""

    label: str
    true: float
    found: float
    unit: float | None = None

    @property
    def error(self) -> float:
        return abs(self.found - self.true) / abs(self.true if self.unit is None else self.unit)


def compared(
    entries: Sequence[Mapping[str, Any]], placed: Sequence[Mapping[str, Any]]
) -> list[Compared]:
    """Return all that is known of the effects flown and was found.

    `entries` are those of the SIM.yaml, `placed` those of the model that the trace ends with
    (effect, where, parameters with a value each), and random forces among them.
    """
    found = []
    for entry in entries:
        cls = entry["use"].rpartition(":")[2]
        for known in _KNOWN.get(cls, _nothing)(entry):
            for effect in placed:
                if not is_called(effect["effect"], known.key):
                    continue
                if known.where is not None and set(effect["where"]) != known.where:
                    continue
                values = {name: p["value"] for name, p in effect["parameters"].items()}
                number = known.of(values)
                if number is not None:
                    found.append(Compared(known.label, known.value, number, known.unit))
    return found


def _nothing(_v: Values) -> Iterator[Known]:
    yield from ()


def _on_dof(
    v: Values, key: str, name: str, value: float, arms: int, label: str | None = None
) -> Known:
    """Return a number at a DOF that goes with the power `arms` of the arm."""
    return Known(key, frozenset({v["dof"]}), label or name, value * _arm(v) ** arms, _get(name))


def _at(places: Sequence[str], key: str, name: str, value: float) -> Known:
    return Known(key, frozenset(places), name, value, _get(name))


def _get(name: str) -> Callable[[Found], float | None]:
    return lambda found: found.get(name)


def _size(found: Found) -> float | None:
    """Return the amplitude of a cosine and a sine."""
    return math.hypot(found["a"], found["b"]) if {"a", "b"} <= set(found) else None


@cache
def _record_s() -> float:
    """Return the length of the session's records, the median of them, s."""
    records = [step.record for step in load_session(SESSION).steps if step.record is not None]
    return statistics.median(_length_s(record) for record in records)


def _length_s(record: RecordStep) -> float:
    if record.each_s is not None:
        return record.each_s * len(record.excite)
    assert record.duration_s is not None
    return record.duration_s


def _arm(v: Values) -> float:
    return 1.0 if v["dof"] == "z" else _ARM_M


def _coils(v: Values, what: str = "coil") -> list[str]:
    return [f"{what}:{i}" for i in range(9)] if v[what] == "all" else [f"{what}:{v[what]}"]


def _cubic(v: Values) -> Iterator[Known]:
    yield _on_dof(v, "rod_stiffness.cubic", "k3", v["k3_n_m3"], 4)


def _quadratic(v: Values) -> Iterator[Known]:
    yield _on_dof(v, "rod_stiffness.asymmetric", "k2", v["k2_n_m2"], 3)


def _bilinear(v: Values) -> Iterator[Known]:
    yield _on_dof(v, "rod_stiffness.one_sided", "k", v["k_n_m"], 2)


def _drag(v: Values) -> Iterator[Known]:
    yield _on_dof(v, "air_damping.quadratic", "d2", v["d2_n_s2_m2"], 3)


def _film(v: Values) -> Iterator[Known]:
    # As long as the film moves little in its thickness, d / h0 alone is seen.
    places = frozenset({"psi", "theta", "z"})
    true = v["d_n_s_m"] / v["film_m"]
    yield Known("air_damping.squeeze_film", places, "d / h0", true, lambda f: f["d"] / f["h0"])


def _sliding(v: Values) -> Iterator[Known]:
    for key in ("friction.coulomb", "friction.stribeck", "friction.dahl", "friction.lugre"):
        yield _on_dof(v, key, "friction", v["coulomb_n"], 1)


def _coulomb(v: Values) -> Iterator[Known]:
    yield from _sliding(v)
    yield _on_dof(v, "friction.coulomb", "v_s", v["speed_m_s"], -1)


def _dahl(v: Values) -> Iterator[Known]:
    yield from _sliding(v)
    yield _on_dof(v, "friction.dahl", "x_s", v["coulomb_n"] / v["stiffness_n_m"], -1)


def _bouc_wen(v: Values) -> Iterator[Known]:
    force = (1.0 - v.get("left", 0.0)) * v["stiffness_n_m"] * v["yield_m"]
    for key in ("friction.bouc_wen", "friction.dahl"):
        yield _on_dof(v, key, "friction", force, 1)
    yield _on_dof(v, "friction.bouc_wen", "x_s", v["yield_m"], -1)


def _slip(v: Values) -> Iterator[Known]:
    yield Known(
        "friction.maxwell_slip", frozenset({v["dof"]}), "friction, all", sum(v["slip_n"]) * _arm(v),
        lambda f: f["friction_1"] + f["friction_2"] + f["friction_3"],
    )  # fmt: skip


def _beam_cable(v: Values) -> Iterator[Known]:
    yield _at(["z"], "cable_pull.linear", "a", v["weight_n_m"])


def _mode(v: Values) -> Iterator[Known]:
    for name, true in (("frequency", v["freq_hz"]), ("damping", v["damping"])):
        yield Known("flexible_mode", None, name, true, _get(name))


def _centre(v: Values) -> Iterator[Known]:
    yield _at(["psi", "z"], "centre_of_mass", "a", v["m_p_kg"] * v["y_m"])
    yield _at(["theta", "z"], "centre_of_mass", "a", v["m_p_kg"] * v["x_m"])


def _payload(v: Values) -> Iterator[Known]:
    places = ["psi", "theta", "z"]
    for name, key in (("m", "mass_kg"), ("x", "x_m"), ("y", "y_m")):
        yield _at(places, "payload", name, v[key])
    # The clock's zero is nothing to the payload: to know when it came is to know where in a record.
    when = _at(places, "payload", "time", v["begin_s"])
    yield replace(when, unit=_record_s())


def _motor_friction(v: Values) -> Iterator[Known]:
    # What goes with the speed is none of it: see model/effects/drives.py.
    for key in ("friction.beam", "friction.beam_presliding"):
        yield _at(["beam"], key, "friction", v["coulomb_n"])
    yield _at(["beam"], "friction.beam", "v_s", v["speed_m_s"])


def _cogging(v: Values) -> Iterator[Known]:
    places = frozenset({"beam"})
    yield Known("cogging", places, "amplitude", abs(v["amplitude_n"]), _size)
    yield Known("cogging", places, "pitch", v["pitch_m"], _get("pitch"))


def _bearing(v: Values) -> Iterator[Known]:
    # Where its springs begin to slip is another thing in one that yields little by little.
    for name, true in (("m", v["m_b_kg"] * _BEAM_M**2), ("height", _BEAM_M)):
        yield Known("friction.bearing", None, name, true, _get(name))


def _field(v: Values) -> Iterator[Known]:
    places = frozenset({"z"})
    yield Known("external_field", places, "amplitude", abs(v["amplitude_n"]), _size)
    yield Known("external_field", places, "period", v["pitch_m"], _get("period"))


def _reaction(v: Values) -> Iterator[Known]:
    yield _at(["theta"], "beam_motion.reaction", "a", v["excess"] * v["m_b_kg"] * _BEAM_M)


def _coriolis(v: Values) -> Iterator[Known]:
    yield _at(["z"], "beam_motion.coriolis_lift", "a", v["excess"] * v["m_b_kg"])


def _gravity(v: Values) -> Iterator[Known]:
    yield _at(["theta"], "beam_motion.gravity", "a", v["excess"] * v["m_b_kg"] * _GRAVITY_M_S2)


def _imbalance(v: Values) -> Iterator[Known]:
    s = abs(v["imbalance_kg_m"])
    for dof in ("psi", "theta"):
        where = frozenset({"rotor", dof})
        yield Known("rotor.imbalance", where, f"on {dof}", s * v["rotor_z_m"], _size)
    every = frozenset({"rotor", "psi", "theta"})
    yield Known("rotor.weight", every, "weight", s * _GRAVITY_M_S2, _size)


def _bar(v: Values) -> Iterator[Known]:
    yield _at(["rotor", "psi"], "rotor.bar", "a", v["j_kg_m2"] * v["lean_x_rad"])
    yield _at(["rotor", "theta"], "rotor.bar", "a", -v["j_kg_m2"] * v["lean_y_rad"])


def _gain(v: Values) -> Iterator[Known]:
    yield _at(_coils(v), "coil_gain", "gain", v["excess"])


def _constant(v: Values) -> Iterator[Known]:
    if v["slope_1_m"]:
        yield _at(_coils(v), "force_constant.linear", "a", v["slope_1_m"])
    if v.get("curve_1_m2"):
        yield _at(_coils(v), "force_constant.quadratic", "b", v["curve_1_m2"])


def _lag(v: Values) -> Iterator[Known]:
    # What a lag and a delay of the same time do alike is all that a slow platform shows.
    yield _at(_coils(v), "actuator_lag", "lag", v["lag_s"])
    yield _at(_coils(v), "delay", "delay", v["lag_s"])


def _delay(v: Values) -> Iterator[Known]:
    yield _at(_coils(v), "delay", "delay", v["delay_s"])
    yield _at(_coils(v), "actuator_lag", "lag", v["delay_s"])


def _dead_zone(v: Values) -> Iterator[Known]:
    yield _at(_coils(v), "dead_zone", "width", v["width_n"])


def _thermal(v: Values) -> Iterator[Known]:
    yield _at(_coils(v), "thermal_drift.heat", "a", v["loss"] / v["rated_n"] ** 2)
    yield _at(_coils(v), "thermal_drift.heat", "tau", v["time_constant_s"])


def _saturation(v: Values) -> Iterator[Known]:
    yield _at(_coils(v), "saturation", "limit", v["limit_n"])


def _sensor_gain(v: Values) -> Iterator[Known]:
    yield _at(_coils(v, "sensor"), "sensor_gain", "gain", v["excess"])


def _bent(v: Values) -> Iterator[Known]:
    places = _coils(v, "sensor")
    yield _at(places, "sensor_nonlinearity.quadratic", "a", -1.0 / v["distance_m"])
    yield _at(places, "sensor_nonlinearity.inverse", "a", -1.0 / v["distance_m"])
    yield _at(places, "sensor_nonlinearity.inverse", "k", 1.0 / v["distance_m"])


def _warm_up(v: Values) -> Iterator[Known]:
    places = _coils(v, "sensor")
    yield _at(places, "sensor_offset.warm_up", "a", v["offset_m"])
    yield _at(places, "sensor_offset.warm_up", "tau", v["time_constant_s"])


def _crosstalk(v: Values) -> Iterator[Known]:
    places = [f"sensor:{v['sensor']}", f"sensor:{v['other']}"]
    yield _at(places, "sensor_crosstalk", "share", v["share"])


def _sensor_lag(v: Values) -> Iterator[Known]:
    yield _at(_coils(v, "sensor"), "sensor_lag", "lag", v["lag_s"])


def _sticking(v: Values) -> Iterator[Known]:
    yield _at(_coils(v, "sensor"), "sensor_stuck.jump", "width", v["step_m"])


def _hum(v: Values) -> Iterator[Known]:
    force = "dof" in v
    key = "vibration.force" if force else "vibration.reading"
    where = frozenset([v["dof"]] if force else _coils(v, "sensor"))
    arm = _arm(v) if force else 1.0
    for k, amplitude in enumerate(v["amplitudes_n" if force else "amplitudes_m"], 1):
        if amplitude:
            f_hz = k * v.get("freq_hz", 50.0)
            yield Known(key, where, f"{f_hz:g} Hz", abs(amplitude) * arm, _line(f_hz))


def _tone(v: Values) -> Iterator[Known]:
    force = abs(v["acceleration_m_s2"]) * v["mass_kg"]
    yield Known("vibration.force", frozenset({"z"}), "force", force, _line(v["freq_hz"]))


def _shaken(v: Values) -> Iterator[Known]:
    # All of its power is in its band, so that of the force is that of the floor times the mass.
    force = v["rms_m_s2"] * v["mass_kg"]
    yield Known("vibration.random", frozenset({"z"}), "rms", force, _get("rms"))


def _line(f_hz: float) -> Callable[[Found], float | None]:
    """Return what reads the amplitude of one line and of no other."""

    def amplitude(found: Found) -> float | None:
        near = abs(found.get("frequency", -1.0) - f_hz) < _SAME_LINE_HZ
        return _size(found) if near else None

    return amplitude


_KNOWN: dict[str, Callable[[Values], Iterator[Known]]] = {
    "CubicRods": _cubic,
    "QuadraticRods": _quadratic,
    "BilinearRods": _bilinear,
    "QuadraticDamping": _drag,
    "SqueezeFilm": _film,
    "Coulomb": _coulomb,
    "Stribeck": _sliding,
    "Dahl": _dahl,
    "LuGre": _sliding,
    "BoucWen": _bouc_wen,
    "MaxwellSlip": _slip,
    "BeamCable": _beam_cable,
    "FlexibleMode": _mode,
    "CentreOfMass": _centre,
    "Payload": _payload,
    "BearingPresliding": _bearing,
    "MotorFriction": _motor_friction,
    "MotorCogging": _cogging,
    "MagnetField": _field,
    "BeamReaction": _reaction,
    "BeamCoriolis": _coriolis,
    "BeamGravity": _gravity,
    "RotorImbalance": _imbalance,
    "BarTorque": _bar,
    "CoilGain": _gain,
    "ForceConstant": _constant,
    "ActuatorLag": _lag,
    "ExtraDelay": _delay,
    "DeadZone": _dead_zone,
    "ThermalDrift": _thermal,
    "SoftSaturation": _saturation,
    "SensorGain": _sensor_gain,
    "SensorNonlinearity": _bent,
    "SensorDrift": _warm_up,
    "SensorCrosstalk": _crosstalk,
    "SensorLag": _sensor_lag,
    "StickingSensor": _sticking,
    "MainsForce": _hum,
    "MainsPickup": _hum,
    "FloorTone": _tone,
    "FloorNoise": _shaken,
}
