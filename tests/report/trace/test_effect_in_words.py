"""Test the clauses of all effects: each has one, with its place, its sign and honest digits."""

from __future__ import annotations

import re

import numpy as np
import pytest
from effect_test_helpers import rig_places

from levid.config.model import EffectParameter
from levid.model.effects.base import Effect, Places
from levid.model.effects.candidate_effects import all_effects
from levid.report.trace.answer import Clause, answer
from levid.report.trace.effect_in_words import effect_in_words, place_in_words


def motor() -> Places:
    one, nowhere = np.eye(1), np.zeros((0, 2))
    return Places(
        ("q",), ("m",), one, one, "N", ("N",), "m", nowhere, nowhere, beam=False,
        input_names=("tau",),
    )  # fmt: skip


def parameters(effect: Effect, value: float, se: float | None) -> dict[str, EffectParameter]:
    return {
        q.name: EffectParameter(value=value, unit=q.unit, se=se)
        for q in (*effect.amplitudes, *effect.shape)
    }


def find(key: str, where: tuple[str, ...], places: Places) -> Effect:
    return next(e for e in all_effects(places) if e.key == key and e.where == where)


@pytest.mark.parametrize("places", [rig_places(), motor()], ids=["rig", "motor"])
def test_every_known_effect_has_a_clause(places: Places) -> None:
    for effect in all_effects(places):
        for value, se in ((0.02, 4e-4), (-0.02, None), (3e-5, 1e-3)):
            text = effect_in_words(effect, parameters(effect, value, se))
            assert text
            assert "{" not in text
            assert "coil:" not in text
            assert "sensor:" not in text
            if effect.effect_class != "unknown":
                assert text != effect.name, effect.key


@pytest.mark.parametrize(
    ("key", "where", "value", "se", "text"),
    [
        ("coil_gain", ("coil:6",), -0.02, 2e-4, "coil 6 gives 2.00 % less force than commanded"),
        ("coil_gain", ("coil:6",), 0.02, 3e-3, "coil 6 gives 2.0 % more force than commanded"),
        ("coil_gain", ("coil:6",), -2.0, 1e-3, "the force of coil 6 has the wrong sign"),
        ("sensor_gain", ("sensor:3",), 0.013, 1e-4, "sensor 3 reads 1.30 % too much"),
        ("sensor_offset.constant", ("sensor:0",), -2.5e-5, 1e-6, "sensor 0 reads 25 µm too low"),
        (
            "rod_stiffness.cubic",
            ("z",),
            3e8,
            1e6,
            "the rods harden with travel in z (by 3.00·10⁸ N/m³)",
        ),
        (
            "rod_stiffness.cubic",
            ("theta",),
            -3e4,
            1e2,
            "the rods soften with travel in θ (by 30000 N m/rad³)",
        ),
        ("friction.coulomb", ("z",), 0.3057, 0.002, "dry friction of 306 mN acts on z"),
        ("friction.beam", ("beam",), 2.0, None, "dry friction of 2 N acts on the beam"),
    ],
)
def test_clauses_of_the_rig(
    key: str, where: tuple[str, ...], value: float, se: float | None, text: str
) -> None:
    effect = find(key, where, rig_places())
    assert effect_in_words(effect, parameters(effect, value, se)) == text


@pytest.mark.parametrize(
    ("error", "se", "text"),
    [
        (0.04, 1e-4, "the reading of q is too large, by 4.00 % of it"),
        (1.0 - 1.0 / 57.3, 1e-6, "the reading of q is 57.300 times the position"),
        (-999.0, 0.1, "the reading of q is 0.0010000 times the position"),
        (2.0, None, "the reading of q is minus 1 times the position"),
    ],
)
def test_a_large_gain_of_a_reading_is_a_factor(error: float, se: float | None, text: str) -> None:
    effect = find("reading.gain", ("q",), motor())
    assert effect_in_words(effect, parameters(effect, error, se)) == text


def test_a_position_has_its_sign() -> None:
    effect = find("stiffness.stop.below", ("q",), motor())
    text = effect_in_words(effect, parameters(effect, -0.02, 1e-4))
    assert text == "a stop limits q below -20.0 mm"


def test_places_are_named_as_a_reader_names_them() -> None:
    assert place_in_words(("coil:6",)) == "coil 6"
    assert place_in_words(tuple(f"sensor:{i}" for i in range(9))) == "sensors 0 to 8"
    assert place_in_words(("psi", "theta")) == "ψ and θ"
    assert place_in_words(("beam", "theta")) == "the beam and θ"
    assert place_in_words(("tau",)) == "τ"


def test_digits_are_those_that_the_interval_supports() -> None:
    effect = find("coil_gain", ("coil:0",), rig_places())
    for se, digits in ((1e-2, "2"), (1e-3, "2.0"), (1e-4, "2.00"), (None, "2")):
        text = effect_in_words(effect, parameters(effect, 0.02, se))
        assert re.search(rf" {re.escape(digits)} %", text), text


def test_answer_says_what_is_sure_ambiguous_doubtful_and_left() -> None:
    text = answer(
        [
            Clause("coil 6 gives 2.00 % less force than commanded"),
            Clause("the rods harden in z"),
            Clause("coil 3 lags by 1 ms", ("Delay at coil:3",)),
            Clause("sensor 1 sticks", doubtful=True),
            Clause("Force at z over x", free=True),
        ],
        "Nothing else is left: the remaining error is noise.",
    )
    assert text == (
        "Coil 6 gives 2.00 % less force than commanded and the rods harden in z. Either coil 3 "
        "lags by 1 ms, or the cause is: Delay at coil:3; these records cannot tell which. Perhaps "
        "sensor 1 sticks. An unknown effect remains, described by a free form: Force at z over x. "
        "Nothing else is left: the remaining error is noise."
    )
    doubted = Clause("u lags", ("Delay at u", "Lag of x"), doubtful=True)
    assert answer([doubted], "Much is left.") == (
        "Perhaps u lags, or the cause is: Delay at u, or Lag of x; these records cannot tell "
        "which. Much is left."
    )
    assert answer([], "The model explains all.") == "The model explains all."
