"""Test the inertia of arms against Lagrange: a pendulum on a cart, two links, rotating arms."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from effect_test_helpers import rig_places
from numpy.typing import NDArray

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.trace.records.record_from_log import imported_places
from levid.model.effects.base import Placed, Places, Signals
from levid.model.effects.candidate_effects import all_effects

Array = NDArray[np.float64]
Energy = Callable[[float, float, float, float], float]

MODEL = """
levid: model
name: cart
dof: [{name: x, unit: m}, {name: arm, unit: rad}]
inputs: [{name: f, unit: N}]
M: [[2.0, 0.3], [0.3, 0.1]]
D: [[1.0, 0.0], [0.0, 1.0]]
K: [[1.0, 0.0], [0.0, 1.0]]
B: [[1.0], [0.0]]
"""


def moving(places: Places, seed: int, rows: int) -> Signals:
    """Return random positions, speeds and accelerations of two DOF, with one input at rest."""
    rng = np.random.default_rng(seed)
    q, qd, qdd = (rng.standard_normal((rows, 2)) for _ in range(3))
    none = tuple(np.zeros(rows) for _ in range(6))
    t = np.arange(rows) * 1e-2
    return Signals(1e-2, t, q, qd, qdd, np.zeros((rows, 1)), *none, 0, places)


def test_force_is_what_the_declared_coupling_lacks() -> None:
    places = imported_places(parse_text(MODEL, ModelConfig, "cart"))
    s = moving(places, 1, 500)
    q, qd, qdd = s.q, s.qd, s.qdd
    (effect,) = (e for e in all_effects(places) if e.key == "inertia.swinging")
    assert effect.where == ("x", "arm")
    assert effect.amplitudes[0].unit == "N s^2"
    h = 0.3
    force = Placed(effect, (), (h,)).term(s).force
    # Of L = h x' q' cos q: d/dt dL/dx' and d/dt dL/dq' - dL/dq.
    angle = q[:, 1]
    on_cart = h * np.cos(angle) * qdd[:, 1] - h * np.sin(angle) * qd[:, 1] ** 2
    on_arm = h * np.cos(angle) * qdd[:, 0]
    np.testing.assert_allclose(h * qdd[:, 1] - force[:, 0], on_cart)
    np.testing.assert_allclose(h * qdd[:, 0] - force[:, 1], on_arm)
    assert not [e for e in all_effects(rig_places()) if e.key == "inertia.swinging"]


ARM = MODEL.replace("name: x, unit: m}", "name: x, unit: rad}").replace(
    "f, unit: N}", "f, unit: N m}"
)


@pytest.mark.parametrize("key", ["inertia.jointed", "inertia.two_links"])
def test_two_links_have_the_force_of_their_lagrangian(key: str) -> None:
    """The kinetic energy of the coupling is that of bent links, at every pose and motion."""
    places = imported_places(parse_text(ARM, ModelConfig, "arm"))
    s = moving(places, 2, 50)
    effect = next(e for e in all_effects(places) if e.key == key)
    assert effect.where == ("x", "arm")
    size, bent = 0.3, 0.4  # h, and the angle at which both DOF are zero
    found = Placed(effect, (), (size * np.cos(bent), size * np.sin(bent))).term(s).force

    def energy(x: float, a: float, v: float, w: float) -> float:
        if key == "inertia.jointed":
            return float(size * np.cos(a + bent) * (v * v + v * w))
        return float(size * np.cos(a - x + bent) * v * w)

    declared = energy_force(lambda x, a, v, w: energy(0.0, 0.0, v, w), s.q, s.qd, s.qdd)
    np.testing.assert_allclose(
        found, declared - energy_force(energy, s.q, s.qd, s.qdd), atol=1e-4 * np.abs(found).max()
    )


def energy_force(energy: Energy, q: Array, qd: Array, qdd: Array) -> Array:
    """Return d/dt dT/dq' - dT/dq (N, 2) by differences along a short motion."""
    h, t = 1e-4, 1e-3

    def slope(point: Array, k: int) -> float:
        step = np.zeros(4)
        step[k] = h
        return (energy(*(point + step)) - energy(*(point - step))) / (2.0 * h)

    found = np.zeros_like(q)
    for row in range(len(q)):
        now = np.concatenate([q[row], qd[row]])
        way = np.concatenate([qd[row], qdd[row]])
        bend = np.concatenate([0.5 * qdd[row], np.zeros(2)])
        later, before = (now + x * way + x * x * bend for x in (t, -t))
        for i in range(2):
            found[row, i] = (slope(later, 2 + i) - slope(before, 2 + i)) / (2 * t) - slope(now, i)
    return found


@pytest.mark.parametrize("key", ["inertia.tilting", "inertia.extending"])
def test_a_rotating_arm_has_the_force_of_its_lagrangian(key: str) -> None:
    """A Furuta pendulum and a polar arm, at every pose and motion."""
    tilts = key == "inertia.tilting"
    text = ARM if tilts else ARM.replace("name: arm, unit: rad}", "name: arm, unit: m}")
    places = imported_places(parse_text(text, ModelConfig, "arm"))
    s = moving(places, 3, 50)
    effect = next(e for e in all_effects(places) if e.key == key)
    assert effect.where == ("x", "arm")
    size, at_zero = 0.3, 0.4  # and the angle, or the length, where the DOF are zero
    numbers = size * (np.array([np.cos(0.8), np.sin(0.8)]) if tilts else np.array([1.0, 0.8]))
    found = Placed(effect, (), tuple(numbers)).term(s).force

    def energy(_x: float, a: float, v: float, _w: float) -> float:
        arm = np.sin(a + at_zero) if tilts else a + at_zero
        return float(0.5 * size * arm**2 * v * v)

    declared = energy_force(lambda _x, _a, v, _w: energy(0.0, 0.0, v, 0.0), s.q, s.qd, s.qdd)
    np.testing.assert_allclose(
        found, declared - energy_force(energy, s.q, s.qd, s.qdd), atol=1e-4 * np.abs(found).max()
    )
