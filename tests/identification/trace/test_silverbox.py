"""Test a trace of measured data: the Silverbox, an electronic Duffing oscillator."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from levid.benchmarks.harness import silverbox
from levid.config.model import load_model
from levid.identification.trace.force_trace.force_trace_summary import force_summary
from levid.identification.trace.force_trace.trace_imported import trace_imported
from levid.identification.trace.run_trace import trace
from levid.identification.trace.worker_pool import Alone
from levid.model.effects.candidate_effects import all_effects

TRAIN = ((40_650, 48_841), (65_226, 73_417), (89_802, 97_993))
"""Rows of three eighths of the usual training data, for speed."""
SHORT = tuple((first, first + 6192) for first, _ in TRAIN)
"""About as few as a trace accepts."""
CONFIG = load_model(silverbox.MODEL)

pytestmark = pytest.mark.skipif(
    not silverbox.SOURCE.exists(),
    reason="the Silverbox's measurements are not beside this repository",
)


def test_laws_in_the_prediction_errors_reduce_the_error(tmp_path: Path) -> None:
    logs = [silverbox.imported(rows, tmp_path) for rows in SHORT]
    found = trace(logs, CONFIG, silverbox.laws_of_motion, Alone(CONFIG), lambda *_: None)
    named = [p.effect.key for p in found.found.point.placed]
    assert named[0] == "stiffness.cubic"
    unseen = silverbox.imported(silverbox.TEST, tmp_path)
    before, after = (
        silverbox.free_run_error(p, unseen) for p in (found.declared, found.found.point)
    )
    # Errors: 7 mV with a linear model, 0.65 mV with x^3, 0.24 mV with more.
    assert before > 5e-3
    assert after < 0.30e-3
    without = replace(
        found.found.point,
        placed=tuple(p for p in found.found.point.placed if p.effect.key != "stiffness.cubic"),
    )
    assert silverbox.free_run_error(without, unseen) > before / 3  # x^3 is most of the reduction


def test_cubic_stiffness_alone_is_named_in_the_missing_force(tmp_path: Path) -> None:
    logs = [silverbox.imported(rows, tmp_path) for rows in TRAIN]
    found = trace_imported(logs, CONFIG, all_effects, lambda *_: None)
    result = force_summary(found)
    assert [e["class"] for e in result["effects"]] == ["stiffness"]
    (law,) = result["effects"]
    assert law["name"] == "Cubic stiffness at y_v"
    # The linear model leaves 5.6 % of the force, x^3 less than a sixth of that.
    force = result["validation"]["force_percent"]
    assert force["before"] > 5.0
    assert force["after"] < force["before"] / 6
    assert result["validation"]["metric"] == "free_run"
    assert result["validation"]["noise_floor"] is None
