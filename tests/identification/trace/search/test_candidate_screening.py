"""Test the screening: candidates are fitted in batches, the best of those taken wins."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from effect_test_helpers import rig_places

from levid.identification.trace.search import candidate_screening as screening
from levid.identification.trace.search.predictive_criterion import Criterion
from levid.identification.trace.search.tested_candidate import Agreement, Round, Tried
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.freeform import freeform_effects
from levid.model.effects.operating_range import Extent

OPTIONS = SearchOptions()
NAMED = {e.identity: e for e in all_effects(rig_places())}
COIL_6, COIL_0, SATURATION = "coil_gain@coil:6", "coil_gain@coil:0", "saturation@coil:6"
SURELY, HARDLY = Agreement(50.0, 50.0, 50.0, True), Agreement(3.0, 1.0, 1.0, False)
FIT_TAKES = 340.0

Screen = Callable[..., Round]


def tried(identity: str, gain: float, *shape: float) -> Tried:
    effect = NAMED[identity]
    return Tried(effect, shape, gain, np.array([gain, 0.0]), (1.0,))


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Screen:
    """Return a function that screens ranked candidates; data agree with all but the given ones.

    A fit of a shape takes 340 more than its guess.
    """

    def fitted(_: object, some: list[Tried], __: object) -> list[Tried]:
        return [replace(t, gain=t.gain + FIT_TAKES) if t.shape else t for t in some]

    def run(*ranked: Tried | list[Tried], doubtful: set[str] = frozenset(), open_=None) -> Round:  # type: ignore[assignment]
        valleys = [one if isinstance(one, list) else [one] for one in ranked]
        monkeypatch.setattr(screening, "_ranked", lambda *_: valleys)

        def tested(_: object, some: list[Tried], *__: object) -> list[Tried]:
            return [
                replace(t, agreement=HARDLY if t.effect.identity in doubtful else SURELY)
                for t in some
            ]

        monkeypatch.setattr(screening, "tested", tested)
        train = SimpleNamespace(excess=1000.0, count=np.array([100.0]))
        return screening.screened(
            None, (), train, None, Criterion(OPTIONS, 1000.0, 0.0), open_ or (lambda _: True)
        )  # type: ignore[arg-type]

    monkeypatch.setattr(screening, "with_fitted_shapes", fitted)
    return run


def names(some: tuple[Tried, ...]) -> list[str]:
    return [t.effect.identity for t in some]


def test_candidate_that_explains_most_with_a_fitted_shape_is_taken(screen: Screen) -> None:
    found = screen(tried(COIL_6, 900.0), tried(SATURATION, 800.0, 14.0, 6.0))
    assert found.taken is not None
    assert found.taken.effect.identity == SATURATION
    assert found.taken.gain == 800.0 + FIT_TAKES
    assert names(found.survivors) == [SATURATION, COIL_6]


def test_each_candidate_is_fitted_from_other_shapes_of_its_grid(screen: Screen) -> None:
    guesses = [tried(SATURATION, 500.0, 14.0, 6.0), tried(SATURATION, 600.0, 20.0, 6.0)]
    found = screen(guesses)
    assert found.taken is not None
    assert (found.taken.shape, found.taken.gain) == ((20.0, 6.0), 940.0)
    assert len(found.ranking) == 1


def test_what_data_do_not_agree_with_is_not_taken(screen: Screen) -> None:
    found = screen(tried(COIL_6, 900.0), tried(COIL_0, 500.0), doubtful={COIL_6})
    assert found.taken is not None
    assert found.taken.effect.identity == COIL_0
    refused = screen(tried(COIL_6, 900.0), open_=lambda t: t.effect.identity != COIL_6)
    assert (refused.taken, names(refused.ranking)) == (None, [COIL_6])


def test_next_candidates_are_asked_if_none_of_the_first_is_taken(screen: Screen) -> None:
    first = [tried(f"sensor_gain@sensor:{i}", 900.0) for i in range(9)]
    first += [tried("sensor_nonlinearity.cubic@sensor:0", 900.0)]
    assert len(first) == OPTIONS.fitted
    later = tried(COIL_6, 400.0)
    assert names(screen(*first, later).survivors) == names(tuple(first))
    doubtful = set(names(tuple(first)))
    assert names(screen(*first, later, doubtful=doubtful).survivors) == [COIL_6]
    # What explains next to nothing is not fitted.
    found = screen(*first, tried(COIL_6, 1.0), doubtful=doubtful)
    assert (found.taken, len(found.ranking)) == (None, len(first))


@pytest.mark.parametrize(
    ("gain", "other", "alike"),
    [(950.0, 850.0, []), (950.0, 915.0, [COIL_0]), (150.0, 120.0, [COIL_0])],
)
def test_candidates_that_gain_nearly_as_much_are_alternatives(
    screen: Screen, gain: float, other: float, alike: list[str]
) -> None:
    found = screen(tried(COIL_6, gain), tried(COIL_0, other))
    assert names(found.alternatives) == alike


def test_free_form_of_fewer_signals_is_preferred() -> None:
    forms = {e.identity: e for e in freeform_effects(rig_places(), Extent.typical(rig_places()))}

    def worth(key: str, gain: float) -> float:
        form = next(e for name, e in forms.items() if name.startswith(key) and "@theta" in name)
        return screening.worth(Tried(form, (), gain, np.ones(1), ()), OPTIONS)

    alone, product = "unknown.v_b[", "unknown.v_b[0.4]*theta["
    assert worth(alone, 9500.0) > worth(product, 10_000.0)
    assert worth(alone, 8500.0) < worth(product, 10_000.0)
    # Two numbers of a shape have to gain Akaike's price more.
    assert screening.worth(tried(COIL_6, 100.0), OPTIONS) == 98.0
    assert screening.worth(tried(SATURATION, 100.0, 14.0, 6.0), OPTIONS) == 94.0
