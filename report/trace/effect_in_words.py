"""Describe an effect in a clause that anyone understands: 'coil 6 gives 2 % less force'."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ...config.model import EffectParameter
from ...identification.subspace.response_uncertainty import SURE_95
from ...identification.value_with_interval import in_full
from ...model.effects.base import Effect, in_words
from ..plotting.labelled_frequency_responses import symbol
from ..plotting.number_format import to_interval, unit_text
from ..plotting.style import engineering

Parameters = Mapping[str, EffectParameter]

_FEW = 0.5
"""Share of a reading above which a factor is easier to read than per cent."""


def effect_in_words(effect: Effect, parameters: Parameters) -> str:
    """Return what an effect does as a clause without capital and full stop.

    Numbers have the digits that their 95 % intervals support. Effects without their own clause,
    such as free forms, have their name.
    """
    words = _Words(effect, parameters)
    for start, text in _CLAUSES.items():
        if effect.key.startswith(start):
            if start == "coil_gain" and parameters["gain"].value < -1.0:
                return f"the force of {words['at']} has the wrong sign"
            if start == "reading.gain" and abs(parameters["error"].value) > _FEW:
                return f"the reading of {words['at']} is {_times(parameters['error'])} the position"
            if start == "friction.along_position" and _no_period(effect, parameters):
                return f"the dry friction of {words['at']} changes along the position"
            return text.format_map(words)
    return effect.name


def _times(error: EffectParameter) -> str:
    """Return the reading over the position, as '57.30 times', from the error of a gain."""
    part = 1.0 - error.value
    half = 0.0 if error.se is None else SURE_95 * error.se
    minus = "" if part > 0.0 else "minus "
    return f"{minus}{_digits(abs(1.0 / part), half / part**2)} times"


def _no_period(effect: Effect, parameters: Parameters) -> bool:
    """Return whether the pitch of a force is the longest that the records were searched for."""
    (longest,) = (q.high for q in effect.shape if q.name == "pitch")
    return parameters["pitch"].value >= longest


def place_in_words(where: Sequence[str]) -> str:
    """Return locations as a reader names them: 'coil 6', 'θ', 'the beam', 'sensors 0 to 8'."""
    if " to " in (names := in_words(where)):
        return names
    named = ["the " + w if w in ("beam", "rotor") else symbol(w).replace(":", " ") for w in where]
    return " and ".join([", ".join(named[:-1]), named[-1]]) if len(named) > 1 else named[0]


@dataclass(frozen=True)
class _Words:
    """Give the fields of a clause: {at} all places, {first} and {second} one of them, {actuator}
    the same as {at} of one that a user named, {s} the verb's s, others a parameter."""

    effect: Effect
    parameters: Parameters

    def __getitem__(self, field: str) -> str | _Parameter:
        if field == "at":
            return place_in_words(self.effect.where)
        if field in ("first", "second"):
            k = int(field == "second")
            return place_in_words(self.effect.where[k : k + 1])
        if field == "actuator":
            ours = self.effect.where[0].startswith("coil:")
            return ("" if ours else "the actuator ") + place_in_words(self.effect.where)
        if field == "s":
            return "s" if len(self.effect.where) == 1 else ""
        return _Parameter(self.parameters.get(field))


@dataclass(frozen=True)
class _Parameter:
    """Format a parameter: {k} is its size, {k:%} in percent, {k:double} twice that, {k:signed} has
    its sign, {k:more|less} is a word by it."""

    found: EffectParameter | None

    def __format__(self, spec: str) -> str:
        positive, bar, negative = spec.partition("|")
        if bar:
            return positive if self.found is None or self.found.value >= 0.0 else negative
        assert self.found is not None
        size, own = abs(self.found.value), self.found.unit
        factor, unit = 100.0, "%"
        if spec != "%":
            compound = "/" in own or " " in own
            factor, prefix = (1.0, "") if compound else engineering(size, own)
            unit = prefix + unit_text(own)
        if spec == "double":
            factor *= 2.0
        half = 0.0 if self.found.se is None else SURE_95 * self.found.se
        minus = "-" if spec == "signed" and self.found.value < 0.0 else ""
        return f"{minus}{_digits(factor * size, factor * half)} {unit}".strip()


def _digits(size: float, half: float) -> str:
    """Return a positive number to the first digit of half its interval, to three without one."""
    if not half > 0.0 or half >= size:
        return in_full(size, 2 if half >= size > 0.0 else 3)
    return to_interval(size, half, digits=1)


_CLAUSES = {
    "rod_stiffness.cubic": "the rods {k3:harden|soften} with travel in {at} (by {k3})",
    "rod_stiffness.asymmetric": "the rods are stiffer to one side in {at}",
    "rod_stiffness.one_sided": "a contact adds stiffness to one side of {at}",
    "rod_stiffness.corners": "the rods {k3:harden|soften} at the corners",
    "stiffness.cubic": "the spring of {at} {k3:hardens|softens} with travel (by {k3})",
    "stiffness.asymmetric": "the spring of {at} is stiffer to one side",
    "stiffness.viscoelastic.another": "the spring of {at} also creeps within {tau}",
    "stiffness.viscoelastic": "the spring of {at} creeps, within {tau}",
    "stiffness.preloaded": "a preloaded spring holds {at} in one place (with {P})",
    "stiffness.power": "the force of the spring of {at} is the deflection to the power {p}",
    "stiffness.exponential": "the spring of {at} hardens exponentially, within {d}",
    "stiffness.snap_through": "the spring of {at} snaps through within {width}",
    "stiffness.leveling_off": "the spring of {at} levels off within {width}",
    "stiffness.stop.above": "a stop limits {at} above {q0:signed}",
    "stiffness.stop.below": "a stop limits {at} below {q0:signed}",
    "stiffness.one_sided.below": "a contact adds stiffness to {at} below {q0:signed}",
    "stiffness.one_sided": "a contact adds stiffness to {at} above {q0:signed}",
    "air_damping.linear": "the damping of {at} is {d:higher|lower} than declared",
    "air_damping.across": "damping couples {at}",
    "damping.across": "damping couples {at}",
    "air_damping.drag": "drag that grows with the speed squared acts on the platform",
    "air_damping.squeeze_film": "the air film below the platform changes the damping",
    "air_damping.quadratic": "drag that grows with the speed squared acts on {at}",
    "damping.quadratic": "drag that grows with the speed squared acts on {at}",
    "damping.one_sided": "the damping of {at} changes with the position",
    "damping.outward": "the damping of {at} changes with the position squared",
    "damping.power": "a damping with the speed to the power {p} acts on {at}",
    "damping.root": "a damping with the speed to the power {p} acts on {at}",
    "damping.falling": "the damping of {at} falls with the speed",
    "damping.eddy_current": "the drag of eddy currents acts on {at}",
    "damping.drift": "the damping of {at} changes over the session",
    "stiffness.drift": "the stiffness of {at} changes over the session",
    "inertia.drift": "the mass of {at} changes over the session",
    "damping.warming": "the damping of {at} changes as it warms",
    "friction.warming": "the dry friction of {at} changes as it warms",
    "damping.asymmetric": "the damping of {at} differs between the two directions",
    "friction.beam_chain": "the beam's cable chain drags on {at}",
    "friction.bearing": "the beam's bearing has friction",
    "backlash.bearing": "the beam has play in its bearings",
    "friction.beam_tilt": "the friction of the beam depends on the tilt",
    "friction.beam_presliding": "friction with an elastic start acts on {at}",
    "friction.dahl": "friction with an elastic start acts on {at}",
    "friction.bouc_wen": "friction with an elastic start acts on {at}",
    "friction.lugre": "friction with an elastic start acts on {at}",
    "friction.maxwell_slip": "friction with an elastic start acts on {at}",
    "friction.along_position": "dry friction on {at} varies along the position, every {pitch}",
    "friction.leveling_off": "dry friction of {friction}, which levels off slowly, acts on {at}",
    "friction.stribeck": "dry friction of {friction}, at rest {peak} more, acts on {at}",
    "friction.": "dry friction of {friction} acts on {at}",
    "flexible_mode.loose_mass.another": "another mass on a spring vibrates at {frequency} on {at}",
    "flexible_mode.loose_mass": "a mass on a spring vibrates at {frequency} on {at}",
    "flexible_mode.load": "a load on a soft shaft vibrates at {frequency} on {at}",
    "flexible_mode.": "a part of the platform vibrates at {frequency}",
    "centre_of_mass": "the centre of mass is off its declared place ({at})",
    "payload": "a load of {m} lies on the platform",
    "inertia.swinging": "an arm that swings couples {at}",
    "inertia.jointed": "the inertia of an arm of two links changes as it bends ({at})",
    "inertia.two_links": "the coupling of two links changes as they bend ({at})",
    "inertia.tilting": "the inertia of a rotating arm changes as it tilts ({at})",
    "inertia.extending": "the inertia of a rotating arm changes as it extends ({at})",
    "inertia.": "the inertia of {at} changes with the position",
    "beam_motion.gravity": "the beam weighs {a:more|less} than declared",
    "beam_motion.": "the beam's motion pushes {at} otherwise than declared",
    "cable_pull.": "a cable of the beam pulls on {at}",
    "torque_ripple": "the force of {at} ripples over the position, every {pitch}",
    "cogging.position.another": "the motor of {at} has a second cogging, every {pitch}",
    "cogging.position": "the motor of {at} cogs every {pitch}",
    "cogging": "the beam's motors cog every {pitch}",
    "external_field": "a field along the beam's way pulls on {at}",
    "rotor.weight": "the rotor's weight is off its axis",
    "rotor.": "the rotor is out of balance",
    "coil_gain.relative": "the gains of the coils differ",
    "coil_gain": "{at} give{s} {gain:%} {gain:more|less} force than commanded",
    "coil_scale": "all coils give {scale:more|less} force than declared",
    "force_constant.": "the force of {at} changes with the position",
    "actuator_lag.second_order": "the force of {at} follows with a second-order lag ({frequency})",
    "actuator_lag": "the force of {at} lags by {lag}",
    "delay": "the force of {at} is {delay} late",
    "rate_limit": "the force of {at} follows by at most {rate}",
    "dead_zone": "{actuator} give{s} no force at small commands",
    "saturation": "{actuator} give{s} less force at large commands",
    "force_offset.drift": "the force of {at} drifts",
    "thermal_drift.time": "the force of {at} changes over the session",
    "thermal_drift.": "the force of {at} changes as it warms",
    "sensor_gain.relative": "the gains of the sensors differ",
    "sensor_gain": "{at} read{s} {gain:%} {gain:too much|too little}",
    "sensor_scale": "all sensors read too {scale:much|little}",
    "sensor_nonlinearity": "the reading of {at} is not linear",
    "sensor_offset.constant": "{at} read{s} {offset} too {offset:high|low}",
    "sensor_offset.": "the reading of {at} drifts",
    "sensor_crosstalk": "{first} reads {share:%} of {second} too",
    "sensor_lag": "the reading of {at} lags by {lag}",
    "sensor_stuck": "the reading of {at} sticks",
    "arm_length.": "the arm lengths are {arm:%} {arm:longer|shorter} than declared",
    "vibration.reading": "the readings of {at} have a hum of {frequency}",
    "vibration.": "a vibration of {frequency} acts on {at}",
    "backlash.load": "{at} moves a load behind a gap of {half:double}",
    "backlash.": "a gap of {half:double} is at {at}",
    "permanent_magnet": "the force of a permanent magnet acts on {at}, over a gap of {y0}",
    "magnetic_force": "the magnetic force on {at} changes with the gap",
    "actuator.crosstalk": "a part of one command acts at the other input ({at})",
    "actuator.asymmetric": "the gain of {at} differs between the two directions",
    "actuator.load_friction": "the gear of {at} rubs in proportion to its load",
    "actuator.times_speed": "the force of {at} falls with the speed",
    "actuator.quantised": "the command of {at} has steps of {step}",
    "actuator.squared_after_lag": (
        "a part of the force of {at} is the square of what its lag leaves"
    ),
    "actuator.quadratic_after_lag": (
        "a part of the force of {at} is the square of what its lag leaves"
    ),
    "actuator.square": "the force of {at} is the square of its command",
    "actuator.squared": "a part of the force of {at} is the square of its command",
    "actuator.quadratic": "a part of the force of {at} is the square of its command",
    "actuator.root": "a part of the force of {at} is as the root of its command",
    "actuator.cubic": "a part of the force of {at} is the cube of its command",
    "actuator.hysteresis": "the force of {at} depends on where its command came from (hysteresis)",
    "actuator.": "the force of {at} is not proportional to its command",
    "reading.gain.all": "the readings of {at} are too {error:large|small}, by {error:%} of them",
    "reading.gain": "the reading of {at} is too {error:large|small}, by {error:%} of it",
    "reading.eccentric": "the encoder of {at} is eccentric",
    "reading.periodic": "the encoder of {at} has an error in each line of its scale, every {pitch}",
    "reading.lag": "the reading of {at} lags by {lag}",
    "reading.delay": "the reading of {at} is {delay} late",
    "reading.crosstalk": "one reading has a part of the other ({at})",
    "reading.": "the reading of {at} is not linear",
    "linear.inertia_across": "inertia couples {at}, as a centre of mass off its place does",
    "linear.inertia": "the inertia of {at} is not as declared",
    "linear.damping": "the damping of {at} is not as declared",
    "linear.stiffness_across": "a stiffness couples {at}",
    "linear.stiffness": "the stiffness of {at} is not as declared",
    "linear.gyroscopic": "a gyroscopic force couples {at}",
    "linear.input": "the lever of an input is not as declared ({at})",
    "gravity.sine_for_stiffness": "gravity acts on {at} as on a pendulum, not as its stiffness",
    "gravity.sine": "gravity acts on {at} as on a pendulum",
}
"""Clause of each effect by the start of its key; the first one that fits counts.

The fields are those of _Words."""
