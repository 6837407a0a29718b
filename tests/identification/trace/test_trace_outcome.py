"""Test the verdict of a trace: when the named effects are in doubt."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from effect_test_helpers import rig_places

from levid.identification.trace.trace_outcome import Evidence, FoundEffect, Outcome, telling
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.freeform import freeform_effects
from levid.model.effects.operating_range import Extent

EXTENT = Extent((1e-4,) * 3, (1e-2,) * 3, 1e-4, 12.0, 0.2)
COIL = next(e for e in all_effects(rig_places()) if e.identity == "coil_gain@coil:6")
FREE = next(e for e in freeform_effects(rig_places(), EXTENT) if e.where == ("psi",))
CUBIC = next(e for e in all_effects(rig_places()) if e.identity == "rod_stiffness.cubic@z")


def result(before: float, after: float, *, named: bool = True) -> Outcome:
    effects = (FoundEffect(Placed(CUBIC, (), (1.0,)), None),) if named else ()
    return Outcome(effects, (), before, after, 1.0, (), after**2, 1.0, (), (), ())


def without_effects(mean_square: float = 1.0, *, measured: bool = True) -> Outcome:
    return Outcome((), (), 1.0, 1.0, 1.0, (), mean_square, 1.0, (), (), (), noise_measured=measured)


@pytest.mark.parametrize(
    ("before", "after", "doubtful"),
    [
        (20.0, 14.0, True),  # half of the error remains: another effect exists
        (20.0, 5.0, False),  # much remains, but the effect explains 94 %
        (20.0, 1.0, False),
        (2.5, 1.9, False),  # little remains
        (2.5, 2.4, True),
        (20.0, 20.0, True),
    ],
)
def test_effects_that_explain_little_of_a_large_error_are_in_doubt(
    before: float, after: float, doubtful: bool
) -> None:
    found = result(before, after)
    assert found.doubtful is doubtful
    assert found.verdict.startswith("perhaps: Cubic" if doubtful else "found: Cubic")


@pytest.mark.parametrize(("left", "doubtful"), [(0.0, False), (0.02, False), (0.13, True)])
def test_an_effect_that_leaves_a_tenth_of_what_it_takes_is_in_doubt(
    left: float, doubtful: bool
) -> None:
    """A cable chain's friction took 84 % of a covered beam's drag, and left 1.07 floors."""
    sure, named, free = (
        FoundEffect(Placed(effect, (), (1.0,)), Evidence(9.0, False, 1e5, 1.0, 1, (), left_share=x))
        for effect, x in ((COIL, 0.01), (CUBIC, left), (FREE, 0.5))
    )
    found = Outcome((sure, named, free), (), 1.5, 1.07, 1.0, (), 1.1, 1.0, (), (), ())
    assert [found.in_doubt(f) for f in found.effects] == [False, doubtful, False]
    assert found.doubtful is doubtful
    perhaps = f"perhaps: {CUBIC.name}" if doubtful else f"found: {COIL.name}, {CUBIC.name}"
    assert perhaps in found.verdict


def test_effect_at_the_location_of_a_free_form_may_be_part_of_it() -> None:
    forms = freeform_effects(rig_places(), EXTENT)
    at_z, at_psi = (next(e for e in forms if e.where == (dof,)) for dof in ("z", "psi"))
    cubic = FoundEffect(Placed(CUBIC, (), (1.0,)), None)
    for form, expected in ((at_z, (at_z.name,)), (at_psi, ())):
        free = FoundEffect(Placed(form, (), (0.0,) * len(form.amplitudes)), None)
        found = Outcome((cubic, free), (), 20.0, 2.0, 1.0, (), 4.0, 1.0, (), (), ())
        assert found.perhaps_part_of(cubic) == expected
        assert found.perhaps_part_of(free) == ()
        assert ("perhaps a part of" in found.verdict) == bool(expected)


def test_common_effect_of_all_coils_may_be_part_of_a_free_force_on_a_dof() -> None:
    """For example, steel attracts the beam, and the coils explain a part of this force."""
    forms = {e.where: e for e in freeform_effects(rig_places(), EXTENT)}
    effects = [e for e in all_effects(rig_places()) if e.key == "force_constant.linear"]
    of_all, of_one = (
        next(e for e in effects if len(e.where) == count and "coil:3" in e.where)
        for count in (9, 1)
    )
    for where, expected in ((("theta",), (True, False)), (("sensor:3",), (False, False))):
        form = forms[where]
        free = FoundEffect(Placed(form, (), (0.0,) * len(form.amplitudes)), None)
        for effect, doubted in zip((of_all, of_one), expected, strict=True):
            named = FoundEffect(Placed(effect, (), (1.0,)), None)
            found = Outcome((named, free), (), 20.0, 2.0, 1.0, (), 4.0, 1.0, (), (), ())
            assert found.perhaps_part_of(named) == ((form.name,) if doubted else ())


def test_result_without_effects_is_not_in_doubt() -> None:
    assert not result(20.0, 19.0, named=False).doubtful
    assert math.isnan(result(0.9, 1.0).explained)
    assert not result(0.9, 1.0).doubtful


def test_errors_far_below_the_noise_show_an_overestimated_noise() -> None:
    expected = without_effects(0.3)
    assert expected.overrated
    assert not expected.significant
    assert expected.verdict.startswith("no conclusion: the one-step errors have only 0.3 of")
    assert not without_effects(0.9).overrated
    assert (
        without_effects(0.9).verdict
        == "nothing found: the model explains the records down to the noise"
    )


def test_nothing_is_claimed_of_a_residual_without_measured_noise() -> None:
    unknown = "no record tells noise from the model's error"
    assert without_effects(measured=False).verdict.endswith(unknown)
    assert "nothing found" not in without_effects(measured=False).verdict
    assert result(20.0, 1.0).rest == "the residual is noise"
    assert replace(result(20.0, 1.0), noise_measured=False).rest == f"residual: {unknown}"


def test_distinguishing_experiments_are_listed_for_effect_and_rival() -> None:
    rival = next(e for e in all_effects(rig_places()) if e.identity == "air_damping.quadratic@z")
    evidence = Evidence(9.0, True, 100.0, 0.5, 1, (rival,))
    found = FoundEffect(Placed(CUBIC, (), (1.0,)), evidence)
    assert telling(found) == f"{CUBIC.told_apart_by}; or {rival.told_apart_by}"
    assert telling(replace(found, evidence=None)) == CUBIC.told_apart_by


def test_every_free_form_has_a_distinguishing_experiment() -> None:
    assert all(e.told_apart_by for e in freeform_effects(rig_places(), EXTENT))


def test_verdict_exists_for_every_effect_with_free_forms() -> None:
    """Bending modes have no single location."""
    places = rig_places()
    free = tuple(
        FoundEffect(Placed(form, (), (0.0,) * len(form.amplitudes)), None)
        for form in freeform_effects(places, EXTENT)
    )
    for effect in all_effects(places):
        named = FoundEffect(Placed(effect, (), (1.0,) * len(effect.amplitudes)), None)
        found = Outcome((named, *free), (), 20.0, 2.0, 1.0, (), 4.0, 1.0, (), (), ())
        assert effect.name in found.verdict
        assert effect.where or not found.perhaps_part_of(named)
