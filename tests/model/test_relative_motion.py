"""Test the relative motions of declared models, and that their laws act on both ends."""

from __future__ import annotations

import numpy as np
import pytest

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.trace.records.record_from_log import imported_places
from levid.model.effects.base import Signals
from levid.model.effects.candidate_effects import all_effects
from levid.model.relative_motion import joints

HEAD = """
levid: model
name: two
dof: [{name: a, unit: rad}, {name: b, unit: rad}]
inputs: [{name: t, unit: N m}]
parameters:
  j: {value: 2.0, unit: kg m^2, min: 0.1, max: 10}
  k: {value: 30.0, unit: N m/rad, min: 1, max: 100}
  c: {value: 0.3, unit: N m s/rad, min: 0, max: 10}
M: [[j, 0], [0, j]]
B: [[1], [0]]
"""
COUPLING = HEAD + "D: [[c, -c], [-c, c]]\nK: [[k, -k], [-k, k + 4]]\n"
GEAR = HEAD + "D: [[0, 0], [0, 0]]\nK: [[k, -0.1 * k], [-0.1 * k, 0.01 * k]]\n"
TWIST = HEAD + "D: [[0, 0], [0, 0]]\nK: [[k, 0], [-k, 0]]\n"
NUMBERS = HEAD + "D: [[c, 0], [0, 0]]\nK: [[30, -30], [-30, 30]]\n"
APART = HEAD + "D: [[c, 0], [0, c]]\nK: [[k, 0], [0, 5]]\n"


def config(text: str) -> ModelConfig:
    return parse_text(text, ModelConfig, "two")


@pytest.mark.parametrize(
    ("text", "name", "motion", "pull"),
    [
        (COUPLING, "a - b", (1.0, -1.0), (1.0, -1.0)),
        (GEAR, "a - 0.1 b", (1.0, -0.1), (1.0, -0.1)),
        (TWIST, "a on a and b", (1.0, 0.0), (1.0, -1.0)),
        (NUMBERS, "a - b", (1.0, -1.0), (1.0, -1.0)),
    ],
)
def test_spring_between_two_dof_is_a_joint(
    text: str, name: str, motion: tuple[float, ...], pull: tuple[float, ...]
) -> None:
    (joint,) = joints(declared_model(config(text)), ("rad", "rad"), ("N m", "1"))
    assert joint.name == name
    np.testing.assert_allclose(joint.motion, motion, atol=1e-6)
    np.testing.assert_allclose(joint.pull, pull, atol=1e-6)
    assert (joint.unit, joint.force_unit) == ("rad", "N m")


def test_springs_that_share_a_parameter_or_are_numbers_are_joints() -> None:
    """A chain of three with one stiffness: no matrix of it has rank one."""
    chain = HEAD.replace("name: b, unit: rad}]", "name: b, unit: rad}, {name: x, unit: m}]")
    chain = chain.replace("[[j, 0], [0, j]]", "[[j, 0, 0], [0, j, 0], [0, 0, j]]")
    chain = chain.replace("[[1], [0]]", "[[1], [0], [0]]")
    chain += "D: [[0, 0, 0], [0, 0, 0], [0, 0, 0]]\n"
    chain += "K: [[2*k, -k, 7], [-k, 2*k, 0], [7, 0, 5]]\n"
    found = joints(declared_model(config(chain)), ("rad", "rad", "m"), ("N m", "1", "1"))
    # A number between an angle and a length is no spring of one of the two.
    assert [j.name for j in found] == ["a - b"]
    np.testing.assert_array_equal(found[0].pull, [1.0, -1.0, 0.0])


def test_springs_of_single_dof_are_no_joints() -> None:
    assert joints(declared_model(config(APART)), ("rad", "rad"), ("N m", "1")) == ()


def test_law_of_a_joint_draws_both_ends() -> None:
    places = imported_places(config(GEAR))
    table = {e.identity: e for e in all_effects(places)}
    effect = table["stiffness.cubic@a - 0.1 b"]
    rng = np.random.default_rng(0)
    q = rng.normal(size=(50, 2))
    none = np.zeros(50)
    signals = Signals(
        1e-3, 1e-3 * np.arange(50), q, 0 * q, 0 * q, np.zeros((50, 1)),
        none, none, none, none, none, none, 0, places,
    )  # fmt: skip
    (term,) = effect.build(signals, ())
    stretch = q[:, 0] - 0.1 * q[:, 1]
    assert term.force is not None
    np.testing.assert_allclose(term.force, np.outer(-(stretch**3), [1.0, -0.1]), rtol=1e-9)
    for other in ("friction.coulomb", "backlash.dead_zone_spring", "damping.quadratic"):
        assert f"{other}@a - 0.1 b" in table


def test_a_place_has_its_motion_and_what_a_force_there_does() -> None:
    places = imported_places(config(GEAR))
    for place, motion, force in (
        ("b", (0.0, 1.0), (0.0, 1.0)),
        ("a - 0.1 b", (1.0, -0.1), (1.0, -0.1)),
        ("t", (1.0, 0.0), (1.0, 0.0)),
        ("nowhere", (0.0, 0.0), (0.0, 0.0)),
    ):
        np.testing.assert_allclose(places.motion_at(place), [motion, force])
