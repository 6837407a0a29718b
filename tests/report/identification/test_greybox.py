"""Test the report on a fitted model: parameters, unidentifiable ones, comparisons."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.control_loop import ControlLoop
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.identify_greybox import identify_grey_box
from levid.model.controller import pi_controller
from levid.report.figures.compute_fitted_response import places_of
from levid.report.figures.response_deviation import largest
from levid.report.identification.greybox import grey_box_numbers, grey_box_report, grey_box_words
from levid.report.identification.greybox_sections import grey_box_sections
from levid.report.identification.identification_page import identification_report
from levid.report.plotting.figure_to_svg import Picture
from levid.report.plotting.html_page import render
from levid.report.plotting.labelled_frequency_responses import SignalLabels

pytestmark = pytest.mark.usefixtures("no_warnings")

TS_S = 0.01
MASS, STIFFNESS, DAMPING, BY_SLIDE, NOISE_M = 1.6, 110.0, 0.5, 20.0, 1e-5
AXES = SignalLabels(("F",), ("N",), ("x",), ("m",))
# A cart on a spring that a slide stiffens; m and e only act together.
MODEL = {
    "levid": "model",
    "name": "<cart>",
    "dof": [{"name": "x", "unit": "m"}],
    "inputs": [{"name": "F", "unit": "N"}],
    "parameters": {
        "m": {"value": 1.0, "unit": "kg", "min": 0.1, "max": 10, "about": "<b>cart</b>"},
        "e": {"value": 0.5, "unit": "kg", "min": 0, "max": 5},
        "k": {"value": 100.0, "unit": "N/m", "min": 1, "max": 1e4},
        "d": {"value": 0.6, "unit": "N s/m", "min": 0, "max": 100},
        "c": {"value": 2.0, "unit": "N/m^2", "min": -100, "max": 100},
        "g": {"value": 9.81, "unit": "m/s^2", "fixed": True},
    },
    "scheduling": {"s": {"unit": "m", "signal": "slide_m", "min": -1, "max": 1}},
    "M": [["m + e"]],
    "D": [["d"]],
    "K": [["k + c*s"]],
}


def record(name, seed, moving, rows=600, substeps=20):
    """Simulate a record of the cart with small steps of semi-implicit Euler."""
    rng = np.random.default_rng(seed)
    s = 0.8 * np.sin(3.0 * TS_S * np.arange(rows)) if moving else np.zeros(rows)
    u, y, x, v = rng.standard_normal((rows, 1)), np.zeros((rows, 1)), 0.0, 0.0
    for i in range(rows):
        y[i] = x
        for _ in range(substeps):
            a = (u[i, 0] - DAMPING * v - (STIFFNESS + BY_SLIDE * s[i]) * x) / MASS
            v += a * TS_S / substeps
            x += v * TS_S / substeps
    y += NOISE_M * rng.standard_normal((rows, 1))
    return Experiment(
        name,
        TS_S,
        u,
        y,
        {"s": s},
        frozenset(),
        moving,
        remarks=("it <shook>",),
        noise_sd=np.array([NOISE_M]),
    )


@pytest.fixture(scope="module")
def grey():
    config = ModelConfig.model_validate(MODEL)
    return identify_grey_box(config, [record("<still>", 1, False), record("moved", 2, True)], 0.4)


def truth(_beam_m, freq_hz):
    """Return the response of the cart with the slide in the middle and a zero-order hold."""
    block = np.zeros((3, 3))
    block[:2] = [[0, 1, 0], [-STIFFNESS / MASS, -DAMPING / MASS, 1 / MASS]]
    step = expm(block * TS_S)[:2]
    z = np.exp(2j * np.pi * freq_hz * TS_S)[:, None, None]
    return np.linalg.solve(z * np.eye(2) - step[:, :2], np.tile(step[:, 2:], (len(z), 1, 1)))[:, :1]


def page_text(parts_of):
    return render("test", parts_of).replace("\u00a0", " ")


def test_report_of_a_fitted_model_alone(grey, tmp_path):
    page = identification_report(None, None, tmp_path, grey=grey)
    text = page.read_text(encoding="utf-8").replace("\u00a0", " ")
    for expected in (
        "4 parameters of the declared model",
        "fitted to 2 records together, 7 s in all",  # the first 60 % of 6 s each
        "1 more was fixed by the model file",
        "cannot be identified apart from",
        "Fig. 13 of the paper",
        "Fig. 14 of the paper",
        "4 of 5",
        "kept the declared value",
        "moving",
    ):
        assert expected in text, expected
    assert sorted(f.stem for f in (tmp_path / "figures").iterdir()) == [
        *("fitted-phase", "fitted-response"),
        *("residual-correlation", "residual-spectrum", "simulated-1"),
    ]
    assert max(f.stat().st_size for f in (tmp_path / "figures").iterdir()) < 300_000


def test_figure_14_shows_only_the_first_moving_record(grey, tmp_path):
    again = replace(
        grey,
        validations=(*grey.validations, replace(grey.validations[1], record="moved again")),
        fit=replace(grey.fit, records=(*grey.fit.records, grey.fit.records[1])),
    )
    page = identification_report(None, None, tmp_path, grey=again).read_text(encoding="utf-8")
    assert page.count("Fig. 14 of the paper") == 1
    assert (tmp_path / "figures" / "simulated-2.svg").exists()


def test_contradictions_of_model_and_records_are_reported(grey, tmp_path):
    with_remark = replace(grey, remarks=("record 'x': <held>",))
    text = identification_report(None, None, tmp_path, grey=with_remark).read_text(encoding="utf-8")
    assert "Remark: record &#39;x&#39;: &lt;held&gt;." in text


def test_names_from_files_are_escaped(grey, tmp_path):
    text = identification_report(None, None, tmp_path, grey=grey).read_text(encoding="utf-8")
    for hostile in ("<cart>", "<still>", "<b>cart", "<shook>"):
        assert hostile not in text
    assert "it &lt;shook&gt;" in text


def test_table_distinguishes_fitted_held_and_fixed_parameters(grey):
    table = grey_box_sections(grey_box_report(grey, (), AXES))[0].parts[0]
    rows = {row[0]: row for row in table.rows}
    held = grey.fit.unidentifiable[0].name
    assert held in ("m", "e")
    assert rows[held][4:] == ("held", "—", "—", "—")
    assert rows["g"][4] == "fixed"
    # c is declared as 2 and is 20: a change of 900 %, with a standard error of 0.3 / 20.
    assert float(rows["c"][6].removeprefix("+")) == pytest.approx(900, rel=0.1)


def test_parameter_at_its_bound_is_marked(grey):
    bound = replace(grey, fit=replace(grey.fit, at_bound=("k",)))
    report = grey_box_report(bound, (), AXES)
    assert "k ended at its bound" in " ".join(t.text for t in grey_box_words(report))
    assert grey_box_numbers(report)[0].verdict == "bad"
    assert "(at bound)" in page_text(grey_box_sections(report))


def test_positions_of_the_report_are_those_reached_in_the_records(grey):
    """The slide moves over ±0.8 m in one record and stays at 0 in the other."""
    low, mean, high = (p.schedule["s"] for p in places_of(grey, ()))
    assert (low, high) == pytest.approx((-0.8, 0.8), abs=0.01)
    assert low < mean < high


def test_response_is_compared_with_the_truth(grey):
    """The report compares with the truth at the middle of the slide."""
    middle = with_slide_in_the_middle(grey)
    report = grey_box_report(middle, (), AXES, truth)
    decibel, degree = largest(report.ratios["fitted model / truth"], report.shown)
    # The damping is known to 3.6 %, the resonance to 0.3 dB and 2 degrees; three times that.
    assert decibel < 1.0
    assert degree < 6.0
    assert page_text(grey_box_sections(report)).count("truth of the simulator") == 2


def with_slide_in_the_middle(grey):
    """Return the fit with the slide in the middle in all records."""
    records = tuple(
        replace(e, schedule={"s": np.zeros(len(e.y))}, moving=False) for e in grey.fit.records
    )
    return replace(grey, fit=replace(grey.fit, records=records))


def test_figure_14_says_whether_the_feed_forward_carried_the_beam(grey):
    moved, v = grey.fit.records[1], grey.validations[1]
    rows = np.zeros_like(moved.u)
    controller = pi_controller(np.ones(1), np.ones(1), TS_S)
    loops = [
        ControlLoop(rows, rows, feed_forward, rows, controller)
        for feed_forward in (moved.u, rows + 3.0)
    ]
    flown = tuple(replace(moved, loop=loop) for loop in loops)
    config = {**MODEL, "scheduling": {"s": {"unit": "m", "signal": "beam_m", "min": -1, "max": 1}}}
    pair = replace(
        grey,
        declared=ModelConfig.model_validate(config),
        validations=(replace(v, record="one"), replace(v, record="two")),
        fit=replace(grey.fit, records=flown),
    )
    page = page_text(grey_box_sections(grey_box_report(pair, (), AXES)))
    assert "one, with feed-forward; two, without feed-forward" in page
    assert "The feed-forward did not carry the beam" in page
    # Of another plant than the rig nothing is said of a beam.
    other = page_text(
        grey_box_sections(grey_box_report(replace(pair, declared=grey.declared), (), AXES))
    )
    assert "on the same axes: one and two." in other
    assert "carry" not in other


def test_report_without_a_moving_record_has_no_figure_14(grey):
    sections = grey_box_sections(grey_box_report(with_slide_in_the_middle(grey), (), AXES))
    names = [p.name for s in sections for p in s.parts if isinstance(p, Picture)]
    assert "simulated-1" not in names
    assert "No record has a moving schedule" in page_text(sections)


def test_model_without_schedule_has_one_position(grey):
    still = replace(grey, declared=grey.declared.model_copy(update={"scheduling": {}}))
    assert [p.label for p in places_of(still, ())] == ["<cart>"]


def test_coloured_errors_are_reported(grey):
    def coloured(v):
        return replace(v, whiteness=replace(v.whiteness, p_value=np.array([1e-9])))

    bad = replace(grey, validations=tuple(coloured(v) for v in grey.validations))
    report = grey_box_report(bad, (), AXES)
    assert "not white (x of <still>, x of moved)" in " ".join(
        t.text for t in grey_box_words(report)
    )
    assert "bad" in [n.verdict for n in grey_box_numbers(report) if "random" in n.value]


def test_error_far_above_the_noise_is_rated_bad(grey):
    """An error of three times the noise amplitude has 8/9 of its power outside the noise."""
    worse = tuple(replace(v, error_rms=3.0 * v.floor_rms) for v in grey.validations)
    numbers = grey_box_numbers(grey_box_report(replace(grey, validations=worse), (), AXES))
    assert [n.verdict for n in numbers if n.value == "3.00"] == ["bad"]


@pytest.mark.parametrize("broken", [np.nan, 0.0])
def test_nan_has_no_rating(grey, broken, tmp_path):
    def unknown(v):
        nothing = np.full_like(v.floor_rms, broken)
        psd = np.full_like(v.error_psd, broken)
        return replace(
            v,
            floor_rms=nothing,
            fit_percent=np.full_like(nothing, np.nan),
            error_psd=psd,
            floor_psd=psd,
            whiteness=replace(v.whiteness, p_value=np.array([np.nan])),
        )

    holes = replace(grey, validations=tuple(unknown(v) for v in grey.validations))
    identification_report(None, None, tmp_path, grey=holes)
    numbers = grey_box_numbers(grey_box_report(holes, (), AXES))
    assert len(numbers) == 1


def test_report_without_validations(grey, tmp_path):
    none = replace(grey, fit=replace(grey.fit, records=()), validations=())
    text = identification_report(None, None, tmp_path, grey=none).read_text(encoding="utf-8")
    assert "Response of the fitted model" in text
    assert "Simulated against measured" not in text


def test_equal_fits_give_equal_bytes(grey, tmp_path):
    pages = [identification_report(None, None, tmp_path / n, grey=grey) for n in ("a", "b")]
    assert pages[0].read_bytes() == pages[1].read_bytes()
