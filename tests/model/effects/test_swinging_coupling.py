"""Test the coupling with a swinging arm against Lagrange's equations of a pendulum on a cart."""

from __future__ import annotations

import numpy as np
from effect_test_helpers import rig_places

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.trace.records.record_from_log import imported_places
from levid.model.effects.base import Placed, Signals
from levid.model.effects.candidate_effects import all_effects

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


def test_force_is_what_the_declared_coupling_lacks() -> None:
    places = imported_places(parse_text(MODEL, ModelConfig, "cart"))
    t, rng = np.arange(500) * 1e-2, np.random.default_rng(1)
    q, qd, qdd = (rng.standard_normal((500, 2)) for _ in range(3))
    none = tuple(np.zeros(500) for _ in range(6))
    s = Signals(1e-2, t, q, qd, qdd, np.zeros((500, 1)), *none, 0, places)
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
