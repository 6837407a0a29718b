"""Free-form forces: what they depend on, and that a model file can hold them."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from rig_effects import rig_places

from levid.model.effects.base import Signals
from levid.model.effects.extent import Extent
from levid.model.effects.freeform import (
    DEGREE,
    Form,
    _shapes,
    freeform_effect,
    freeform_effects,
)


def moving() -> Signals:
    draw = np.random.default_rng(1).standard_normal
    motion = [1e-3 * draw((200, 3)) for _ in range(3)]
    return Signals(
        0.01, np.arange(200) * 0.01, *motion, draw((200, 9)),
        *(draw(200) for _ in range(6)), 1, rig_places((0.0, 2.0)),
    )  # fmt: skip


def acts(term):
    """What a term adds: a force, or a reading."""
    assert (term.force is None) != (term.gap is None)
    return term.gap if term.force is None else term.force


def effects():
    return freeform_effects(rig_places(), Extent.typical(rig_places()))


def test_key_and_place_say_all_that_there_is_to_know():
    for effect in effects():
        again = freeform_effect(rig_places(), effect.key, effect.where)
        assert again is not None
        assert again.identity == effect.identity
        for ours, theirs in zip(effect.build(moving(), ()), again.build(moving(), ()), strict=True):
            np.testing.assert_array_equal(acts(ours), acts(theirs))


def test_each_has_a_name_of_its_own_and_travels():
    identities = [e.identity for e in effects()]
    assert len(set(identities)) == len(identities)
    pickle.loads(pickle.dumps(effects()))


def test_each_acts_at_its_place_alone():
    for effect in effects():
        kind, _, number = effect.where[0].partition(":")
        own = int(number) if kind == "sensor" else rig_places().dof.index(kind)
        for term in effect.build(moving(), ()):
            assert (term.gap is not None) == (kind == "sensor")
            assert not np.any(np.delete(acts(term), own, axis=1))


@pytest.mark.parametrize("by", ["x_b", "time", "z", "z_rate", "phi"])
def test_no_sum_of_functions_is_constant(by: str):
    """A constant force or reading is an unknown of every record already."""
    s = np.linspace(-1.0, 1.0, 400) * (np.pi if by == "phi" else 1.0)
    functions = _shapes(by, s, DEGREE)
    best, *_ = np.linalg.lstsq(functions, np.ones(400), rcond=None)
    # What is left of a constant: all of it for harmonics, a peak as wide as a piece for splines.
    assert np.mean((1.0 - functions @ best) ** 2) > 1e-3


def test_what_happens_at_one_end_of_the_beam_says_nothing_of_the_other():
    form = Form("x_b", 0.1)
    ends = replace(moving(), x_b_m=np.linspace(-0.1, 0.1, 200))
    left, right = form.functions(ends)[:80], form.functions(ends)[-80:]
    assert not np.any(np.any(left != 0.0, axis=0)[-3:])
    assert not np.any(np.any(right != 0.0, axis=0)[:3])


def test_nonsense_is_no_effect():
    keys = ("unknown.nobody[1]", "unknown.theta", "unknown.theta[x]", "unknown.theta[0]")
    for key in (*keys, "friction.coulomb", "unknown.phi[1]", "unknown.z[1]*nobody[2]"):
        assert freeform_effect(rig_places(), key, ("theta",)) is None
    for nowhere in (("beam",), ("sensor:9",), ("psi", "z"), ()):
        assert freeform_effect(rig_places(), "unknown.x_b[0.1]", nowhere) is None
