"""Test the chain of an actuator: order, what reaches each part, and what later parts pass on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.trace.records.record_from_log import imported_places
from levid.model.effects.actuator_chain import in_chain, orders, passed_on, reaching
from levid.model.effects.base import Placed, Places, Signals
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.combined_effects import together
from levid.model.effects.operating_range import Extent

PLACES = imported_places(
    parse_text(
        """
levid: model
name: stage
dof: [{name: x, unit: m}, {name: y, unit: m}]
inputs: [{name: f, unit: N}, {name: g, unit: N}]
M: [[1.0, 0], [0, 1.0]]
D: [[1.0, 0], [0, 1.0]]
K: [[1.0, 0], [0, 1.0]]
""",
        ModelConfig,
        "stage",
    )
)
EXTENT = Extent((1.0, 1.0), (1.0, 1.0), 1.0, 5.0, 0.0)
TABLE = all_effects(PLACES, EXTENT)
TS, ROWS = 1e-3, 3000


def signals(places: Places = PLACES) -> Signals:
    t, none = np.arange(ROWS) * TS, np.zeros(ROWS)
    u = np.stack([3.0 * np.sin(9.0 * t) + np.sin(50.0 * t), 2.0 * np.cos(7.0 * t)], axis=1)
    still = np.zeros((ROWS, 2))
    return Signals(TS, t, still, still, still, u, none, none, none, none, none, none, 0, places)


def part(key: str, amplitudes: tuple[float, ...], shape: tuple[float, ...], at: str = "f"):
    (effect,) = (e for e in TABLE if e.key == key and e.where == (at,))
    return Placed(effect, shape, amplitudes)


DEAD_ZONE = part("dead_zone", (0.9,), (0.5,))
LAG = part("actuator_lag", (0.02,), (0.02,))
LIMIT = part("saturation.after_lag", (0.8,), (2.0, 8.0))
OTHER = part("dead_zone", (1.0,), (0.3,), "g")
CUBE = part("stiffness.cubic", (1.0,), (), "x")


def test_commands_pass_the_parts_in_their_order_whatever_that_of_the_list() -> None:
    s = signals()
    passed, leaving = in_chain([LIMIT, CUBE, OTHER, LAG, DEAD_ZONE], s)
    at_f = [p for p, _ in passed if p.effect.where == ("f",)]
    assert at_f == [DEAD_ZONE, LAG, LIMIT]
    assert passed[0] == (CUBE, s)
    seen = {p.effect.identity: there.coil for p, there in passed}
    np.testing.assert_array_equal(seen[DEAD_ZONE.effect.identity][:, 0], s.coil[:, 0])
    left = s.coil[:, 0] - 0.9 * np.clip(s.coil[:, 0], -0.5, 0.5)
    np.testing.assert_allclose(seen[LAG.effect.identity][:, 0], left, atol=1e-12)
    assert np.abs(leaving[:, 0]).max() < 0.8 * 2.0 + 0.2 * np.abs(s.coil[:, 0]).max()
    other = s.coil[:, 1] - np.clip(s.coil[:, 1], -0.3, 0.3)
    np.testing.assert_allclose(leaving[:, 1], other, atol=1e-12)


def test_what_effects_add_is_what_leaves_the_chain() -> None:
    s = signals()
    placed = [LIMIT, OTHER, LAG, DEAD_ZONE]
    held = together(placed, s).held
    np.testing.assert_allclose(s.coil + held, in_chain(placed, s)[1], atol=1e-12)


def test_a_part_passed_on_is_the_derivative_of_what_leaves() -> None:
    s = signals()
    for own in (DEAD_ZONE, LAG, LIMIT):
        placed = [DEAD_ZONE, LAG, LIMIT, OTHER]
        terms = own.effect.build(reaching(own.effect, placed, s), own.shape)
        (term,) = passed_on(own.effect, terms, placed, s)
        ends = []
        for step in (-1e-5, 1e-5):
            moved = replace(own, amplitudes=(own.amplitudes[0] + step,))
            others = [p for p in placed if p is not own]
            ends.append(in_chain([*others, moved], s)[1])
        change = (ends[1] - ends[0]) / 2e-5
        # The derivative through the limit is one-sided, with a step of a thousandth.
        np.testing.assert_allclose(term.held, change, atol=2e-3 * np.abs(change).max())


def magnet() -> Placed:
    found = (e for e in TABLE if e.key.startswith("magnetic_force.i2_y2.opens"))
    (effect,) = (e for e in found if e.where == ("x", "f"))
    return Placed(effect, (2.0, 5.0), (3.0,))


def test_a_magnet_has_the_current_that_a_lag_leaves() -> None:
    s = replace(signals(), q=np.stack([0.3 * np.sin(4.0 * signals().time_s)] * 2, axis=1))
    lagged = in_chain([LAG], s)[1]
    force = together([magnet(), LAG], s).force
    np.testing.assert_array_equal(force, magnet().term(replace(s, coil=lagged)).force)
    # So what more of the lag does is also what it does to the magnet's force.
    terms = LAG.effect.build(reaching(LAG.effect, [LAG, magnet()], s), LAG.shape)
    (term,) = passed_on(LAG.effect, terms, [LAG, magnet()], s)
    ends = []
    for step in (-1e-5, 1e-5):
        moved = replace(LAG, amplitudes=(LAG.amplitudes[0] + step,))
        ends.append(together([moved, magnet()], s).force)
    change = (ends[1] - ends[0]) / 2e-5
    np.testing.assert_allclose(term.force, change, atol=2e-3 * np.abs(change).max())


def test_orders_are_asked_only_where_there_is_a_lag() -> None:
    before = part("saturation", (0.8,), (2.0, 8.0))
    assert orders([before, OTHER], TABLE, False) == [(before, OTHER)]
    keys = [[p.effect.key for p in order] for order in orders([before, LAG], TABLE, False)]
    assert keys == [["saturation", "actuator_lag"], ["saturation.after_lag", "actuator_lag"]]
    # A lag of all commands that the model has counts for each.
    assert len(orders([before, OTHER], TABLE, True)) == 3
    # When the lag is found to be none, what acted behind it acts before.
    (only,) = orders([LIMIT], TABLE, False)
    assert only[0].effect.key == "saturation"


def test_effects_of_the_rig_are_added() -> None:
    s = signals(replace(PLACES, beam=True))
    passed, leaving = in_chain([LIMIT, LAG], s)
    assert passed == [(LIMIT, s), (LAG, s)]
    assert leaving is s.coil
