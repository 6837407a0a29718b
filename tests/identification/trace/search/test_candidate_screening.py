"""Test the screening of candidates: agreement of held-out records, thresholds to be fitted."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from effect_test_helpers import rig_places

from levid.identification.trace.search import candidate_screening
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.freeform import freeform_effects
from levid.model.effects.operating_range import Extent

NAMED = {e.identity: e for e in all_effects(rig_places())}


@pytest.mark.parametrize(
    ("blocks", "expected_statistic", "held_out_statistic", "between_blocks", "evidence"),
    [
        (20, 2.0, 1.0, 25.0, (25.0, False)),  # no effect in held-out records
        (20, 4.5, 4.5, 100.0, (100.0, False)),  # too small in them to reach a statistic of six
        (20, 4.5, 1.0, 100.0, (1.0, True)),  # less than expected: they contradict
        (20, 4.5, 4.5, 15.0, (4.5, True)),  # the fitted records are uncertain
        (20, 4.5, 6.5, 100.0, (6.5, True)),
        (20, 30.0, 4.0, 100.0, (4.0, True)),
        (4, 30.0, 30.0, 12.0, (12.0, True)),  # too few blocks for a scatter
        (4, 30.0, 8.0, 50.0, (8.0, True)),
    ],
)
def test_agreement_comes_from_held_out_records_that_show_the_effect(
    monkeypatch: pytest.MonkeyPatch,
    blocks: int,
    expected_statistic: float,
    held_out_statistic: float,
    between_blocks: float,
    evidence: tuple[float, bool],
) -> None:
    monkeypatch.setattr(candidate_screening, "expected", lambda *_: expected_statistic)
    monkeypatch.setattr(candidate_screening, "chance", lambda *_: held_out_statistic)
    monkeypatch.setattr(candidate_screening, "chance_between", lambda *_: between_blocks)
    held = SimpleNamespace(size=np.ones(3), blocks=blocks)
    assert candidate_screening._agrees(SimpleNamespace(), held, 1, np.ones(2)) == evidence


@pytest.mark.parametrize(
    ("identity", "share", "chance", "fitted"),
    [
        # A dead zone two thirds too wide acts in held-out records, the right one does not.
        ("dead_zone@coil:7", 0.6, -0.9, True),
        ("dead_zone@coil:7", 0.4, -0.9, False),
        ("dead_zone@coil:7", 0.4, 2.5, True),
        # A fit cannot improve an effect without shape parameters.
        ("coil_gain@coil:7", 0.6, -0.9, False),
        ("coil_gain@coil:7", 0.6, 6.5, True),
    ],
)
def test_candidate_with_shape_parameters_that_explains_half_is_fitted(
    identity: str, share: float, chance: float, fitted: bool
) -> None:
    effect = NAMED[identity]
    least = candidate_screening.Least(1e6, 0.0, little=False, visible=0.0)
    tried = candidate_screening.Tried(
        effect, effect.grid[0], share * 1e6, np.ones(3), (1.0,), chance
    )
    assert least.taken_by(tried) is fitted


@pytest.mark.parametrize(
    ("identity", "taken"),
    [
        ("rod_stiffness.cubic@psi", False),
        # Another law of friction may be the right one; that is decided elsewhere.
        ("friction.dahl@psi", True),
        ("rod_stiffness.cubic@z", True),
        ("coil_gain@coil:7", True),
        ("flexible_mode.saddle@", True),  # without a single location
    ],
)
def test_small_residual_of_friction_gives_no_further_effect_at_its_dof(
    identity: str, taken: bool
) -> None:
    """For example, eight slip elements instead of twenty leave 1/500 of the friction's share."""
    effect = NAMED[identity]
    least = candidate_screening.Least(2e5, 1e8, little=False, visible=0.0, rubbed={"psi": 1e8})
    tried = candidate_screening.Tried(effect, effect.grid[0], 2e5, np.ones(3), (1.0,), 90.0)
    assert least.taken_by(tried) is taken
    assert least.taken_by(replace(tried, gain=3e5))


def test_free_form_of_fewer_signals_is_preferred() -> None:
    forms = {e.identity: e for e in freeform_effects(rig_places(), Extent.typical(rig_places()))}
    alone, product = (
        next(e for name, e in forms.items() if name.startswith(key) and name.endswith("@theta"))
        for key in ("unknown.v_b[", "unknown.v_b[0.4]*theta[")
    )
    assert candidate_screening._told(alone, 95.0) > candidate_screening._told(product, 100.0)
    assert candidate_screening._told(alone, 85.0) < candidate_screening._told(product, 100.0)
    named = NAMED["rod_stiffness.cubic@psi"]
    assert candidate_screening._told(named, 7.0) == 7.0


@pytest.mark.parametrize(
    ("share", "first_guess", "taken"),
    [(0.2, False, True), (0.05, False, False), (0.05, True, True), (0.02, True, False)],
)
def test_initial_guess_of_a_resonance_has_a_lower_threshold(
    share: float, first_guess: bool, taken: bool
) -> None:
    """A broad guess at 3 Hz explains 1/20 of a narrow resonance at 2 Hz, which the fit finds."""
    forms = freeform_effects(rig_places(), Extent.typical(rig_places()))
    kind = "unknown.answer.x_b" if first_guess else "unknown.psi["
    effect = next(e for e in forms if e.key.startswith(kind) and e.where == ("theta",))
    least = candidate_screening.Least(1e6, 0.0, little=False, visible=0.0)
    tried = candidate_screening.Tried(effect, effect.grid[0], share * 1e6, np.ones(3), (1.0,), 9.0)
    assert least.taken_by(tried) is taken
