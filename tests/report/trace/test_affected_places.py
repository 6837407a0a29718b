"""Test the drawing of the places at which effects were found, and its caption."""

from __future__ import annotations

import pytest

from levid.config.model import load_model
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.identification.trace.records.record_from_log import rig_places
from levid.model.effects.base import Effect, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent
from levid.report.plotting.style import colour
from levid.report.trace.affected_places import affected_places, places_in_words


@pytest.fixture(scope="module")
def places() -> Places:
    geometry = load_rig(shipped("rigs/loopback.yaml")).geometry
    return rig_places(geometry, load_model(shipped("models/rig.yaml")))


def effect(places: Places, identity: str) -> Effect:
    table = {e.identity: e for e in all_effects(places, Extent.typical(places))}
    return table[identity]


def test_coils_of_effects_are_marked(places: Places) -> None:
    some = [effect(places, "coil_gain@coil:6"), effect(places, "friction.coulomb@z")]
    (ax,) = affected_places(places, some).axes
    filled = [line.get_markerfacecolor() for line in ax.lines if line.get_marker() == "s"]
    assert [k for k, face in enumerate(filled) if face == colour("vermillion")] == [6]


def test_caption_says_what_is_marked_and_what_moves(places: Places) -> None:
    some = [effect(places, "coil_gain@coil:6"), effect(places, "friction.coulomb@z")]
    assert places_in_words(places, some) == (
        "Marked: coil 6. Effects on the motion of the whole platform: z (up and down). From above: "
        "squares are coils, s their sensors, the strip the beam."
    )
