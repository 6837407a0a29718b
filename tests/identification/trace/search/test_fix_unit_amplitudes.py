"""What there is all of in books has an amplitude of one, where that fits about as well."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import pytest
from rig_effects import rig_places

from levid.identification.trace.search import fix_unit_amplitudes
from levid.identification.trace.search.candidate_screening import LEAST
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects

NAMED = {e.identity: e for e in all_effects(rig_places())}
SATURATION, GAIN = "saturation@coil:2", "coil_gain@coil:1"


@dataclass(frozen=True)
class Named:
    names: tuple[str, ...] = ("m", "k")


@dataclass(frozen=True)
class Point:
    placed: tuple[Placed, ...]
    parameters: Named = Named()


@dataclass(frozen=True)
class Records:
    def train(self, point: Point) -> Point:
        return point


@pytest.fixture(autouse=True)
def begun_with_a_thousand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fix_unit_amplitudes, "gather", lambda *_: SimpleNamespace(squares=1000.0))


@pytest.mark.parametrize(("costs", "held"), [(0.0, True), (0.5 * LEAST, True), (1e4, False)])
def test_an_amplitude_is_held_at_one_where_that_costs_little(
    costs: float, held: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = Point((Placed(NAMED[GAIN], (), (0.1,)), Placed(NAMED[SATURATION], (23.0, 4.0), (0.2,))))
    monkeypatch.setattr(
        fix_unit_amplitudes, "refine", lambda point, *_, within: (point, 1000.0 + costs)
    )
    point = fix_unit_amplitudes.with_plain_amplitudes(begun, Records())  # type: ignore[arg-type]
    gain, saturation = point.placed
    assert gain == begun.placed[0]
    if not held:
        assert point is begun
        return
    assert saturation.amplitudes == (1.0,)
    assert saturation.shape[0] == pytest.approx(23.0 * 0.2**-0.25)
    assert saturation.effect.identity == SATURATION
    assert fix_unit_amplitudes.free_numbers(point).tolist() == [True, True, True, False, True, True]  # type: ignore[arg-type]
    assert fix_unit_amplitudes.with_plain_amplitudes(point, Records()) == point  # type: ignore[arg-type]


def test_a_limit_keeps_to_its_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fix_unit_amplitudes, "refine", lambda point, *_, within: (point, 0.0))
    high = NAMED[SATURATION].shape[0].high
    begun = Point((Placed(NAMED[SATURATION], (high, 1.5), (1e-6,)),))
    point = fix_unit_amplitudes.with_plain_amplitudes(begun, Records())  # type: ignore[arg-type]
    assert point.placed[0].shape[0] == high
