"""Trace a stage in point-to-point moves and a shaft with a gap: names, intervals, missing force.

Each plant has numbers of its own, and a declared linear model that is 10 to 20 % off.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
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
from levid.benchmarks.trace.sticking_plants import TS, Array, Shaft, Stage
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.subspace.response_uncertainty import SURE_95
from levid.identification.trace.force_trace.trace_imported import ForceTrace

FIRST_SEED = 50_000

STAGE = """
levid: model
name: stage
dof: [{name: x, unit: m}]
inputs: [{name: i, unit: A}]
parameters:
  m: {value: M_, unit: kg, fixed: true}
  d: {value: D_, unit: N s/m, min: 0, max: 500}
  kf: {value: KF_, unit: N/A, min: 1, max: 500}
M: [[m]]
D: [[d]]
K: [[0]]
B: [[kf]]
"""
SHAFT = """
levid: model
name: shaft
dof: [{name: q1, unit: rad}, {name: q2, unit: rad}]
inputs: [{name: t, unit: N m}]
parameters:
  j1: {value: J1_, unit: kg m^2, min: 1.0e-5, max: 0.1}
  j2: {value: J2_, unit: kg m^2, min: 1.0e-5, max: 0.1}
  d1: {value: D1_, unit: N m s/rad, min: 0, max: 1}
  k: {value: K_, unit: N m/rad, min: 0.01, max: 1000}
  c: {value: C_, unit: N m s/rad, min: 0, max: 1}
M: [[j1, 0], [0, j2]]
D: [[d1 + c, -c], [-c, c]]
K: [[k, -k], [-k, k]]
B: [[1], [0]]
"""
MOTOR = """
levid: model
name: motor
dof: [{name: q1, unit: rad}]
inputs: [{name: t, unit: N m}]
parameters:
  j1: {value: J1_, unit: kg m^2, min: 1.0e-5, max: 0.1}
  d1: {value: D1_, unit: N m s/rad, min: 0, max: 1}
M: [[j1]]
D: [[d1]]
K: [[0]]
"""

FRICTION, COGGING, DRAG = ("friction", ("x",)), ("cogging", ("x",)), ("damping", ("x",))
GAP, CUBIC = ("backlash", ("q1 - q2",)), ("stiffness", ("q1 - q2",))
SOFT = ("flexible_mode", ("q1",))
UNSEEN_GAP = ("backlash", ("q1",))


@dataclass(frozen=True)
class Kind:
    """A kind of plant: its declared model, its effects, and how its numbers are drawn.

    law: the names of the plant's numbers by those of its law. outputs: how many are measured.
    """

    text: str
    effects: frozenset[Named]
    draw: Callable[[np.random.Generator], Stage | Shaft]
    law: Mapping[str, str]
    outputs: int = 1


def _stage(rng: np.random.Generator, **shares: float) -> Stage:
    """Return a stage; effects in shares of a usual force of 10 N at 0.2 m/s."""
    m = rng.uniform(1.0, 5.0)
    size = {name: share * rng.uniform(0.7, 1.4) for name, share in shares.items()}
    return Stage(
        m=m,
        d=rng.uniform(4.0, 6.0) * m,
        kf=rng.uniform(15.0, 60.0),
        friction=size.get("friction", 0.0) * m,
        peak=size.get("peak", 0.0) * m,
        v_s=rng.uniform(0.008, 0.02),
        cogging=size.get("cogging", 0.0) * m,
        pitch=rng.uniform(0.02, 0.04),
        drag=size.get("drag", 0.0) * m,
    )


def _shaft(
    rng: np.random.Generator, half: float = 0.0, k3: float = 0.0, damped: float = 1.0
) -> Shaft:
    j1 = rng.uniform(6e-4, 1.2e-3)
    return Shaft(
        j1=j1,
        j2=j1 * rng.uniform(0.8, 1.6),
        d1=rng.uniform(1.5e-3, 3e-3),
        k=rng.uniform(12.0, 30.0),
        c=damped * rng.uniform(0.008, 0.016),
        half=half * rng.uniform(0.7, 1.4),
        k3=k3 * rng.uniform(0.7, 1.4),
    )


KINDS = {
    "stage": Kind(STAGE, frozenset(), _stage, {}),
    "friction": Kind(
        STAGE, frozenset({FRICTION}), partial(_stage, friction=0.8), {"friction": "friction"}
    ),
    "stribeck": Kind(STAGE, frozenset({FRICTION}), partial(_stage, friction=0.6, peak=0.3), {}),
    "cogging": Kind(STAGE, frozenset({COGGING}), partial(_stage, cogging=0.6), {"pitch": "pitch"}),
    "friction, cogging": Kind(
        STAGE,
        frozenset({FRICTION, COGGING}),
        partial(_stage, friction=0.7, cogging=0.5),
        {"friction": "friction", "pitch": "pitch"},
    ),
    "drag": Kind(STAGE, frozenset({DRAG}), partial(_stage, drag=8.0), {"d2": "drag"}),
    "shaft": Kind(SHAFT, frozenset(), _shaft, {}, 2),
    "gap": Kind(SHAFT, frozenset({GAP}), partial(_shaft, half=5e-3), {"half": "half"}, 2),
    "cubic shaft": Kind(SHAFT, frozenset({CUBIC}), partial(_shaft, k3=3e3), {"k3": "k3"}, 2),
    "motor of a soft shaft": Kind(MOTOR, frozenset({SOFT}), _shaft, {}),
    "motor of a shaft with a gap": Kind(
        MOTOR,
        frozenset({UNSEEN_GAP}),
        partial(_shaft, half=3e-3, damped=4.0),
        {"half": "half", "m": "j2"},
    ),
}


def flights(kind: Kind, plant: Stage | Shaft, seed: int) -> list[tuple[Array, Array]]:
    """Return inputs and outputs of the records of a plant."""
    flown = [plant.flown(RECORDS * seed + i) for i in range(RECORDS)]
    return [(u, y[:, : kind.outputs]) for u, y in flown]


def declared(kind: Kind, plant: Stage | Shaft, rng: np.random.Generator) -> ModelConfig:
    """Return a linear model with free parameters 10 to 20 % off."""
    text = kind.text
    for field in fields(plant):
        value = getattr(plant, field.name)
        off = 1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.2)
        exact = f"{field.name.upper()}_, unit: kg, fixed"
        text = text.replace(exact, exact.replace(f"{field.name.upper()}_", f"{value:.9g}"))
        text = text.replace(f"{field.name.upper()}_,", f"{off * value:.9g},")
    return parse_text(text, ModelConfig, "model")


def judged(name: str, seed: int) -> Result:
    """Return the result of one plant."""
    kind, rng = KINDS[name], np.random.default_rng(seed)
    plant = kind.draw(rng)
    trace = traced(declared(kind, plant, rng), flights(kind, plant, seed), TS)
    return result(name, seed, trace, kind.effects, partial(intervals, trace, kind, plant))


def intervals(
    trace: ForceTrace, kind: Kind, plant: Stage | Shaft, effects: Sequence[Mapping[str, Any]]
) -> Iterator[bool]:
    """Yield whether each interval has the truth.

    A gap takes the place of spring and damper of the shaft, and a load behind a soft shaft has no
    parameter in the model of the motor: these are left out.
    """
    point = trace.found.point
    errors = trace.errors
    for value, name, se in zip(point.values, point.parameters.names, errors, strict=False):
        if name in {"k", "c"} and kind.effects == {GAP}:
            continue
        yield bool(abs(value - getattr(plant, name)) <= SURE_95 * se)
    for effect in effects:
        for name, told in effect["parameters"].items():
            if name in kind.law and told["se"] is not None:
                truth = getattr(plant, kind.law[name])
                yield bool(abs(told["value"] - truth) <= SURE_95 * told["se"])


def main() -> None:
    """Print the figures of all plants."""
    show_plants("moves that end at rest, and shafts", KINDS, judged, FIRST_SEED)


if __name__ == "__main__":
    main()
