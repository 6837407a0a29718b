"""Test what a model fitted to the outputs says of noise that is larger at low frequencies."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from levid.benchmarks.trace.imported_plant_cases import low_pass_noise
from levid.benchmarks.trace.imported_plant_simulation import Acting, Kind, Linear, simulated
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_balance.reported_errors import PooledError
from levid.identification.trace.force_checks.output_error_fit import as_close
from levid.identification.trace.force_trace.force_trace_outcome import force_outcome
from levid.identification.trace.force_trace.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.base import Effect, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent
from levid.report.trace.answer import imported_answer

MASS = """
levid: model
name: mass
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
parameters:
  m: {value: 2.4, unit: kg, min: 0}
  d: {value: 12, unit: N s/m, min: 0}
  k: {value: 800, unit: N/m, min: 0}
M: [[m]]
D: [[d]]
K: [[k]]
"""
TS, ROWS, SHARE = 2e-3, 10_000, 0.005
WANDERS = 0.97
"""Coefficient of the noise: at 500 Hz below 2.4 Hz there is a thousand times what is at 250 Hz."""


def traced(friction_n: float, wanders: float, kind: str = "") -> ForceTrace:
    """Trace a mass on a spring with noise of 0.5 % of its motion, against effects of one class."""
    none = np.zeros((1, 1))
    plant = Linear(
        np.array([[2.0]]), np.array([[15.0]]), np.array([[1000.0]]), np.eye(1), none, none,
        np.zeros(1), TS, 10,
    )  # fmt: skip
    rubs = [Acting(Kind.COULOMB, 0, np.array([friction_n, 0.002]))] if friction_n else []
    config, records = parse_text(MASS, ModelConfig, "mass"), []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        moved = simulated(plant, 8.0 * low_pass_noise(rng, ROWS, TS, 8.0)[:, None], rng, *rubs)
        noise = lfilter([1.0], [1.0, -wanders], rng.standard_normal((ROWS, 1)), axis=0)
        y = moved.y + SHARE * moved.y.std() * noise / noise.std()
        record = Experiment(f"{seed}", TS, moved.u, y, {}, frozenset(), False)
        records.append(imported_trace_record(record, config))

    def table(places: Places, extent: Extent) -> list[Effect]:
        return [e for e in all_effects(places, extent) if e.effect_class == kind]

    return trace_records(records, config, table, lambda *_: None)


def test_a_model_within_its_noise_of_the_outputs_is_said_to_be_so() -> None:
    found = traced(0.0, WANDERS)
    assert found.outputs is not None
    # The filter takes noise that wanders in the first seconds for motion, from which a run begins.
    assert found.outputs.percent == pytest.approx(100.0 * SHARE, rel=0.5)
    outcome = force_outcome(found)
    assert outcome.lacks_something
    assert imported_answer(outcome).endswith(
        "the model without effects is within "
        f"{outcome.check.outputs:.2g} % of them; state noise_sd in the signals file."
    )


def test_an_effect_that_is_there_is_closer_to_the_outputs() -> None:
    found = traced(1.0, 0.0, "friction")
    (law,) = force_outcome(found).laws
    assert law.doubts == ()
    assert np.isnan(force_outcome(found).check.outputs)


@pytest.mark.parametrize(
    ("percent", "found", "effects", "close"),
    [
        ((0.5, 0.4), (0.6, 0.4), 1, True),
        ((0.5, 0.4), (0.6, 0.39), 1, False),
        ((0.5, 0.4), (np.nan, np.nan), 1, True),
        ((1.5, 0.4), (np.nan, np.nan), 1, False),
        ((1.5, 0.4), (1.4, 0.4), 0, True),
        ((6.0, 0.4), (6.0, 0.4), 0, False),
        ((np.nan, 0.4), (np.nan, np.nan), 1, False),
    ],
)
def test_a_model_without_effects_is_as_close_as_the_found_one(
    percent: tuple[float, ...], found: tuple[float, ...], effects: int, close: bool
) -> None:
    def errors(values: tuple[float, ...]) -> PooledError:
        each = np.array(values)
        return PooledError(each, each, each, each, each)

    told = as_close(errors(percent), errors(found), effects, SearchOptions())
    assert told == close
    assert not as_close(None, errors(found), effects, SearchOptions())
