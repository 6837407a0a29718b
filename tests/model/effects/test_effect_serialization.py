"""Test effects in a model file: round trip from the table, and errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_test_helpers import rig_places

from levid.config.base import parse_text
from levid.config.model import EffectParameter, ModelConfig, ModelEffect, load_model
from levid.config.shipped import shipped
from levid.identification.greybox.identify_greybox import to_yaml
from levid.identification.trace.traced_model import model_effect
from levid.model.declared_model import ModelError
from levid.model.effects.base import Placed, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.effect_serialization import placed_effects
from levid.model.effects.operating_range import Extent
from levid.model.effects.vibration import tone


@pytest.fixture(scope="module")
def places() -> Places:
    return rig_places()


def in_file(effects: list[ModelEffect]) -> ModelConfig:
    """Write a model file with effects, and read it again."""
    model = load_model(shipped("models/rig.yaml")).model_copy(update={"effects": tuple(effects)})
    return parse_text(to_yaml(model), ModelConfig, "model.yaml")


def test_every_effect_of_the_table_is_read_back_from_a_file(places: Places) -> None:
    rng = np.random.default_rng(1)
    listed = [*all_effects(places), *tone(places, 23.4)]  # a frequency that is not in the table
    placed = [
        Placed(
            effect,
            tuple(effect.grid[0]),
            tuple(rng.standard_normal(len(effect.amplitudes)).tolist()),
            {q.name: 0.1 for q in effect.amplitudes},
        )
        for effect in listed
    ]
    read = in_file([model_effect(p) for p in placed])
    # The extent of other records: slow, and without stuck sensors.
    little = replace(Extent.typical(places), fastest_hz=20.0, stuck=())
    for extent in (None, little):
        back = placed_effects(read.effects, places, extent)
        assert [p.effect.identity for p in back] == [p.effect.identity for p in placed]
    # YAML writes the shortest text that reads as the same number.
    assert [(p.shape, p.amplitudes) for p in back] == [(p.shape, p.amplitudes) for p in placed]
    assert [dict(p.standard_errors) for p in back] == [p.standard_errors for p in placed]


def test_shape_outside_the_records_range_is_kept(places: Places) -> None:
    effect = next(e for e in all_effects(places) if e.shape and e.amplitudes)
    outside = tuple(2.0 * q.high for q in effect.shape)
    placed = Placed(effect, outside, tuple(1.0 for _ in effect.amplitudes), {})
    (back,) = placed_effects(in_file([model_effect(placed)]).effects, places)
    assert back.shape == outside
    # The bounds of a fit reach from the table's lower limit to the value in the file.
    for ours, of_table, value in zip(back.effect.shape, effect.shape, outside, strict=True):
        assert (ours.low, ours.high) == (of_table.low, value)


def test_model_without_effects_has_no_effects_key() -> None:
    assert "effects" not in to_yaml(load_model(shipped("models/rig.yaml")))


CUBIC = {"k3": EffectParameter(value=1e8, unit="N/m^3")}


@pytest.mark.parametrize(
    ("effects", "expected_error"),
    [
        (
            [ModelEffect(effect="rod_stiffness.kubic", where=("z",), parameters=CUBIC)],
            r"effects\[0\]: effect: .*'rod_stiffness.kubic'; did you mean rod_stiffness.cubic",
        ),
        (
            [ModelEffect(effect="rod_stiffness.cubic", where=("x",), parameters=CUBIC)],
            r"effects\[0\]: where: expected one of psi, theta, z .* found x",
        ),
        (
            [ModelEffect(effect="rod_stiffness.cubic", where=("z",), parameters={})],
            r"effects\[0\]: parameters: expected k3 .*, found none",
        ),
        (
            [ModelEffect(effect="rod_stiffness.cubic", where=("psi",), parameters=CUBIC)],
            r"effects\[0\]: parameters.k3: expected the unit 'N m/rad\^3', found 'N/m\^3'",
        ),
        (
            2 * [ModelEffect(effect="rod_stiffness.cubic", where=("z",), parameters=CUBIC)],
            r"effects\[1\]: duplicate effect Cubic stiffness at z",
        ),
    ],
)
def test_wrong_entry_is_reported(
    places: Places, effects: list[ModelEffect], expected_error: str
) -> None:
    with pytest.raises(ModelError, match=expected_error):
        placed_effects(effects, places)
