"""Test the non-rigid screening of sensor forms: the true sensor and form pass."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from declared_model_records import PLACES, SENSOR_SD, SHAPE, point, record

from levid.identification.trace.linearised.linearise_prediction_errors import linearise
from levid.identification.trace.search import nonrigid_screening
from levid.identification.trace.search.gauss_newton import Candidate, gather
from levid.identification.trace.search.regression import ColumnEvidence, gains
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.freeform import freeform_effects
from levid.model.effects.operating_range import Extent

OPTIONS = SearchOptions()
FORMS = freeform_effects(PLACES, Extent.typical(PLACES))
CANDIDATES: list[Candidate] = [(e, tuple(shape)) for e in FORMS for shape in e.grid]


@pytest.fixture(scope="module")
def biased_record():
    """Return a record in which a sensor reading depends on the beam position, by 3 noise sd."""
    made = record("moving", 21_000)
    added = np.zeros_like(made.gap)
    added[:, 4] = 3 * SENSOR_SD * np.exp(-(((made.beam[:, 0] - 0.02) / 0.03) ** 2))
    gap = made.gap + added
    e = replace(made.experiment, y=gap @ PLACES.decoupling.T)
    return replace(made, gap=gap, experiment=e)


def test_nonrigid_gain_is_most_of_the_total_gain(biased_record):
    few = [
        c for c in CANDIDATES if c[0].where == ("sensor:4",) and c[0].key.startswith("unknown.x_b")
    ]
    few += [c for c in CANDIDATES if c[0].where == ("sensor:4",) and ".wave.place" in c[0].key]
    shown = nonrigid_screening.shown_beyond(point(), biased_record, few)
    part = [g.sum() for g in gains(ColumnEvidence.gather([shown], np.zeros((0, 1))))]
    whole = [g.sum() for g in gains(gather(point(), [linearise(point(), biased_record, few)]))]
    best = int(np.argmax(whole))
    assert few[best][0].key.startswith("unknown.x_b")
    assert int(np.argmax(part)) == best
    outside = 1.0 - SHAPE[4] @ np.linalg.pinv(SHAPE)[:, 4]
    # The part in the pose counts as well, unless the filter takes it for motion.
    assert 0.9 * outside * whole[best] < part[best] < 1.1 * whole[best]


def test_forms_of_correct_sensors_are_screened_out(biased_record):
    first, rest = nonrigid_screening.asked_first(point(), CANDIDATES)
    assert len(first) + len(rest) == len(CANDIDATES)
    assert {e.where[0].partition(":")[0] for e, _ in first} == {"sensor"}
    assert not {e.where[0].partition(":")[0] for e, _ in rest} & {"sensor"}
    least = (
        OPTIONS.least_free_gain * gather(point(), [linearise(point(), biased_record, [])]).excess
    )
    shown = [nonrigid_screening.shown_beyond(point(), biased_record, first)]
    kept = nonrigid_screening.worth_columns(first, shown, SHAPE, least, 60)
    # The pose error of the middle sensor gives the corners 1/9 of its error, with opposite sign.
    assert {e.where[0] for e, _ in kept} <= {"sensor:4", *(f"sensor:{s}" for s in (0, 2, 6, 8))}
    assert any(e.identity.startswith("unknown.x_b") and e.where == ("sensor:4",) for e, _ in kept)
    assert len({e.identity for e, _ in kept}) <= 60
    assert not nonrigid_screening.worth_columns(first, shown, SHAPE, 1e9, 60)


def test_forms_of_a_sensor_with_an_accepted_effect_are_not_screened():
    """A further effect may be visible only in combination with the accepted one."""
    found = next(e for e in FORMS if e.identity == "unknown.time[10+-10]@sensor:4")
    at = replace(point(), placed=(Placed(found, (), (0.0,) * len(found.amplitudes)),))
    first, rest = nonrigid_screening.asked_first(at, CANDIDATES)
    assert "sensor:4" not in {w for e, _ in first for w in e.where}
    assert "sensor:4" in {w for e, _ in rest for w in e.where}
    assert "sensor:5" not in {w for e, _ in rest for w in e.where}


def test_named_effects_are_not_screened():
    named = [(e, tuple(e.grid[0])) for e in all_effects(PLACES)]
    assert nonrigid_screening.asked_first(point(), named) == ([], named)
