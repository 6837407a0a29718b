"""Test the doubt of a law whose numbers are not those of what it stands for."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from levid.config.base import parse_text
from levid.config.model import EffectParameter, ModelConfig
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.free_parameters import free_parameters
from levid.identification.trace.force_balance.force_record import ForceModel
from levid.identification.trace.force_checks import certainty_of_effects
from levid.identification.trace.force_checks.certainty_of_effects import FittedRows
from levid.identification.trace.force_search.rated_candidate import Rated
from levid.identification.trace.force_search.search import Searched
from levid.identification.trace.force_trace import force_trace_outcome, model_check
from levid.identification.trace.force_trace.found_law import FoundLaw
from levid.identification.trace.force_trace.model_check import ModelCheck
from levid.identification.trace.records.record_from_log import imported_places
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects

MODEL = """
levid: model
name: arm
dof: [{name: q, unit: rad}]
inputs: [{name: u, unit: V}]
M: [[1.0]]
D: [[1.0]]
K: [[1.0]]
"""


def found(rated: Rated, numbers: dict[str, EffectParameter], **check: Any) -> FoundLaw:
    """Return a law that nothing but its numbers, or the check of the model, puts in doubt."""
    model = ModelCheck(SearchOptions(), **check)
    return FoundLaw(rated, numbers, 1.0, (), (), 0.0, 0.0, None, True, (), model)


def in_model(law: FoundLaw, **check: Any) -> FoundLaw:
    """Return the law with another check of the model with all effects."""
    return replace(law, check=replace(law.check, **check))


@pytest.mark.parametrize(
    ("lag", "tail", "se", "unequal"),
    [
        (0.017, 0.1, 1e-3, True),
        (0.017, 0.08, 0.03, False),  # not told apart
        (0.025, 0.0273, 4e-4, True),  # a delay that stands for a lag of third order
        (0.0198, 0.02, 1e-6, False),  # by less than the accuracy of a law
        (0.02, 0.02, 1e-6, False),
    ],
)
def test_lag_and_tail_of_a_plain_lag_are_the_same(
    lag: float, tail: float, se: float, unequal: bool
) -> None:
    places = imported_places(parse_text(MODEL, ModelConfig, "arm"))
    (effect,) = (e for e in all_effects(places) if e.key == "actuator_lag")
    rated = Rated(Placed(effect, (tail,), (lag,)), None, 0.1)  # type: ignore[arg-type]
    numbers = {
        "lag": EffectParameter(value=lag, unit="s", se=se),
        "tail": EffectParameter(value=tail, unit="s", se=se),
    }
    law = found(rated, numbers)
    assert law.doubtful == unequal
    assert any("lag and tail" in d for d in law.doubts) == unequal


@pytest.mark.parametrize(
    ("key", "shape", "se", "at_limit"),
    [
        ("flexible_mode.loose_mass", (6.5, 0.7), 0.05, True),  # no more than a mass with a damper
        ("flexible_mode.loose_mass", (6.5, 0.3), 0.05, False),
        ("flexible_mode.loose_mass", (6.5, 0.7), 0.5, False),  # not told
        ("saturation", (1.0, 1000.0), 0.05, False),  # a hard limit
    ],
)
def test_a_law_at_the_limit_of_its_shape_is_in_doubt(
    key: str, shape: tuple[float, ...], se: float, at_limit: bool
) -> None:
    places = imported_places(parse_text(MODEL, ModelConfig, "arm"))
    (effect,) = (e for e in all_effects(places) if e.key == key)
    rated = Rated(Placed(effect, shape, (0.1,)), None, 0.1)  # type: ignore[arg-type]
    numbers = {
        q.name: EffectParameter(value=value, unit=q.unit, se=se)
        for q, value in zip(effect.shape, shape, strict=True)
    }
    law = found(rated, numbers)
    assert law.doubtful == at_limit
    assert any("damping ended at the limit" in d for d in law.doubts) == at_limit


def test_damping_that_falls_already_at_the_least_speed_may_be_friction() -> None:
    places = imported_places(parse_text(MODEL, ModelConfig, "arm"))
    (effect,) = (e for e in all_effects(places) if e.key == "damping.falling")
    low = effect.shape[0].low
    rated = Rated(Placed(effect, (low,), (0.1,)), None, 0.1)  # type: ignore[arg-type]
    numbers = {"v_0": EffectParameter(value=low, unit="rad/s", se=1e-3 * low)}
    assert any("v_0 ended at the limit" in d for d in found(rated, numbers).doubts)


@pytest.mark.parametrize(
    ("depth", "se", "floors", "doubtful"),
    [
        (1.31, 0.01, np.nan, True),  # a delay beyond the range, as a Pade approximation has it
        (1.01, 0.001, 1.0, False),
        (1.31, 0.2, 1.0, False),  # not told from 1
        (1.0, 0.01, 70.0, True),
        (1.0, 0.01, np.inf, True),  # it does not converge
    ],
)
def test_a_partial_law_and_a_free_run_that_stays_off_are_in_doubt(
    depth: float, se: float, floors: float, doubtful: bool
) -> None:
    places = imported_places(parse_text(MODEL, ModelConfig, "arm"))
    (effect,) = (e for e in all_effects(places) if e.key == "actuator_lag.second_order")
    rated = Rated(Placed(effect, (3.0, 0.7), (depth,)), None, 0.1)  # type: ignore[arg-type]
    numbers = {
        q.name: EffectParameter(value=value, unit=q.unit, se=se)
        for q, value in zip((*effect.amplitudes, *effect.shape), (depth, 3.0, 0.7), strict=True)
    }
    law = found(rated, numbers, floors=floors)
    assert law.doubtful == doubtful


def test_a_law_beside_which_a_parameter_ends_at_its_limit_is_in_doubt() -> None:
    """It may be what the parameter was, as a lag that takes the place of the inertia."""
    places = imported_places(parse_text(MODEL, ModelConfig, "arm"))
    (effect,) = (e for e in all_effects(places) if e.key == "damping.quadratic")
    rated = Rated(Placed(effect, (), (0.1,)), None, 0.1)  # type: ignore[arg-type]
    numbers = {"d2": EffectParameter(value=0.1, unit="N m s^2/rad^2", se=0.01)}
    assert not found(rated, numbers).doubtful
    (doubt,) = found(rated, numbers, displaced=("j",)).doubts
    assert doubt == "with the effects, j ended at the limit of its range"


def left_with(left: list[float], form: list[float]) -> Any:
    """Return what a trace of two DOF says of the force in the fitted rows, in per cent."""
    places = SimpleNamespace(dof=("x", "y"))
    return SimpleNamespace(
        options=SearchOptions(),
        places=places,
        unseen=np.array([left, form]),
        rows=FittedRows(*np.array([left, form, [0.0] * len(form)]) / 100.0),
    )


@pytest.mark.parametrize(
    ("form", "noise", "missed", "confirmed"),
    [
        (5.0, 4.9, 20.0, True),
        (4.6, 4.6, 20.0, True),
        (3.0, 3.0, 20.0, False),
        (np.nan, 4.9, 20.0, False),
        (5.0, 0.1, 20.0, False),  # nor does a free form describe it: something moves unread
        (3.0, 0.1, 51.0, True),  # a hundredth of the squares is left
    ],
)
def test_force_confirms_what_leaves_no_more_than_a_free_form_and_noise(
    form: float, noise: float, missed: float, confirmed: bool
) -> None:
    before: Any = SimpleNamespace(force_percent=np.array([missed, 0.1]))
    after: Any = SimpleNamespace(
        force_percent=np.array([5.0, 0.1]), noise_percent=np.array([noise, 0.1])
    )
    trace = left_with([5.0, 0.1], [form, 0.1])
    assert model_check._confirmed_by_force(trace, before, after) == confirmed


def test_a_free_form_that_takes_noise_tells_nothing() -> None:
    rows = FittedRows(*np.array([[3.5, 5.0], [1.9, 2.0], [3.9, 1.0]]))
    np.testing.assert_array_equal(rows.any_law, [3.9, 2.0])


def test_a_dof_lacks_what_a_free_form_takes_if_it_matters() -> None:
    lacking = force_trace_outcome._lacking
    # Of 8.5 % a half; of 0.5 % as well, but that is less than equations are right to.
    assert lacking(left_with([8.5, 0.5], [6.0, 0.35])) == {"x": pytest.approx(0.502, abs=1e-3)}
    assert lacking(left_with([8.5, 8.5], [8.0, np.nan])) == {}


def test_what_matters_at_turns_only_is_told_from_what_matters_everywhere() -> None:
    trace = left_with([5.0, 5.0], [2.0, 2.0])
    x = np.array([1.0, 0.0])
    trace.found = SimpleNamespace(point=SimpleNamespace(rubbed=lambda _: [(x, x)]))
    quiet = FittedRows(*np.array([[1.0, 1.0], [1.0, 1.0], [1.0, 1.0]]) / 100.0)
    for between, expected in ((None, ()), (quiet, ("x",)), (trace.rows, ())):
        trace.between = between
        # There is no friction at y.
        assert model_check.missing_only_at_turns(trace) == expected
    trace.rows = quiet  # what is missing in the reported rows is not at turns
    assert model_check.missing_only_at_turns(trace) == ()


def test_each_of_as_many_effects_as_are_looked_for_is_in_doubt() -> None:
    """A belt whose stiffness goes with its carriage was an inertia, a force constant and more."""
    (doubt,) = in_model(law_of("actuator_lag"), crowded=6).doubts
    assert doubt.startswith("the search ended at its maximum of 6 effects")
    (doubt,) = in_model(law_of("actuator_lag"), exchanged="a and b are exchanged").doubts
    assert doubt == "the model without effects explains as much if a and b are exchanged"
    (doubt,) = replace(law_of("actuator_lag"), impossible=("the damping at q is negative",)).doubts
    assert doubt == "the damping at q is negative with it, and not without it"


def test_a_law_that_is_right_only_beside_one_in_doubt_is_in_doubt(monkeypatch) -> None:
    config = parse_text(MODEL, ModelConfig, "arm")
    table = {e.key: e for e in all_effects(imported_places(config))}
    lag = Placed(table["actuator_lag"], (0.02,), (0.02,))
    mass = Placed(table["flexible_mode.loose_mass"], (6.5, 0.3), (0.1,))
    drag = Placed(table["damping.quadratic"], (), (1.0,))
    placed = (lag, mass, drag)
    rated = tuple(Rated(p, None, 0.1) for p in placed)  # type: ignore[arg-type]
    point = ForceModel(declared_model(config), free_parameters(config), placed)
    asked = []

    def left(found: Searched, *_: Any) -> tuple[tuple[float, ...], tuple[bool, ...]]:
        """Without the mass the lag leaves much; the drag never does."""
        keys = [r.placed.effect.key for r in found.rated]
        asked.append(keys)
        shares = tuple(0.75 if key == "actuator_lag" else 0.0 for key in keys)
        return shares, tuple(True for _ in keys)

    monkeypatch.setattr(certainty_of_effects, "_left_share", left)
    monkeypatch.setattr(certainty_of_effects, "fit_numbers", lambda _, at: at)
    training: Any = None
    found, told = Searched(point, rated, (), ()), [np.array([0.01])] * 3

    def leaning(
        shares: tuple[float, ...], impossible: dict[str, tuple[str, ...]] | None = None
    ) -> tuple[float, ...]:
        return certainty_of_effects._leaning(
            found, training, np.zeros(1), SearchOptions(), shares, told, impossible or {}
        )

    assert leaning((0.05, 0.21, 0.0)) == (0.75, 0.0, 0.0)
    assert asked == [["actuator_lag", "damping.quadratic"], ["damping.quadratic"]]
    assert leaning((0.05, 0.05, 0.0)) == (0.0, 0.0, 0.0)  # nothing is in doubt
    no_inertia = {mass.effect.identity: ("the inertia may be zero",)}
    assert leaning((0.05, 0.05, 0.0), no_inertia) == (0.75, 0.0, 0.0)
    law = replace(law_of("actuator_lag"), leaning=0.75)
    assert law.doubts == (
        "without the other uncertain effects, it leaves 75 % of the squared missing force",
    )


@pytest.mark.parametrize(
    ("left", "takes", "error", "gone"),
    [
        (0.46, True, 0.5, True),
        (0.46, True, 0.2, False),
        (0.05, True, 0.5, False),
        (0.05, False, 0.5, True),
        (0.05, False, 0.2, False),
    ],
)
def test_what_may_be_zero_and_leaves_much_or_takes_nothing_was_not_found(
    left: float, takes: bool, error: float, gone: bool
) -> None:
    """Each alone is a doubt: a right law can be small, or have another one beside it."""
    rated = law_of("actuator_lag").rated
    found = Searched(SimpleNamespace(placed=(rated.placed,)), (rated,), (), ())  # type: ignore[arg-type]
    nothing = np.zeros(0)
    rows = FittedRows(nothing, nothing, nothing)
    told = certainty_of_effects.Certainty(
        found,
        nothing,
        nothing,
        [np.array([error])],
        nothing,
        rows,
        None,
        (left,),
        (takes,),
        (0.0,),
        {},
    )
    expected = rated.placed.effect.identity if gone else None
    assert told.says_nothing(SearchOptions()) == expected


def law_of(key: str) -> FoundLaw:
    """Return a law of its first shape that nothing puts in doubt."""
    (effect,) = (
        e
        for e in all_effects(imported_places(parse_text(MODEL, ModelConfig, "arm")))
        if e.key == key
    )
    rated = Rated(Placed(effect, effect.grid[0], (effect.grid[0][0],)), None, 0.1)  # type: ignore[arg-type]
    numbers = {
        q.name: EffectParameter(value=0.02, unit=q.unit, se=1e-3)
        for q in (*effect.amplitudes, *effect.shape)
    }
    return found(rated, numbers)


@pytest.mark.parametrize(
    ("left", "noise", "share"),
    [
        (6.0, 0.5, 0.099),  # of 19 %
        (8.0, 0.5, 0.177),
        (8.0, 8.0, 0.0),  # no more than noise
        (0.4, 0.0, 0.0),  # less than an equation is right to
    ],
)
def test_what_is_left_in_unseen_rows_counts_beyond_noise_where_it_matters(
    left: float, noise: float, share: float
) -> None:
    trace = left_with([0.0, 0.0], [0.0, 0.0])
    trace.between = None
    before = SimpleNamespace(force_percent=np.array([19.0, 1.0]))
    after = SimpleNamespace(
        force_percent=np.array([left, 1.0]), noise_percent=np.array([noise, 0.0])
    )
    found_share = model_check._left_unseen(trace, before, after)  # type: ignore[arg-type]
    assert found_share == pytest.approx(share, abs=2e-3)


def test_a_name_is_in_doubt_where_unseen_rows_keep_a_tenth() -> None:
    places = imported_places(parse_text(MODEL, ModelConfig, "arm"))
    (effect,) = (e for e in all_effects(places) if e.key == "damping.quadratic")
    rated = Rated(Placed(effect, (), (0.1,)), None, 0.1)  # type: ignore[arg-type]
    numbers = {"d2": EffectParameter(value=0.1, unit="N m s^2/rad^2", se=0.01)}
    law = found(rated, numbers)
    assert not in_model(law, unseen=0.09).doubtful
    (doubt,) = in_model(law, unseen=0.18).doubts
    assert doubt.startswith("18 % of the squared missing force is left in the last quarter")
