"""Put an effect of a drawn size on a plant that is not the rig, and simulate both.

The size is what all parameters of the model leave of the effect's force, over the force of the
inputs. Effects that are not in the trace's table are marked as not listed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from levid.benchmarks.trace.imported_plant_cases import PLANTS, Plant
from levid.benchmarks.trace.imported_plant_simulation import Acting, Kind, Motion, simulated

Array = NDArray[np.float64]

SIZES = (0.03, 0.3)
"""Smallest and largest size; drawn evenly by its logarithm."""
_NEAR, _BISECTIONS = 0.2, 20
"""Largest relative error of a drawn size, and tries to find it."""


@dataclass(frozen=True)
class Law:
    """An effect: right classes, whether it is at an input, and names of its numbers in a fit.

    right: classes that a right report has; empty without an effect, and for one of which no class
    of the table is a fair name. effect, names: key of the effect in the table that has the plant's
    equation, and its parameters in the order of the numbers, for intervals. listed: whether the
    table has it.
    """

    kind: Kind
    right: tuple[str, ...]
    at_input: bool = False
    effect: str = ""
    names: tuple[str, ...] = ()
    listed: bool = True

    def truth(self, numbers: Array, ratio: float) -> dict[str, float]:
        """Return the true parameters of a fitted effect, beside an input gain that is `ratio` of
        the true one. Amplitudes of a DOF are forces; those of an input are relative to its
        force."""
        values = dict(zip(self.names, numbers.tolist(), strict=False))
        if self.names and not self.at_input:
            values[self.names[0]] *= ratio
        return values


_MAGNETS = (Kind.MAGNET, Kind.BEARING)
_ACTUATOR = "actuator_nonlinearity"
LAWS = {
    "none": Law(Kind.NONE, ()),
    "coulomb": Law(
        Kind.COULOMB, ("friction",), effect="friction.coulomb", names=("friction", "v_s")
    ),
    "stribeck": Law(Kind.STRIBECK, ("friction",)),
    "asymmetric_friction": Law(Kind.ASYMMETRIC, ("friction",)),
    "cubic_stiffness": Law(Kind.CUBIC, ("stiffness",), effect="stiffness.cubic", names=("k3",)),
    "quadratic_stiffness": Law(
        Kind.QUADRATIC, ("stiffness",), effect="stiffness.asymmetric", names=("k2",)
    ),
    "drag": Law(Kind.DRAG, ("damping",), effect="damping.quadratic", names=("d2",)),
    "gravity": Law(Kind.SINE, ("gravity",)),
    "stop": Law(Kind.STOP, ("stiffness",), effect="stiffness.one_sided", names=("k", "q0")),
    "gap": Law(Kind.GAP, ("backlash",)),
    "cogging": Law(Kind.COGGING, ("cogging",)),
    "loose_mass": Law(
        Kind.LOOSE_MASS, ("flexible_mode",), effect="flexible_mode.loose_mass",
        names=("m", "frequency", "damping"),
    ),
    "squared_actuator": Law(Kind.SQUARED, (_ACTUATOR,), True, "actuator.squared", ("a",)),
    "cubic_actuator": Law(Kind.CUBED, (_ACTUATOR,), True, "actuator.cubic", ("a",)),
    "force_with_speed": Law(Kind.WITH_SPEED, (_ACTUATOR,), True, "actuator.times_speed", ("a",)),
    "dead_zone": Law(Kind.DEAD_ZONE, ("dead_zone",), True),
    "saturation": Law(Kind.SATURATION, ("saturation",), True),
    "quantised": Law(Kind.QUANTISED, (_ACTUATOR,), True),
    "drift": Law(Kind.DRIFT, ("thermal_drift",), True, "thermal_drift.time", ("rate",)),
    "lag": Law(Kind.LAG, ("actuator_lag",), True, "actuator_lag", ("lag",)),
    "delay": Law(Kind.DELAY, ("delay",), True, "delay", ("delay",)),
    "magnet": Law(Kind.MAGNET, ("magnetic_force",), effect="magnetic_force.i2_y2.closes"),
    "uneven_friction": Law(Kind.RUBBED_UNEVENLY, ("friction",)),
    "drag_15": Law(Kind.DRAG_15, ("damping",)),
    "force_ripple": Law(Kind.RIPPLE, ("torque_ripple",), True),
    "two_gains": Law(Kind.TWO_GAINS, (_ACTUATOR,), True, "actuator.asymmetric", ("a",)),
    "creep": Law(
        Kind.CREEP, ("viscoelasticity",), effect="stiffness.viscoelastic", names=("k", "tau")
    ),
    "rate_limit": Law(Kind.SLEWED, ("rate_limit",), True),
    "second_order": Law(Kind.SECOND_ORDER, ("actuator_lag",), True),
    "thinning_grease": Law(
        Kind.THINNING, ("damping",), effect="damping.falling", names=("d", "v_0")
    ),
    "loaded_gear": Law(
        Kind.LOADED_GEAR, ("friction",), True, "actuator.load_friction", ("share", "v_s")
    ),
    "preload": Law(
        Kind.PRELOAD, ("preload",), effect="stiffness.preloaded", names=("P", "q0", "width")
    ),
    "bearing": Law(
        Kind.BEARING, ("magnetic_force",), effect="magnetic_force.differential.closes"
    ),
    "hysteresis": Law(Kind.HYSTERESIS, (_ACTUATOR,), True, "actuator.hysteresis"),
    "slow_friction": Law(
        Kind.LEVELING, ("friction",), effect="friction.leveling_off", names=("friction", "v_0")
    ),
    "soft_spring": Law(
        Kind.SOFT_SPRING, ("stiffness", "preload"), effect="stiffness.leveling_off",
        names=("P", "width"),
    ),
    "quintic": Law(Kind.QUINTIC, ("stiffness",)),
    "foam": Law(
        Kind.FOAM, ("stiffness",), effect="stiffness.exponential.up", names=("P", "d")
    ),
    "permanent_magnet": Law(
        Kind.PERMANENT_MAGNET, ("magnetic_force",)
    ),
    "cubic_damper": Law(Kind.CUBIC_DAMPER, ("damping",)),
    "shaft": Law(
        Kind.SHAFT, ("flexible_mode",), effect="flexible_mode.load",
        names=("m", "frequency", "damping", "slowing"),
    ),
    "drifting_damping": Law(
        Kind.DRIFTING_DAMPING, ("damping",), effect="damping.drift", names=("rate",)
    ),
    "drifting_stiffness": Law(
        Kind.DRIFTING_STIFFNESS, ("stiffness",), effect="stiffness.drift", names=("rate",)
    ),
    "drifting_mass": Law(
        Kind.DRIFTING_MASS, ("inertia",), effect="inertia.drift", names=("rate",)
    ),
    "warming_friction": Law(Kind.WARMING_FRICTION, ("friction",)),
    "bent_reading": Law(Kind.BENT, ("sensor_nonlinearity",)),
    "warming_grease": Law(
        Kind.WARMING_DAMPING, ("damping",), effect="damping.warming", names=("excess", "tau")
    ),
    "buffer": Law(Kind.BUFFER, ("stiffness",)),
}  # fmt: skip
"""Effects by name. A plant's seed has the number of its law in it: new ones come last."""

_ANYWHERE = (
    "none", "cubic_stiffness", "quadratic_stiffness", "drag", "stop", "loose_mass",
    "squared_actuator", "cubic_actuator", "force_with_speed", "dead_zone", "saturation",
    "quantised", "drift", "lag", "delay", "drag_15", "two_gains", "creep", "rate_limit",
    "second_order", "thinning_grease", "loaded_gear", "preload",
    "hysteresis", "soft_spring", "quintic", "foam", "permanent_magnet", "cubic_damper",
    "shaft", "drifting_damping", "drifting_stiffness", "drifting_mass", "bent_reading",
    "warming_grease", "buffer",
)  # fmt: skip
_RUBBING = ("coulomb", "stribeck", "asymmetric_friction", "uneven_friction", "slow_friction",
            "warming_friction")  # fmt: skip
_LONG = ("cogging", "force_ripple")
CASES = {
    "drive": (*_ANYWHERE, *_RUBBING, *_LONG),
    "geared": (*_ANYWHERE, *_RUBBING, *_LONG, "gap"),
    "pendulum": (*_ANYWHERE, *_RUBBING, "gravity"),
    "stage": (*_ANYWHERE, *_RUBBING),
    "levitation": (
        "none", "magnet", "squared_actuator", "drag", "drift", "lag", "quantised", "delay",
        "bearing",
    ),
    # A propeller has no gear that would see the motion at it, which is one of both DOF.
    "helicopter": tuple(law for law in (*_ANYWHERE, *_RUBBING) if law != "loaded_gear"),
}  # fmt: skip
"""Effects of each plant."""
PAIRS = {
    "drive": ("coulomb+cogging", "coulomb+saturation", "stribeck+drag", "cubic_actuator+coulomb",
              "saturation+lag", "lag+dead_zone"),
    "geared": ("coulomb+gap", "coulomb+cogging"),
    "pendulum": (
        "gravity+coulomb",
        "gravity+drag",
        "cubic_stiffness+coulomb",
        "gravity+loose_mass",
        "dead_zone+lag",
        "second_order+saturation",
    ),
    "stage": ("coulomb+squared_actuator", "cubic_stiffness+drag", "dead_zone+drag", "stop+coulomb",
              "saturation+second_order", "lag+squared_actuator"),
    "levitation": ("magnet+drag", "lag+magnet"),
    "helicopter": ("coulomb+drag", "lag+squared_actuator", "squared_actuator+coulomb"),
}  # fmt: skip
"""Pairs of effects of each plant, each drawn by itself. A command passes those of one input in
their order."""


class Drawn(NamedTuple):
    """An effect on a plant: its law, the places of a right report, its numbers as Kind has them,
    and its size."""

    law: Law
    where: tuple[str, ...]
    numbers: Array
    size: float


@dataclass(frozen=True)
class Case:
    """A plant with effects, and how it moved."""

    plant: Plant
    effects: tuple[Drawn, ...]
    motion: Motion

    @property
    def listed(self) -> tuple[Drawn, ...]:
        """The effects that a trace should name."""
        return tuple(e for e in self.effects if e.law.right and e.law.listed)


def case(plant_name: str, law_names: str, seed: int) -> Case:
    """Draw a plant, effects (names of LAWS joined by +) and their sizes, and simulate them."""
    names, all_laws = law_names.split("+"), list(LAWS)
    numbers_of_laws = [all_laws.index(name) for name in names]
    rng = np.random.default_rng([seed, list(PLANTS).index(plant_name), *numbers_of_laws])
    plant = PLANTS[plant_name](rng)
    still = np.zeros(len(plant.dof))
    noise_seed = int(rng.integers(1 << 32))
    plain = simulated(plant.linear(still), plant.v, rng)
    if plant.reach is not None:
        ratio = plant.reach / plain.q[:, 0].std()
        plant = replace(plant, v=ratio * plant.v)
        plain = simulated(plant.linear(still), plant.v, rng)
    noise = plant.noise * plain.q.std(axis=0)

    def flown(*acting: Acting) -> Motion:
        same = np.random.default_rng(noise_seed)
        return simulated(plant.linear(noise), plant.v, same, *acting)

    drawn, acting = list[Drawn](), list[Acting]()
    for name in names:
        effect, place = _drawn(plant, plain, LAWS[name], rng, flown)
        if effect is not None:
            drawn.append(effect)
            acting.append(Acting(effect.law.kind, place, effect.numbers))
    return Case(plant, tuple(drawn), flown(*acting))


def _drawn(
    plant: Plant, plain: Motion, law: Law, rng: np.random.Generator, flown: Callable[..., Motion]
) -> tuple[Drawn | None, int]:
    """Return an effect of a drawn size by itself, None for none, and its place."""
    place = int(rng.integers(len(plant.inputs) if law.at_input else len(plant.dof)))
    if "motor" in plant.dof:
        place = int(law.kind == Kind.GAP)  # all others act on the motor
    names = list(plant.inputs if law.at_input else plant.dof)
    where = (names[place],) if law.kind not in _MAGNETS else ("y", "i")
    numbers = _numbers(law.kind, plant, plain, place, rng)
    if law.kind == Kind.NONE:
        return None, place
    force = float(np.linalg.norm(_acting(plant, plain, place)))
    wanted = float(np.exp(rng.uniform(*np.log(SIZES))))

    def sized(numbers: Array) -> float:
        with np.errstate(all="ignore"):
            motion = flown(Acting(law.kind, place, numbers))
            return plant.unexplained(motion) / force if np.all(np.isfinite(motion.y)) else np.inf

    size = sized(numbers)
    if law.kind == Kind.BEARING and not np.isfinite(size):
        # It ran into a magnet: the narrowest gap of these, at the same stiffness, in which it does
        # not. In twice the largest one it hardly is nonlinear.
        wider = (share * numbers for share in np.linspace(1.0, 2.0, _BISECTIONS))
        numbers, size = next((n, found) for n in wider if np.isfinite(found := sized(n)))
    if law.kind not in (Kind.SINE, Kind.BENT, *_MAGNETS):
        numbers, size = _with_size(sized, wanted, numbers, _most(law.kind, plant, plain, place))
    return Drawn(law, where, numbers, size), place


def _with_size(
    sized: Callable[[Array], float], wanted: float, numbers: Array, most: float
) -> tuple[Array, float]:
    """Return the numbers of which the first one gives the wanted size, and the size: by bisection;
    less where the largest number gives less, or a larger one lets the plant run away."""
    low, high = 0.0, np.inf
    best = (np.inf, numbers, 0.0)
    number = min(float(numbers[0]), most)
    for _ in range(_BISECTIONS):
        tried = np.concatenate([[number], numbers[1:]])
        size = sized(tried)
        if np.isfinite(size):
            best = min(best, (abs(np.log(max(size, 1e-12) / wanted)), tried, size), key=_first)
        if best[0] < _NEAR or (size < wanted and number == most):
            break
        low, high = (number, high) if size < wanted else (low, number)
        number = 0.2 * high if low == 0.0 else min(5.0 * low, np.sqrt(low * min(high, 25.0 * low)))
        number = min(number, most)
    return best[1], best[2]


def _first(tried: tuple[float, Array, float]) -> float:
    return tried[0]


def _numbers(
    kind: Kind, plant: Plant, plain: Motion, place: int, rng: np.random.Generator
) -> Array:
    """Return start values of an effect's numbers, sized by the motion without it."""
    dof = min(place, plain.q.shape[1] - 1)
    q, w, u = plain.q[:, dof].std(), plain.w[:, dof].std(), _command(plain, place).std()
    tenth = 0.1 * _acting(plant, plain, place).std()
    v, pitch = w * rng.uniform(0.005, 0.03), 4.0 * q / rng.uniform(3.0, 12.0)
    peak, share, phase = rng.uniform(0.3, 0.8), rng.uniform(0.1, 0.4), rng.uniform(0.0, 2 * np.pi)
    often = rng.uniform(0.5, 0.8)
    stop, below = np.quantile(plain.q[:, dof], [often, 1.0 - often])
    seconds, middle = len(plain.u) * plant.Ts_s, _middle_hz(plant, plain, dof)
    value = {name: number for name, (number, _) in plant.parameters.items()}
    mass = value[next(iter(value))]
    gap = q * (7.0 + 10.0 * share)
    b, k, weight = plant.gain.max(), value.get("k", 1.0), 9.81 * mass
    start = {
        Kind.COULOMB: (tenth, v),
        Kind.STRIBECK: (tenth, w * rng.uniform(0.05, 0.2), peak),
        Kind.ASYMMETRIC: (tenth, v, share),
        Kind.RUBBED_UNEVENLY: (tenth, v, peak, q / rng.uniform(1.0, 3.0)),
        Kind.CUBIC: (tenth / q**3,),
        Kind.QUADRATIC: (tenth / q**2,),
        Kind.DRAG: (tenth / w**2,),
        Kind.DRAG_15: (tenth / w**1.5,),
        Kind.SINE: (k,),
        Kind.STOP: (3.0 * tenth / q, stop),
        Kind.GAP: (0.1 * q, value.get("k_c", 0.0)),
        Kind.COGGING: (tenth, pitch, phase),
        Kind.RIPPLE: (0.1, pitch),
        Kind.LOOSE_MASS: (
            0.05 * mass, middle * rng.uniform(0.5, 1.2), rng.uniform(0.01, 0.05)
        ),
        Kind.MAGNET: (weight, 2.0 * weight / b, -2.0 * weight / k),
        Kind.BEARING: (-k * gap, -k * gap / b, gap),
        Kind.PRELOAD: (tenth, 0.5 * stop, 0.1 * share * q),
        Kind.SQUARED: (0.1 / u,),
        Kind.CUBED: (0.03 / u**2,),
        Kind.WITH_SPEED: (0.1 / w,),
        Kind.DEAD_ZONE: (0.1 * u,),
        Kind.SATURATION: (0.6 / u,),
        Kind.QUANTISED: (0.3 * u,),
        Kind.DRIFT: (0.3 / seconds,),
        Kind.LAG: (2.0 * plant.Ts_s,),
        Kind.TWO_GAINS: (0.1,),
        Kind.CREEP: (tenth / q, 1.0 / (2.0 * np.pi * middle) * 6.0 * peak**2),
        Kind.SLEWED: (0.3 / (2.0 * np.pi * middle * u),),
        Kind.SECOND_ORDER: (plant.Ts_s, 0.2 + 2.0 * share),
        Kind.DELAY: (0.5 * plant.Ts_s,),
        Kind.THINNING: (3.0 * tenth / w, w * (0.1 + share)),
        Kind.LOADED_GEAR: (0.1, v),
        Kind.LEVELING: (tenth, 0.2 * w * share),
        Kind.SOFT_SPRING: (tenth, q * (0.5 + 2.0 * share)),
        Kind.QUINTIC: (tenth / q**5,),
        Kind.FOAM: (tenth, q * (0.7 + 2.0 * share)),
        Kind.PERMANENT_MAGNET: (-tenth, q * (5.0 + 5.0 * share)),
        Kind.CUBIC_DAMPER: (tenth / w**3,),
        Kind.HYSTERESIS: (0.2, (0.1 + share) * u),
        # Of the numbers drawn above: more draws would change all plants that were drawn before.
        Kind.SHAFT: (
            0.2 * mass, middle * (0.3 + 2.0 * share), 0.1 * share, 2.0 * middle * peak**2
        ),
        Kind.DRIFTING_DAMPING: (tenth / w / seconds,),
        Kind.DRIFTING_STIFFNESS: (tenth / q / seconds,),
        Kind.DRIFTING_MASS: (0.3 * mass / seconds,),
        Kind.WARMING_FRICTION: (tenth, v, 4.0 * share, seconds * peak**2),
        Kind.WARMING_DAMPING: (tenth / w, seconds * peak**2),
        Kind.BUFFER: (
            3.0 * tenth / q, stop if share > 0.25 else below, 0.5 * peak / (2.0 * np.pi * middle),
            np.sign(share - 0.25),
        ),
        Kind.BENT: (np.sign(share - 0.25) * (0.01 + 0.3 * abs(share - 0.25)) / q,),
    }  # fmt: skip
    return np.array(start.get(kind, (0.0,)))


def _most(kind: Kind, plant: Plant, plain: Motion, place: int) -> float:
    """Return the largest size of an effect that stays what it is."""
    u, dof = _command(plain, place).std(), min(place, plain.q.shape[1] - 1)
    seconds = len(plain.u) * plant.Ts_s
    damping = float(_acting(plant, plain, place).std() / plain.w[:, dof].std())
    return {
        Kind.GAP: plain.q[:, dof].std(), Kind.DELAY: plant.Ts_s,
        Kind.QUANTISED: 1.5 * u, Kind.DEAD_ZONE: u, Kind.SATURATION: 1.2 / u,
        Kind.DRIFT: 0.8 / seconds, Kind.LAG: 30.0 * plant.Ts_s, Kind.RIPPLE: 0.8,
        Kind.TWO_GAINS: 0.5, Kind.LOADED_GEAR: 0.6, Kind.SECOND_ORDER: 10.0 * plant.Ts_s,
        Kind.THINNING: damping, Kind.HYSTERESIS: 0.8,
        Kind.SLEWED: 1.0 / (np.pi * _middle_hz(plant, plain, dof) * u),
    }.get(kind, np.inf)  # fmt: skip


def _middle_hz(plant: Plant, plain: Motion, dof: int) -> float:
    """Return the mean frequency of a DOF's acceleration, by its power."""
    spectrum = np.abs(np.fft.rfft(plain.a[:, dof]))[1:] ** 2
    cycles = np.arange(1, len(spectrum) + 1)
    return float(cycles @ spectrum / spectrum.sum() / (len(plain.u) * plant.Ts_s))


def _command(plain: Motion, place: int) -> Array:
    """Return the command of a place (N,), the last one if there are fewer inputs than DOF."""
    return plain.u[:, min(place, plain.u.shape[1] - 1)]


def _acting(plant: Plant, plain: Motion, place: int) -> Array:
    """Return the force of the inputs (N,) at the DOF of a place, or at one that they drive."""
    forces = plain.u @ plant.gain.T
    driven = np.flatnonzero(forces.any(axis=0))
    return np.asarray(forces[:, place if place in driven else driven[-1]])
