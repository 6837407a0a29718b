"""Describe an effect in a clause that anyone understands: 'coil 6 gives 2 % less force'."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

from ...config.model import EffectParameter
from ...identification.subspace.response_uncertainty import SURE_95
from ...model.effects.base import Effect, in_words
from ..plotting.labelled_frequency_responses import symbol
from ..plotting.number_format import to_interval, unit_text
from ..plotting.style import engineering

Parameters = Mapping[str, EffectParameter]
_Clause = Callable[["_Said"], str]


def effect_in_words(effect: Effect, parameters: Parameters) -> str:
    """Return what an effect does as a clause without capital and full stop.

    Numbers have the digits that their 95 % intervals support. Effects without their own clause,
    such as free forms, have their name.
    """
    words = _Said(effect, parameters)
    for start, clause in _CLAUSES.items():
        if effect.key.startswith(start):
            return clause(words)
    return effect.name


def place_in_words(where: Sequence[str]) -> str:
    """Return locations as a reader names them: 'coil 6', 'θ', 'the beam', 'sensors 0 to 8'."""
    names = in_words(where)
    many = re.fullmatch(r"(coil|sensor):(\d+) to \1:(\d+)", names)
    if many:
        return f"{many[1]}s {many[2]} to {many[3]}"
    named = ["the " + w if w in ("beam", "rotor") else symbol(w).replace(":", " ") for w in where]
    return " and ".join([", ".join(named[:-1]), named[-1]]) if len(named) > 1 else named[0]


class _Said:
    """An effect's place and numbers in words."""

    def __init__(self, effect: Effect, parameters: Parameters) -> None:
        self._effect, self._parameters = effect, parameters

    @property
    def at(self) -> str:
        """The place."""
        return place_in_words(self._effect.where)

    @property
    def one(self) -> bool:
        """Whether it is at a single place, which takes a verb with an s."""
        return len(self._effect.where) == 1

    def verb(self, verb: str) -> str:
        """Return a verb in the number of the place."""
        return f"{verb}s" if self.one else verb

    def value(self, name: str) -> float:
        """Return a parameter's value; 0 if the effect has none of that name."""
        parameter = self._parameters.get(name)
        return 0.0 if parameter is None else parameter.value

    def number(self, name: str, factor: float = 1.0, unit: str | None = None) -> str:
        """Return the size of a parameter with the digits that its interval supports."""
        parameter = self._parameters[name]
        size, own = abs(parameter.value), parameter.unit
        prefix = ""
        if unit is None:
            scale, prefix = (1.0, "") if "/" in own or " " in own else engineering(size, own)
            factor *= scale
            unit = unit_text(own)
        half = 0.0 if parameter.se is None else SURE_95 * parameter.se
        return f"{_digits(factor * size, factor * half)} {prefix}{unit}".strip()

    def percent(self, name: str) -> str:
        """Return the size of a relative error in percent."""
        return self.number(name, 100.0, "%")

    def sign(self, name: str, positive: str, negative: str) -> str:
        """Return one of two words by the sign of a parameter."""
        return positive if self.value(name) >= 0.0 else negative


def _digits(size: float, half: float) -> str:
    """Return a positive number to the first digit of half its interval, to three without one."""
    if not half > 0.0 or half >= size:
        return f"{size:.2g}" if half >= size > 0.0 else f"{size:.3g}"
    return to_interval(size, half, digits=1)


def _coil_gain(e: _Said) -> str:
    if e.value("gain") < -1.0:
        return f"the force of {e.at} has the wrong sign"
    more = e.sign("gain", "more", "less")
    return f"{e.at} {e.verb('give')} {e.percent('gain')} {more} force than commanded"


def _friction(e: _Said) -> str:
    return f"dry friction of {e.number('friction')} acts on {e.at}"


def _presliding(e: _Said) -> str:
    return f"friction with an elastic start acts on {e.at}"


def _reads(name: str) -> _Clause:
    def clause(e: _Said) -> str:
        return f"{e.at} {e.verb('read')} {e.percent(name)} {e.sign(name, 'too much', 'too little')}"

    return clause


def _offset(e: _Said) -> str:
    return f"{e.at} {e.verb('read')} {e.number('offset')} too {e.sign('offset', 'high', 'low')}"


def _arm(e: _Said) -> str:
    longer = e.sign("arm", "longer", "shorter")
    return f"the arm lengths are {e.percent('arm')} {longer} than declared"


def _mode(e: _Said) -> str:
    return f"a part of the platform vibrates at {e.number('frequency')}"


def _loose_mass(e: _Said) -> str:
    return f"a mass on a spring vibrates at {e.number('frequency')} on {e.at}"


def _shaking(e: _Said) -> str:
    return f"a vibration of {e.number('frequency')} acts on {e.at}"


def _at(text: str) -> _Clause:
    """Return a clause that only names the place; `{at}` is the place, `{s}` the verb's s."""

    def clause(e: _Said) -> str:
        return text.format(at=e.at, s="s" if e.one else "")

    return clause


def _by_sign(name: str, text: str, positive: str, negative: str) -> _Clause:
    def clause(e: _Said) -> str:
        return text.format(at=e.at, s="s" if e.one else "", how=e.sign(name, positive, negative))

    return clause


def _with(name: str, text: str) -> _Clause:
    def clause(e: _Said) -> str:
        return text.format(at=e.at, s="s" if e.one else "", value=e.number(name))

    return clause


_CLAUSES: dict[str, _Clause] = {
    "rod_stiffness.cubic": _by_sign("k3", "the rods {how} in {at}", "harden", "soften"),
    "rod_stiffness.asymmetric": _at("the rods are stiffer to one side in {at}"),
    "rod_stiffness.one_sided": _at("a contact adds stiffness to one side of {at}"),
    "rod_stiffness.corners": _by_sign("k3", "the rods {how} at the corners", "harden", "soften"),
    "stiffness.cubic": _by_sign("k3", "the spring of {at} {how}", "hardens", "softens"),
    "stiffness.asymmetric": _at("the spring of {at} is stiffer to one side"),
    "stiffness.one_sided": _at("a contact adds stiffness to one side of {at}"),
    "air_damping.linear": _by_sign(
        "d", "the damping of {at} is {how} than declared", "higher", "lower"
    ),
    "air_damping.across": _at("damping couples {at}"),
    "air_damping.drag": _at("drag that grows with the speed squared acts on the platform"),
    "air_damping.squeeze_film": _at("the air film below the platform changes the damping"),
    "air_damping.quadratic": _at("drag that grows with the speed squared acts on {at}"),
    "damping.quadratic": _at("drag that grows with the speed squared acts on {at}"),
    "damping.one_sided": _at("the damping of {at} changes with the position"),
    "damping.outward": _at("the damping of {at} changes with the position squared"),
    "damping.asymmetric": _at("the damping of {at} differs between the two directions"),
    "friction.beam_chain": _at("the beam's cable chain drags on {at}"),
    "friction.bearing": _at("the beam's bearing has friction"),
    "friction.beam_tilt": _at("the friction of the beam depends on the tilt"),
    "friction.beam_presliding": _presliding,
    "friction.dahl": _presliding,
    "friction.bouc_wen": _presliding,
    "friction.lugre": _presliding,
    "friction.maxwell_slip": _presliding,
    "friction.": _friction,
    "flexible_mode.loose_mass": _loose_mass,
    "flexible_mode.": _mode,
    "centre_of_mass": _at("the centre of mass is off its declared place ({at})"),
    "payload": _with("m", "a load of {value} lies on the platform"),
    "inertia.": _at("the inertia of {at} changes with the position"),
    "beam_motion.gravity": _by_sign("a", "the beam weighs {how} than declared", "more", "less"),
    "beam_motion.": _at("the beam's motion pushes {at} otherwise than declared"),
    "cable_pull.": _at("a cable of the beam pulls on {at}"),
    "cogging.position": _with("pitch", "the motor of {at} cogs every {value}"),
    "cogging": _with("pitch", "the beam's motors cog every {value}"),
    "external_field": _at("a field along the beam's way pulls on {at}"),
    "rotor.weight": _at("the rotor's weight is off its axis"),
    "rotor.": _at("the rotor is out of balance"),
    "coil_gain.relative": _at("the gains of the coils differ"),
    "coil_gain": _coil_gain,
    "coil_scale": _by_sign("scale", "all coils give {how} force than declared", "more", "less"),
    "force_constant.": _at("the force of {at} changes with the position"),
    "actuator_lag": _with("lag", "the force of {at} lags by {value}"),
    "delay": _with("delay", "the force of {at} is {value} late"),
    "dead_zone": _at("{at} give{s} no force at small commands"),
    "saturation": _at("{at} give{s} less force at large commands"),
    "force_offset.drift": _at("the force of {at} drifts"),
    "thermal_drift.": _at("the force of {at} changes as it warms"),
    "sensor_gain.relative": _at("the gains of the sensors differ"),
    "sensor_gain": _reads("gain"),
    "sensor_scale": _by_sign("scale", "all sensors read too {how}", "much", "little"),
    "sensor_nonlinearity": _at("the reading of {at} is not linear"),
    "sensor_offset.constant": _offset,
    "sensor_offset.": _at("the reading of {at} drifts"),
    "sensor_crosstalk": _at("{at} read{s} a part of each other"),
    "sensor_lag": _with("lag", "the reading of {at} lags by {value}"),
    "sensor_stuck": _at("the reading of {at} sticks"),
    "arm_length.": _arm,
    "vibration.reading": _with("frequency", "the readings of {at} have a hum of {value}"),
    "vibration.": _shaking,
    "backlash.": _with("half", "{at} has a gap of twice {value}"),
    "magnetic_force": _at("the magnetic force on {at} changes with the gap"),
    "actuator.times_speed": _at("the force of {at} falls with the speed"),
    "actuator.quantised": _with("step", "the command of {at} has steps of {value}"),
    "actuator.": _at("the force of {at} is not proportional to its command"),
    "reading.lag": _with("lag", "the reading of {at} lags by {value}"),
    "reading.delay": _with("delay", "the reading of {at} is {value} late"),
    "reading.": _at("the reading of {at} is not linear"),
    "gravity.sine": _at("gravity acts on {at} as on a pendulum"),
}
"""Clause of each effect by the start of its key; the first one that fits counts."""
