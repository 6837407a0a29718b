"""Test how effects name the locations of actuators: coil:N on the rig, else the input's name."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import pytest
from effect_test_helpers import rig_places

from levid.config.base import parse_text
from levid.config.model import EffectParameter, ModelConfig, ModelEffect
from levid.identification.trace.records.record_from_log import imported_places
from levid.identification.trace.trace_outcome import FoundEffect, Outcome
from levid.identification.trace.traced_model import model_effect
from levid.model.effects.base import Effect, Placed, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.effect_serialization import placed_effects
from levid.model.effects.freeform import freeform_effects
from levid.model.effects.operating_range import Extent

MODEL = """
levid: model
name: stage
dof: [{name: x, unit: m}, {name: y, unit: m}]
inputs: [{name: FIRST, unit: A}, {name: right, unit: A}]
M: [[1.0, 0.0], [0.0, 1.0]]
D: [[1.0, 0.0], [0.0, 1.0]]
K: [[1.0, 0.0], [0.0, 1.0]]
"""
GAIN = {"gain": EffectParameter(value=0.1, unit="1")}


def stage(first: str = "left") -> Places:
    return imported_places(parse_text(MODEL.replace("FIRST", first), ModelConfig, "stage"))


def described(effect: Effect) -> str:
    quantities = (*effect.amplitudes, *effect.shape)
    return "|".join(
        [effect.identity, effect.title, effect.effect_class, effect.equation, effect.absorbed_by,
         effect.told_apart_by,
         *(f"{q.name} {q.unit} {q.low:.9g} {q.high:.9g} {q.log}" for q in quantities),
         *(" ".join(f"{v:.9g}" for v in row) for row in effect.grid)]
    )  # fmt: skip


def digest(lines: Sequence[str]) -> str:
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def test_table_of_the_rig_is_unchanged():
    """Model files of the rig and its trace results depend on names, order, bounds and starts.

    If you change the rig's table on purpose, replace the digests.
    """
    effects = all_effects(rig_places())
    forms = freeform_effects(rig_places(), Extent.typical(rig_places()))
    assert digest([e.identity for e in effects]) == "cebd1453e2f5ca66"
    assert digest([described(e) for e in effects]) == "9c5465508e926998"
    assert digest([described(e) for e in forms]) == "9bf1cbcb479c8830"


def test_actuators_of_another_plant_have_the_names_of_its_inputs():
    places = stage()
    assert places.actuators == ("left", "right")
    listed = [*all_effects(places), *freeform_effects(places, Extent.typical(places))]
    for effect in listed:
        words = [*effect.where, effect.title, effect.absorbed_by, effect.told_apart_by]
        assert not any("coil" in word for word in words), words
    (gain,) = (e for e in listed if e.identity == "coil_gain@left")
    assert gain.name == "Gain of an actuator at left"
    assert "dead_zone@left+right" in {e.identity for e in listed}


@pytest.mark.parametrize("name", ["x", "beam", "right"])
def test_name_of_another_location_is_not_used_for_an_actuator(name: str):
    places = stage(name)
    second = "coil:1" if name == "right" else "right"
    assert places.actuators == ("coil:0", second)


def test_actuators_of_the_rig_are_coils_whatever_its_inputs_are_called():
    assert rig_places().actuators == tuple(f"coil:{c}" for c in range(9))


def test_file_with_numbered_actuators_is_read_with_their_names():
    places = stage()
    numbered = [
        ModelEffect(effect="coil_gain", where=("coil:1",), parameters=GAIN),
        ModelEffect(
            effect="dead_zone",
            where=("coil:0", "coil:1"),
            parameters={
                "depth": EffectParameter(value=0.5, unit="1"),
                "width": EffectParameter(value=0.5, unit="A"),
            },
        ),
    ]
    assert [p.effect.where for p in placed_effects(numbered, places)] == [
        ("right",), ("left", "right"),
    ]  # fmt: skip


def test_free_forms_are_read_by_number_and_by_name():
    places = stage()
    listed = freeform_effects(places, Extent.typical(places))
    placed = [Placed(e, tuple(e.grid[0]), tuple(1.0 for _ in e.amplitudes)) for e in listed]
    declared = [model_effect(p) for p in placed]
    back = placed_effects(declared, places)
    assert [p.effect.identity for p in back] == [e.identity for e in listed]
    old = {"left": "coil:0", "right": "coil:1"}
    older = [
        d.model_copy(update={"where": tuple(old.get(w, w) for w in d.where)}) for d in declared
    ]
    back = placed_effects(older, places)
    assert [p.effect.identity for p in back] == [e.identity for e in listed]


def test_actuator_of_a_command_is_the_one_with_that_name():
    places = stage()
    (placed,) = placed_effects(
        [ModelEffect(effect="coil_gain", where=("right",), parameters=GAIN)], places
    )
    coil = placed.effect.build.keywords["coils"]  # type: ignore[attr-defined]
    assert coil == (1,)


def test_free_form_on_a_dof_may_be_a_part_of_many_equal_actuators():
    names = ("left", "middle", "right")

    def at(where: tuple[str, ...], effect_class: str) -> FoundEffect:
        effect = Effect("key", "title", effect_class, where, "", (), lambda _s, _p: [])
        return FoundEffect(Placed(effect, (), ()), None)

    def found(place: str) -> tuple[str, ...]:
        every, free = at(names, "saturation"), at((place,), "unknown")
        outcome = Outcome(
            (every, free), (), 20.0, 2.0, 1.0, (), 4.0, 1.0, (), (), (),
            actuators=frozenset((*names, "other")),
        )  # fmt: skip
        return outcome.perhaps_part_of(every)

    assert found("x")
    assert found("left")
    assert not found("other")
    assert not found("sensor:0")
    assert np.all([len(found(n)) == 1 for n in names])
