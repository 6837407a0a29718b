"""Test the report on the subspace method: uncertainties, modes, comparisons."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from levid.identification.identify import identify
from levid.identification.options import Options
from levid.identification.subspace.response_uncertainty import SURE_95
from levid.report.identification.closed_loop import HO_KALMAN
from levid.report.identification.subspace import (
    SUBSPACE,
    subspace_numbers,
    subspace_report,
    subspace_sections,
    subspace_words,
)
from levid.report.plotting.html_page import Table, Text
from levid.report.plotting.labelled_frequency_responses import CONFIDENCE, RIG_SIGNALS

DOF, UNITS = ("psi", "theta", "z"), ("N m", "N m", "N")


@pytest.fixture(scope="module")
def points(rig):
    records = rig.records([0.05], 1e3, 10.0)
    # A short response: the tests check the report, not Ho-Kalman.
    return identify(records, Options(impulse_s=0.6, segment_s=3.0, lag_s=0.3e-3)).points


@pytest.fixture(scope="module")
def truth(rig):
    return lambda beam_m, freq_hz: rig.sampled_plant(beam_m, 1e-3).frequency_response(freq_hz)


def _tables(report):
    (section,) = subspace_sections(report)
    return [part for part in section.parts if isinstance(part, Table)]


def test_modes_agree_with_the_rig_within_their_errors(points, rig):
    model = points[0].subspace
    M, D, K = rig.matrices(0.05)
    zero, inverse = np.zeros((3, 3)), np.linalg.inv(M)
    s = np.linalg.eigvals(np.block([[zero, np.eye(3)], [-inverse @ K, -inverse @ D]]))
    true_hz = np.sort(np.abs(s[s.imag > 0])) / (2 * np.pi)
    assert np.all(np.abs(model.modes.frequency_hz - true_hz) < 4 * model.modes.frequency_se_hz)
    modes = _tables(subspace_report(points, RIG_SIGNALS))[1]
    assert len(modes.rows) == 3
    for row, f, se in zip(
        modes.rows, model.modes.frequency_hz, model.modes.frequency_se_hz, strict=True
    ):
        value, half = (float(x) for x in row[1].split(" ± "))
        # Half of the 95 % interval has two digits; the value ends at the same decimal place.
        assert half == pytest.approx(1.96 * se, rel=0.06)
        assert value == pytest.approx(f, abs=0.06 * half)


def test_error_against_the_truth_is_reported(points, truth):
    report = subspace_report(points, RIG_SIGNALS, truth)
    assert list(report.ratios) == [f"{SUBSPACE} / truth", f"{HO_KALMAN} / {SUBSPACE}"]
    values = [number.value for number in subspace_numbers(report)]
    assert len(values) == 2
    (words,) = subspace_words(report)
    assert isinstance(words, Text)
    assert "of the simulator's truth" in words.text
    assert "the most accurate model" in words.text


def test_report_without_truth_does_not_mention_it(points):
    report = subspace_report(points, RIG_SIGNALS)
    assert list(report.ratios) == [f"{HO_KALMAN} / {SUBSPACE}"]
    assert "truth" not in subspace_words(report)[0].text
    assert len(subspace_numbers(report)) == 1


def test_unreliable_model_is_not_recommended(points):
    unreliable = replace(points[0], subspace=replace(points[0].subspace, doubts=("it is odd",)))
    (words,) = subspace_words(subspace_report([unreliable], RIG_SIGNALS))
    assert "not reliable at" in words.text
    assert "the most accurate model" not in words.text
    assert unreliable.recommended is not unreliable.subspace.plant


def test_a_residual_that_is_not_white_is_said(points):
    found = replace(points[0].subspace.found, worst=100.0, worst_hz=126.75)
    nonlinear = replace(points[0], subspace=replace(points[0].subspace, found=found))
    (words,) = subspace_words(subspace_report([nonlinear], RIG_SIGNALS))
    assert "At 127 Hz a part of the response is no mode" in words.text


def test_positions_without_a_model_are_left_out(points):
    without = replace(points[0], subspace=None)
    assert len(subspace_report([without, points[0]], RIG_SIGNALS).models) == 1
    with pytest.raises(ValueError, match="at least one position with a model by subspace"):
        subspace_report([without], RIG_SIGNALS)


def test_phases_have_their_own_uncertainty(points):
    # At a resonance of uncertain frequency, the response varies along its circle.
    (curve,) = subspace_report(points, RIG_SIGNALS).curves
    r = points[0].subspace.response
    at = int(np.argmax(np.abs(r.H[:, 2, 2])))
    own = SURE_95 * r.phase_deviation_rad[at, 2, 2]
    assert CONFIDENCE * curve.phase_deviation_rad[at, 2, 2] == pytest.approx(own)
    assert not np.allclose(
        curve.phase_deviation_rad, curve.deviation / np.abs(curve.response), rtol=0.1
    )
