"""Test gains relative to their mean: terms, places, and the shipped model that declares them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from effect_test_helpers import moving, rig_places

from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.model.effects.base import Effect, Placed, total
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.effect_serialization import placed_effects
from levid.model.effects.relative_gains import COIL_GAINS, SENSOR_GAINS, relative_gains

PLACES = rig_places()
KINDS = (("coil_gain", COIL_GAINS, "held"), ("sensor_gain", SENSOR_GAINS, "gap"))


def of(key: str) -> Effect:
    return next(e for e in relative_gains(PLACES) if e.key == key)


@pytest.mark.parametrize(("single", "key", "part"), KINDS)
def test_deviations_are_gains_of_single_channels_whose_sum_is_zero(
    single: str, key: str, part: str
) -> None:
    s, rng = moving(), np.random.default_rng(2)
    some = rng.uniform(-0.05, 0.05, 8)
    gains = [*some, -some.sum()]
    found = Placed(of(key), (), tuple(some)).term(s)
    channels = [e for e in all_effects(PLACES) if e.key == single]
    assert of(key).where == tuple(e.where[0] for e in channels)
    expected = total(
        [Placed(e, (), (float(g),)).term(s) for e, g in zip(channels, gains, strict=True)]
    )
    np.testing.assert_allclose(getattr(found, part), getattr(expected, part), atol=1e-12)


def test_plant_without_spare_coils_and_sensors_has_none() -> None:
    # With as many coils as DOFs a gain is a change of the model.
    few = replace(PLACES, coil_shape=PLACES.coil_shape[:3], coil_xy_m=PLACES.coil_xy_m[:3])
    assert [e.key for e in relative_gains(few)] == [SENSOR_GAINS]


def test_shipped_model_is_that_of_the_rig_with_all_gains() -> None:
    rig, gains = (
        yaml.safe_load(shipped(f"models/{name}.yaml").read_text()) for name in ("rig", "rig-gains")
    )
    assert {**gains, "name": "rig", "effects": None} == {**rig, "effects": None}
    placed = placed_effects(load_model(shipped("models/rig-gains.yaml")).effects, PLACES)
    assert [p.effect.key for p in placed] == [COIL_GAINS, SENSOR_GAINS]
    assert all(set(p.amplitudes) == {0.0} for p in placed)
