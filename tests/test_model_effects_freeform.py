"""Free-form forces: what they depend on, and that a model file can hold them."""

from __future__ import annotations

import pickle

import numpy as np

from levid.model.effects.base import Places, Signals
from levid.model.effects.extent import Extent
from levid.model.effects.freeform import freeform_effect, freeform_effects
from levid.model.geometry import shape_matrix


def rig_places() -> Places:
    x, y = 0.1 * np.repeat([1.0, 0.0, -1.0], 3), 0.1 * np.tile([1.0, 0.0, -1.0], 3)
    shape, xy = shape_matrix(x, y), np.stack([x, y], axis=1)
    return Places(
        ("psi", "theta", "z"), ("rad", "rad", "m"), shape, shape, "N", ("N m", "N m", "N"), "m",
        xy, xy, beam=True, span_s=(0.0, 2.0),
    )  # fmt: skip


def moving() -> Signals:
    draw = np.random.default_rng(1).standard_normal
    motion = [1e-3 * draw((200, 3)) for _ in range(3)]
    return Signals(
        0.01, np.arange(200) * 0.01, *motion, draw((200, 9)),
        *(draw(200) for _ in range(6)), 1, rig_places(),
    )  # fmt: skip


def effects():
    return freeform_effects(rig_places(), Extent.typical(rig_places()))


def test_key_and_place_say_all_that_there_is_to_know():
    for effect in effects():
        again = freeform_effect(rig_places(), effect.key, effect.where)
        assert again is not None
        assert again.identity == effect.identity
        for ours, theirs in zip(effect.build(moving(), ()), again.build(moving(), ()), strict=True):
            np.testing.assert_array_equal(ours.force, theirs.force)


def test_each_has_a_name_of_its_own_and_travels():
    identities = [e.identity for e in effects()]
    assert len(set(identities)) == len(identities)
    pickle.loads(pickle.dumps(effects()))


def test_a_force_acts_on_its_dof_alone():
    for effect in effects():
        others = [i for i, name in enumerate(rig_places().dof) if name != effect.where[0]]
        for term in effect.build(moving(), ()):
            assert not np.any(term.force[:, others])


def test_nonsense_is_no_effect():
    for key in ("unknown.nobody[1]", "unknown.theta", "friction.coulomb", "unknown.theta[x]"):
        assert freeform_effect(rig_places(), key, ("theta",)) is None
    assert freeform_effect(rig_places(), "unknown.x_b[0.1]", ("beam",)) is None
