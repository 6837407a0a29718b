"""Test the identification report with and without truth."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from levid.identification.identify import identify
from levid.identification.options import Options
from levid.identification.records.record import Record
from levid.report.identification.closed_loop import (
    HO_KALMAN,
    SENSITIVITY,
    closed_loop_numbers,
    closed_loop_report,
)
from levid.report.identification.identification_page import identification_report
from levid.report.plotting.labelled_frequency_responses import SignalLabels

pytestmark = pytest.mark.usefixtures("no_warnings")

RATE_HZ = 1000.0
DOF = ("psi", "theta", "z")
AXES = SignalLabels(
    ("tau_psi", "tau_theta", "tau_z"), ("N m", "N m", "N"), DOF, ("rad", "rad", "m")
)
# Short records and responses: the tests check the report, not the estimates.
OPTIONS = Options(impulse_s=0.6, segment_s=3.0, lag_s=0.3e-3)


def flown(rig, positions):
    records = rig.records(list(positions.values()), RATE_HZ, 10.0)
    places = [place for place in positions for _ in DOF]
    named = [
        replace(record, name=f"{place}-{record.name.partition('-')[0]}")
        for record, place in zip(records, places, strict=True)
    ]
    named[0] = replace(named[0], remarks=("3 cycles with <coils> at a limit",))
    return named


@pytest.fixture(scope="module")
def truth(rig):
    return lambda beam_m, freq_hz: rig.sampled_plant(beam_m, 1 / RATE_HZ).frequency_response(
        freq_hz
    )


@pytest.fixture(scope="module")
def result(rig):
    positions = {"left": -0.1, "middle": 0.0, "right": 0.1}
    skipped = ("00-levitate.mcap: kind 'levitate' skipped, not a record of the session",)
    found = identify(flown(rig, positions), OPTIONS, skipped=skipped)
    first, *others = found.points
    first = replace(first, remarks=(*first.remarks, "it <rings>"))
    return replace(found, points=(first, *others))


@pytest.fixture(scope="module")
def open_result():
    """Return the result for a resonance with one input, two outputs and no known controller."""
    rng = np.random.default_rng(6)
    u = signal.lfilter([1], [1, -0.6], rng.normal(size=1200))
    y = np.stack([signal.lfilter(b, [1, -1.5, 0.8], u) for b in ([0, 1], [0, 0.2, 0.3])], axis=1)
    y += 0.02 * rng.normal(size=y.shape)
    record = Record("measured", 0.01, u[:, None], y, ("u",), ("V",), ("y1", "y2"), ("m", "m"))
    return identify([record], Options(segment_s=2.0, impulse_s=0.3))


@pytest.fixture(scope="module")
def with_truth(result, truth, tmp_path_factory):
    return identification_report(result, None, tmp_path_factory.mktemp("truth"), truth)


@pytest.fixture(scope="module")
def without_truth(result, tmp_path_factory):
    return identification_report(result, None, tmp_path_factory.mktemp("none"))


@pytest.fixture(scope="module")
def of_one_position(result):
    return replace(result, points=result.points[:1])


def words(page):
    return page.read_text(encoding="utf-8").replace("\u00a0", " ")


def test_page_has_the_figures_of_the_paper(result, with_truth):
    text = words(with_truth)
    for expected in (
        *("Answer", "Ho-Kalman: model order", "Ho-Kalman: plant", "agreement of the methods"),
        *("Records", "What next", "Fig. 9", "Fig. 10", "Fig. 12"),
        *("left (−100 mm)", "middle (0 mm)", "right (+100 mm)"),
        *("truth of the simulator", "rad/(N m)", f"{result.points[0].order} states"),
    ):
        assert expected in text
    drawn = {f.stem for f in (with_truth.parent / "figures").iterdir()}
    assert {name for name in drawn if "subspace" not in name} == {
        *("agreement-1", "agreement-2", "agreement-3", "coherence", "markov-parameters"),
        *("plant-ho-kalman", "plant-phase", "plant-sensitivity", "singular-values"),
    }


def test_every_figure_is_below_300_kb(with_truth):
    sizes = {f.name: f.stat().st_size for f in (with_truth.parent / "figures").iterdir()}
    assert max(sizes.values()) < 300_000, sizes


def test_remarks_and_omitted_logs_are_reported_and_escaped(without_truth):
    text = words(without_truth)
    assert "3 cycles with &lt;coils&gt; at a limit" in text
    assert "<coils>" not in text
    assert "00-levitate.mcap" in text
    assert "Beam at -100.0 mm: it &lt;rings&gt;." in text
    assert "Read the remarks" in text


def test_page_without_truth_does_not_mention_it(without_truth):
    text = words(without_truth)
    assert "Judge the model by held-out data" in text
    assert "truth of the simulator" not in text
    assert not re.search(r"agreement-2", text)
    assert "--virtual" not in text  # the records come from a real rig


def test_equal_results_give_equal_bytes(result, truth, with_truth, tmp_path):
    again = identification_report(result, None, tmp_path, truth)
    assert again.read_bytes() == with_truth.read_bytes()


def test_errors_are_relative_to_the_given_truth(result):
    """With the estimate itself as truth, changed by 10 degrees and 1 dB, these are the errors."""
    plants = {p.beam_m: p.plant for p in result.points}

    def turned(beam_m, freq_hz):
        return plants[beam_m].response(freq_hz) * 10 ** (1 / 20) * np.exp(1j * np.radians(10))

    report = closed_loop_report(result.points, AXES, turned)
    assert report.largest(f"{HO_KALMAN} / truth") == pytest.approx((1.0, 10.0))
    assert f"{SENSITIVITY} / truth" in report.ratios


def test_error_out_of_bounds_is_marked_with_advice(of_one_position, unwritten_figures, tmp_path):
    def wrong(beam_m, freq_hz):
        (point,) = of_one_position.points
        return 2.0 * point.plant.response(freq_hz)

    text = words(identification_report(of_one_position, None, tmp_path, wrong))
    assert 'class="bad"' in text
    assert "exceeds the bounds" in text


def test_nan_truth_does_not_count_as_agreement(of_one_position, tmp_path):
    def unknown(beam_m, freq_hz):
        return np.full((len(freq_hz), 3, 3), np.nan, complex)

    text = words(identification_report(of_one_position, None, tmp_path, unknown))
    assert 'class="bad"' in text
    assert 'class="good"' not in text


def doubtful(result, *positions):
    """Return the result with untrusted models at these positions only."""
    points = [
        replace(p, doubts=("it is <unstable>",) if k in positions else ())
        for k, p in enumerate(result.points)
    ]
    return replace(result, points=tuple(points))


def test_unreliable_model_is_marked_and_not_evaluated(result, truth, tmp_path):
    """Its value is ignored, here 20 dB too large at the first position."""
    worse = replace(result.points[0], from_ho_kalman=10.0 * result.points[0].from_ho_kalman)
    one = doubtful(replace(result, points=(worse, *result.points[1:])), 0)
    report = closed_loop_report(one.points, AXES, truth)
    name = f"{HO_KALMAN} / truth"
    others = closed_loop_report(one.points[1:], AXES, truth)
    assert report.largest(name) == others.largest(name)
    assert report.ho_kalman[0].doubtful
    assert not report.sensitivity[0].doubtful  # it needs no model
    text = words(identification_report(one, None, tmp_path, truth))
    assert "at beam left (−100 mm) is not reliable: it is &lt;unstable&gt;" in text
    assert 'class="doubt"><dt>model by Ho-Kalman, beam left (−100 mm): it is' in text
    assert "where it is reliable" in text
    assert "Do not use the model by Ho-Kalman at beam left" in text
    figure = (tmp_path / "figures" / "plant-ho-kalman.svg").read_text(encoding="utf-8")
    assert "left (−100 mm), not reliable" in figure


def test_numbers_are_marked_if_all_models_are_unreliable(result, truth):
    report = closed_loop_report(doubtful(result, 0, 1, 2).points, AXES, truth)
    top = f"{report.shown.top_hz:.3g}"
    by_meaning = {n.meaning: n.verdict for n in closed_loop_numbers(report)}
    for meaning, verdict in by_meaning.items():
        of_model = not meaning.startswith(SENSITIVITY)
        assert (verdict == "doubt") == of_model, meaning
    assert f"{HO_KALMAN} against the truth at worst, up to {top} Hz; not reliable" in by_meaning


def test_each_figure_number_of_the_paper_appears_once(with_truth):
    claimed = re.findall(r'class="paper">(Fig\. \d+)', words(with_truth))
    assert len(claimed) == len(set(claimed)) >= 3


def test_report_of_one_beam_position(rig, unwritten_figures, tmp_path):
    single = identify(flown(rig, {"middle": 0.02}), OPTIONS)
    text = words(identification_report(single, None, tmp_path))
    assert "+20 mm" in text


def test_responses_with_missing_frequencies_are_drawn(result, truth, tmp_path):
    point = result.points[0]
    H = point.from_sensitivity.H.copy()
    H[20:40] = np.nan
    broken = replace(point, from_sensitivity=replace(point.from_sensitivity, H=H))
    identification_report(replace(result, points=(broken,)), None, tmp_path, truth)


def test_report_without_a_known_controller(open_result, tmp_path):
    text = words(identification_report(open_result, None, tmp_path))
    assert "Identification of &#39;measured&#39;" in text
    assert "m/V" in text
    for expected in (
        "Held-out data",
        "Frequency response",
        "Order of the model",
        "one step ahead",
    ):
        assert expected in text
    fit = open_result.points[0].holdout[0].simulated_fit_percent[0]
    assert f"{fit:.1f} %" in text


def test_no_operating_point_is_an_error(result, tmp_path):
    with pytest.raises(ValueError, match="at least one operating point"):
        identification_report(replace(result, points=()), None, tmp_path)
