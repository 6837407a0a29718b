"""Trace plants with erring sensors, crosstalk, propellers, a swinging arm and a fine cogging.

Each plant has numbers of its own, and a declared linear model that is 10 to 20 % off.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from levid.benchmarks.trace.judged_plants import (
    RECORDS,
    Named,
    Result,
    result,
    show_plants,
    traced,
)
from levid.benchmarks.trace.swinging_plants import Plant
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.subspace.response_uncertainty import SURE_95
from levid.identification.trace.force_trace.trace_imported import ForceTrace

FIRST_SEED = 70_000

ONE = """
levid: model
name: one
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
parameters: {PARAMETERS}
M: [[m1]]
D: [[d1]]
K: [[k1]]
"""
TWO = """
levid: model
name: two
dof: [{name: x, unit: m}, {name: y, unit: m}]
inputs: [{name: f, unit: N}, {name: g, unit: N}]
parameters: {PARAMETERS}
M: [[m1, 0], [0, m2]]
D: [[d1, 0], [0, d2]]
K: [[k1, 0], [0, k2]]
"""
PROPELLER = """
levid: model
name: beam
dof: [{name: x, unit: rad}]
inputs: [{name: f, unit: V}]
parameters: {PARAMETERS}
M: [[m1]]
D: [[d1]]
K: [[k1]]
B: [[b]]
"""
CART = """
levid: model
name: cart
dof: [{name: x, unit: m}, {name: arm, unit: rad}]
inputs: [{name: f, unit: N}]
parameters: {PARAMETERS}
M: [[m1, h], [h, m2]]
D: [[d1, 0], [0, d2]]
K: [[k1, 0], [0, w]]
B: [[1], [0]]
"""
MOTOR = """
levid: model
name: motor
dof: [{name: x, unit: rad}]
inputs: [{name: f, unit: N m}]
parameters: {PARAMETERS}
M: [[m1]]
D: [[d1]]
K: [[0]]
"""

SQUARE = ("actuator_nonlinearity", ("f",))


@dataclass(frozen=True)
class Kind:
    """A kind of plant: model, free parameters, effects; `also` may be named beside them.

    law: the plant's numbers by the names of the found effects' parameters, with a sign.
    """

    text: str
    names: tuple[str, ...]
    effects: frozenset[Named]
    draw: Callable[[np.random.Generator], Plant]
    law: tuple[tuple[str, str, float], ...] = ()
    also: frozenset[Named] = frozenset()


def _axes(rng: np.random.Generator, two: bool = False, **shares: float) -> Plant:
    """Return isolated axes; bends of the sensor are in shares of the reading at 0.02 m."""
    m, zeta = rng.uniform(1.0, 4.0, 2), rng.uniform(0.1, 0.3, 2)
    rate = 2 * np.pi * rng.uniform(2.0, 4.0, 2)
    size = {name: share * rng.uniform(0.6, 1.5) for name, share in shares.items()}
    # 0.01 m RMS at its stiffness.
    numbers = {"m1": m[0], "d1": 2 * zeta[0] * rate[0] * m[0], "k1": rate[0] ** 2 * m[0]}
    if two:
        numbers |= {"m2": m[1], "d2": 2 * zeta[1] * rate[1] * m[1], "k2": rate[1] ** 2 * m[1]}
    return Plant(
        **numbers,
        sizes=(0.01 * rate[0] ** 2 * m[0], 0.01 * rate[1] ** 2 * m[1]),
        bend2=rng.choice([-1.0, 1.0]) * size.get("bend2", 0.0) / 0.02,
        bend3=size.get("bend3", 0.0) / 0.02**2,
        late_s=size.get("late_s", 0.0),
        mix=rng.choice([-1.0, 1.0]) * size.get("mix", 0.0),
        cross=rng.choice([-1.0, 1.0]) * size.get("cross", 0.0),
    )


def _propeller(rng: np.random.Generator) -> Plant:
    m, rate = rng.uniform(0.03, 0.1), 2 * np.pi * rng.uniform(0.4, 0.8)
    mean = rng.uniform(1.0, 6.0)
    return Plant(
        m1=m, d1=rng.uniform(0.3, 0.8) * rate * m, k1=rate**2 * m, lag_s=rng.uniform(0.03, 0.12),
        squared=True, mean=mean, sizes=(0.2 * mean, 0.0), below_hz=2.0, Ts_s=0.01,
    )  # fmt: skip


def _cart(rng: np.random.Generator) -> Plant:
    cart, bob, length = rng.uniform(0.5, 1.5), rng.uniform(0.1, 0.4), rng.uniform(0.2, 0.5)
    return Plant(
        m1=cart + bob, d1=rng.uniform(3.0, 8.0), k1=rng.uniform(5.0, 20.0), m2=bob * length**2,
        d2=rng.uniform(0.001, 0.004), h=bob * length, w=9.81 * bob * length,
        sizes=(rng.uniform(4.0, 8.0), 0.0), below_hz=2.5,
    )  # fmt: skip


def _motor(rng: np.random.Generator) -> Plant:
    m = rng.uniform(2e-4, 8e-4)
    return Plant(
        m1=m, d1=rng.uniform(1.0, 3.0) * m, k1=0.0, cog=rng.uniform(3.0, 9.0) * m,
        pitch=2 * np.pi / rng.integers(24, 60), sizes=(15.0 * m, 0.0), below_hz=1.0, Ts_s=2e-3,
        rows=10_000, noise=1e-5,
    )  # fmt: skip


AXIS, AXES = ("m1", "d1", "k1"), ("m1", "d1", "k1", "m2", "d2", "k2")
CUBIC_OR_SINE = frozenset({("gravity", ("arm",))})
KINDS = {
    "one axis": Kind(ONE, AXIS, frozenset(), _axes),
    "cubic sensor": Kind(
        ONE, AXIS, frozenset({("sensor_nonlinearity", ("x",))}), partial(_axes, bend3=0.08),
        (("b", "bend3", 1.0),),
    ),
    "quadratic sensor": Kind(
        ONE, AXIS, frozenset({("sensor_nonlinearity", ("x",))}), partial(_axes, bend2=0.08),
        (("a", "bend2", 1.0),),
    ),
    "late sensor": Kind(
        ONE, AXIS, frozenset({("sensor_lag", ("x",))}), partial(_axes, late_s=6e-3),
        (("lag", "late_s", 1.0),),
    ),
    "two axes": Kind(TWO, AXES, frozenset(), partial(_axes, two=True)),
    "part of a reading": Kind(
        TWO, AXES, frozenset({("sensor_crosstalk", ("y", "x"))}),
        partial(_axes, two=True, mix=0.06), (("share", "mix", -1.0),),
    ),
    "part of a command": Kind(
        TWO, AXES, frozenset({("actuator_crosstalk", ("g", "f"))}),
        partial(_axes, two=True, cross=0.06), (("share", "cross", 1.0),),
    ),
    "propeller": Kind(
        PROPELLER + "lag_s: lag_s\n", ("d1", "k1", "b", "lag_s"), frozenset({SQUARE}), _propeller
    ),
    "propeller with a lag": Kind(
        PROPELLER, ("d1", "k1", "b"), frozenset({SQUARE, ("actuator_lag", ("f",))}), _propeller
    ),
    "cart and arm": Kind(
        CART, (*AXIS, "d2", "w", "h"), frozenset({("inertia", ("x", "arm"))}), _cart,
        (("h", "h", 1.0),), CUBIC_OR_SINE,
    ),
    "fine cogging": Kind(
        MOTOR, ("m1", "d1"), frozenset({("cogging", ("x",))}), _motor, (("pitch", "pitch", 1.0),)
    ),
}  # fmt: skip


def declared(kind: Kind, plant: Plant, rng: np.random.Generator) -> ModelConfig:
    """Return a linear model with its parameters 10 to 20 % off; masses that B scales are exact."""
    entries = []
    for name in dict.fromkeys((*kind.names, *[n for n in ("m1", "m2") if n in kind.text])):
        # The slope of the thrust at the working point.
        value = 2.0 * plant.mean if name == "b" else getattr(plant, name)
        off = 1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.2)
        if name in kind.names:
            bounds = f"min: 0, max: {50.0 * value:.9g}"
            entries.append(f"{name}: {{value: {off * value:.9g}, unit: '1', {bounds}}}")
        else:
            entries.append(f"{name}: {{value: {value:.9g}, unit: '1', fixed: true}}")
    return parse_text(kind.text.replace("PARAMETERS", ", ".join(entries)), ModelConfig, "model")


def judged(name: str, seed: int) -> Result:
    """Return the result of one plant."""
    kind, rng = KINDS[name], np.random.default_rng(seed)
    plant = kind.draw(rng)
    config = declared(kind, plant, rng)
    trace = traced(config, [plant.flown(RECORDS * seed + i) for i in range(RECORDS)], plant.Ts_s)
    return result(
        name, seed, trace, kind.effects, partial(intervals, trace, kind, plant), kind.also
    )


def intervals(
    trace: ForceTrace, kind: Kind, plant: Plant, effects: Sequence[Mapping[str, Any]]
) -> Iterator[bool]:
    """Yield whether each interval has the truth; a gain at a working point has none."""
    point = trace.found.point
    for value, name, se in zip(point.values, point.parameters.names, trace.errors, strict=False):
        if name != "b" and not (kind.also and name == "w"):
            yield bool(abs(value - getattr(plant, name)) <= SURE_95 * se)
    for effect in effects:
        for parameter, number, sign in kind.law:
            told = effect["parameters"].get(parameter)
            if told is not None and told["se"] is not None:
                truth = sign * getattr(plant, number)
                yield bool(abs(told["value"] - truth) <= SURE_95 * told["se"])


def main() -> None:
    """Print the figures of all plants."""
    show_plants("erring sensors, propellers, swinging arms", KINDS, judged, FIRST_SEED)


if __name__ == "__main__":
    main()
