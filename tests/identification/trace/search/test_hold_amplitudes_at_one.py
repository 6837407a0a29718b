"""Test amplitudes that physics sets to one: they are fixed at one if the fit hardly changes."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import pytest
from effect_test_helpers import rig_places

from levid.identification.trace.search import hold_amplitudes_at_one
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects

OPTIONS = SearchOptions()
NAMED = {e.identity: e for e in all_effects(rig_places())}
SATURATION, GAIN = "saturation@coil:2", "coil_gain@coil:1"


@dataclass(frozen=True)
class Parameters:
    names: tuple[str, ...] = ("m", "k")


@dataclass(frozen=True)
class Point:
    placed: tuple[Placed, ...]
    parameters: Parameters = Parameters()


@dataclass(frozen=True)
class Records:
    def train(self, point: Point) -> Point:
        return point


@pytest.fixture(autouse=True)
def initial_squared_error_of_1000(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        hold_amplitudes_at_one, "gather", lambda *_: SimpleNamespace(squares=1000.0)
    )


@pytest.mark.parametrize(
    ("costs", "held"), [(0.0, True), (0.5 * OPTIONS.least_squares, True), (1e4, False)]
)
def test_amplitude_is_fixed_at_one_if_the_error_hardly_grows(
    costs: float, held: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = Point((Placed(NAMED[GAIN], (), (0.1,)), Placed(NAMED[SATURATION], (23.0, 4.0), (0.2,))))
    monkeypatch.setattr(
        hold_amplitudes_at_one, "refine", lambda point, *_, within: (point, 1000.0 + costs)
    )
    point = hold_amplitudes_at_one.with_plain_amplitudes(start, Records(), OPTIONS)  # type: ignore[arg-type]
    gain, saturation = point.placed
    assert gain == start.placed[0]
    if not held:
        assert point is start
        return
    assert saturation.amplitudes == (1.0,)
    assert saturation.shape[0] == pytest.approx(23.0 * 0.2**-0.25)
    assert saturation.effect.identity == SATURATION
    assert hold_amplitudes_at_one.free_numbers(point).tolist() == [
        True,
        True,
        True,
        False,
        True,
        True,
    ]  # type: ignore[arg-type]
    assert hold_amplitudes_at_one.with_plain_amplitudes(point, Records(), OPTIONS) == point  # type: ignore[arg-type]


def test_shape_parameter_stays_within_its_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hold_amplitudes_at_one, "refine", lambda point, *_, within: (point, 0.0))
    high = NAMED[SATURATION].shape[0].high
    start = Point((Placed(NAMED[SATURATION], (high, 1.5), (1e-6,)),))
    point = hold_amplitudes_at_one.with_plain_amplitudes(start, Records(), OPTIONS)  # type: ignore[arg-type]
    assert point.placed[0].shape[0] == high
