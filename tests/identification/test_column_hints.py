"""Identify a mass on a spring whose columns are in another unit, exchanged, or of another sign."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mass_on_spring_logs import AT_50_HZ, imported

from levid.benchmarks.harness.loops_under_noise import Loop
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.nonparametric.feedback_test import feedback_findings, input_origins
from levid.identification.options import Options
from levid.identification.run_identification import Study, study
from levid.identification.trace.force_checks.columns_in_another_unit import common_factor
from levid.report.identification.chapters import identification_answer

ROWS = 800
MODEL = """
levid: model
name: spring
dof: [{name: x_m, unit: m}]
inputs: [{name: f_n, unit: N}]
parameters:
  m: {value: 1.2, unit: kg, min: 0.000001, max: 1000000}
  d: {value: 1.7, unit: N s/m, min: 0.000001, max: 1000000}
  k: {value: 45, unit: N/m, min: 0.000001, max: 1000000}
M: [[m]]
D: [[d]]
K: [[k]]
"""
PLANT = Loop(Ts_s=0.02, force=0.01, sensor=1e-5)


def identified(folder: Path, *factors: tuple[float, float]) -> Study:
    """Identify records whose force and position are multiplied by factors, one pair for each."""
    logs = []
    for k, of in enumerate(factors):
        u = np.random.default_rng(k).normal(size=ROWS)
        r = PLANT.record(ROWS, k, given=u)
        logs.append(imported(folder, str(k), np.hstack([r.v, r.y]) * of, AT_50_HZ))
    model = parse_text(MODEL, ModelConfig, "model")
    return study(logs, lambda _log: model, Options(order=2))


def answer(found: Study) -> str:
    return identification_answer(found.points, found.grey, found.multisine)


def test_right_columns_give_no_hint(tmp_path: Path) -> None:
    found = identified(tmp_path, (1.0, 1.0))
    assert found.grey is not None
    assert (found.grey.columns, found.grey.doubts) == ("", ())
    assert answer(found).startswith("Use the fitted model")


@pytest.mark.parametrize("factors", [(1.0, 1000.0), (1000.0, 1.0)])
def test_a_column_in_thousandths_is_named_whether_the_model_fits_or_not(
    factors: tuple[float, float], tmp_path: Path
) -> None:
    """Positions in mm ended in 'the model is too fast'; currents in mA in a black-box model."""
    text = answer(identified(tmp_path, factors))
    # All parameters are free, so that a record has the ratio of the columns only.
    for column, size in (("x_m", factors[1]), ("f_n", factors[0])):
        too = "large" if size > 1.0 else "small"
        assert re.search(rf"{column} is in another unit, \d+ times too {too}", text), text
    assert "Compare columns, signs and units in the signals file" in text


def test_a_sign_is_that_of_the_input_or_the_output(tmp_path: Path) -> None:
    text = answer(identified(tmp_path, (1.0, -1.0)))
    assert "x_m has the other sign, or f_n has the other sign" in text
    assert "Declare the loop" not in text


def test_one_record_of_another_sign_is_named(tmp_path: Path) -> None:
    found = identified(tmp_path, (1.0, 1.0), (1.0, -1.0), (1.0, 1.0))
    assert "x_m has the other sign in record '1'" in answer(found)
    assert found.points is not None
    (point,) = found.points.points
    assert "in record '1', or the input" in point.doubts[0]  # which needs no declared model


@pytest.mark.parametrize("seed", range(4))
def test_exchanged_inputs_and_outputs_are_no_loop(seed: int) -> None:
    u = np.random.default_rng(seed).normal(size=2000)
    right = PLANT.record(2000, seed, given=u)
    (origin,) = input_origins([right])
    assert not origin.fed_back
    (origin,) = input_origins([replace(right, v=right.y, y=right.v)])
    assert origin.follows
    (doubt,) = feedback_findings([origin], declared=False).doubts
    assert doubt.startswith("it looks as if inputs and outputs are exchanged")


@pytest.mark.parametrize("seed", range(4))
def test_a_loop_without_excitation_is_no_exchange(seed: int) -> None:
    """Its input follows the output at once, or after the controller's delay."""
    for loop in (Loop(), Loop(kd=0.3, ki=0.0, input=0.003), Loop(kp=10.0, delay=2)):
        record = loop.record(2000, seed)
        late = replace(record, v=np.roll(record.v, 2, axis=0)[2:], y=record.y[2:])
        for one in (record, late):
            (origin,) = input_origins([one])
            assert not origin.follows


def test_parameters_that_grew_together_are_no_poor_guess() -> None:
    declared = np.array([1.0, 2.0, 50.0, 0.0])
    assert common_factor(900.0 * declared * [1.2, 0.8, 1.0, 1.0], declared) == pytest.approx(900)
    assert common_factor(2.0 * declared, declared) == 1.0  # a guess may be so poor
    assert common_factor(declared * [900.0, 3.0, 0.1, 1.0], declared) == 1.0
    assert common_factor(900.0 * declared[:2], declared[:2]) == 1.0
