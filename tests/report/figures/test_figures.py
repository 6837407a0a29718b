"""Test figures: unusual data, file size, printed numbers."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest

from levid.report.figures.bode import bode_magnitude, bode_phase
from levid.report.figures.coherence import coherence
from levid.report.figures.held_out_outputs import HeldOut, held_out_outputs
from levid.report.figures.markov_parameters import Markov, markov_parameters
from levid.report.figures.order_validation import OrderErrors, validation_errors
from levid.report.figures.response_deviation import (
    AGREEMENT,
    Bounds,
    bounds_text,
    deviation,
    worst_on_diagonal,
)
from levid.report.figures.singular_values import SingularValues, Spectrum, singular_values
from levid.report.plotting.figure_to_svg import to_svg
from levid.report.plotting.labelled_frequency_responses import (
    Curve,
    Range,
    SignalLabels,
    determined,
    inside,
    ratio,
    symbol,
)
from levid.report.plotting.min_max_envelope import Envelope, envelope, over_time
from levid.report.plotting.style import (
    PAPER,
    TRUTH,
    doubtful,
    engineering,
    line_of,
    position_label,
    power_of_ten,
    signed,
)
from levid.report.session.cycle_times import quantile_s, timing_histogram
from levid.report.session.flight_data import CycleTimes
from levid.report.session.pose_during_beam_moves import BeamRecord, beam_trajectory

pytestmark = pytest.mark.usefixtures("no_warnings")

AXES = SignalLabels(
    ("tau_psi", "tau_theta", "tau_z"),
    ("N m", "N m", "N"),
    ("psi", "theta", "z"),
    ("rad", "rad", "m"),
)
FREQ_HZ = np.geomspace(0.5, 250, 180)
RIG = Range(1.0, 100.0, 64.0, 1.0)


def resonances(freq_hz, m=3, p=3):
    s = 2j * np.pi * freq_hz[:, None, None]
    scale = 0.02 ** np.abs(np.arange(m)[:, None] - np.arange(p))
    return scale / (0.07 * s**2 + 0.3 * s + 200.0)


def curve(k=0, freq_hz=FREQ_HZ, m=3, p=3, deviation=None):
    return Curve(f"position {k}", line_of(k), freq_hz, resonances(freq_hz, m, p), deviation)


def drawn(figure):
    """Return the figure as SVG, which must be valid XML and below 300 KB."""
    svg = to_svg(figure)
    ElementTree.fromstring(svg)
    assert len(svg) < 300_000
    return svg


@pytest.mark.parametrize("positions", [1, 2, 3, 7])
def test_bode_grids_of_any_number_of_positions(positions):
    curves = [curve(k) for k in range(positions)]
    svg = drawn(bode_magnitude(curves, AXES, shown=RIG))
    assert all(f"position {k}" in svg for k in range(positions))
    assert "rad/(N m)" in svg
    drawn(bode_phase(curves, AXES, shown=RIG))


def test_bode_grids_with_truth_and_band():
    band = 0.01 * np.abs(resonances(FREQ_HZ)).max(axis=0) * np.ones((len(FREQ_HZ), 1, 1))
    truth = [Curve("truth", TRUTH, FREQ_HZ, resonances(FREQ_HZ))]
    curves = [curve(k, deviation=band) for k in range(3)]
    svg = drawn(bode_magnitude(curves, AXES, shown=RIG, truth=truth))
    assert "95 % confidence" in svg
    assert "truth" in svg
    drawn(bode_phase(curves, AXES, shown=RIG, truth=truth))


@pytest.mark.parametrize("broken", [np.nan, 0.0, np.inf])
def test_bode_grids_omit_nan(broken):
    response = resonances(FREQ_HZ)
    response[40:60] = broken
    response[:, 1, 2] = broken
    some = Curve("some", line_of(0), FREQ_HZ, response)
    nothing = Curve("none", line_of(1), FREQ_HZ, np.full_like(response, broken))
    for draw in (bode_magnitude, bode_phase):
        drawn(draw([some, nothing], AXES, shown=RIG))


@pytest.mark.parametrize("draw", [bode_magnitude, bode_phase])
def test_bode_grids_without_curves(draw):
    drawn(draw([], AXES, shown=RIG))


@pytest.mark.parametrize(("m", "p"), [(1, 1), (2, 2), (2, 1)])
def test_bode_grids_of_other_systems(m, p):
    signals = SignalLabels(("u1", "u2")[:p], ("",) * p, ("y1", "y2")[:m], ("1",) * m)
    shown = Range(float(FREQ_HZ[0]), float(FREQ_HZ[-1]))
    drawn(bode_magnitude([curve(0, m=m, p=p)], signals, shown=shown))


def test_bode_grid_on_paper_has_its_width():
    svg = to_svg(bode_magnitude([curve()], AXES, shown=RIG, sheet=PAPER), PAPER)
    assert f'width="{72 * PAPER.width_in:g}pt"' in svg


def test_dense_responses_are_thinned_within_the_range():
    """0.01 Hz to 5 kHz in steps of 0.01 Hz are half a million points, or 60 MB of SVG."""
    f = np.arange(0, 5000, 0.01)
    thin = inside(curve(freq_hz=f), RIG)
    assert len(thin.freq_hz) <= 400
    assert thin.freq_hz[0] >= RIG.low_hz
    assert thin.freq_hz[-1] <= RIG.high_hz
    drawn(bode_magnitude([curve(k, freq_hz=f) for k in range(3)], AXES, shown=RIG))


def test_ratio_of_a_response_with_itself_is_one_on_any_grid():
    reference = curve(freq_hz=np.geomspace(0.4, 300, 2000))
    # Linear interpolation of logarithms between points 0.33 % apart, at a resonance with
    # zeta = 0.04, has an error of about 1e-4.
    assert np.abs(ratio(curve(), reference) - 1).max() < 1e-3
    outside = ratio(curve(), curve(freq_hz=np.geomspace(2, 3, 50)))
    assert np.isnan(outside[0]).all()


def test_worst_error_is_the_given_one():
    response = np.ones((len(FREQ_HZ), 3, 3), complex)
    at = int(np.argmin(np.abs(FREQ_HZ - 9)))
    response[at, 1, 1] = 10 ** (-1.5 / 20) * np.exp(1j * np.radians(-12))
    response[FREQ_HZ > 64] = 10.0  # outside the range and off the diagonal, errors do not count
    response[:, 0, 1] = 10.0
    worst = worst_on_diagonal(Curve("", line_of(0), FREQ_HZ, response), RIG)
    assert worst[1].decibel == pytest.approx(1.5)
    assert worst[1].degree == pytest.approx(12)
    assert worst[1].decibel_at_hz == FREQ_HZ[at]
    assert worst[0].decibel == worst[2].decibel == 0
    assert worst[1].within(AGREEMENT)
    assert not worst[1].within(Bounds(1.0, 15.0))


def test_unknown_error_is_not_within_any_bounds():
    nothing = np.full((len(FREQ_HZ), 3, 3), np.nan, complex)
    unknown = Curve("nothing", line_of(0), FREQ_HZ, nothing)
    worst = worst_on_diagonal(unknown, RIG)
    assert not any(w.within(AGREEMENT) for w in worst)
    drawn(deviation([unknown, curve()], AXES, shown=RIG))


@pytest.mark.parametrize(("factor", "near"), [(1.1, True), (1.001, False)])
def test_error_figure_draws_the_bounds_unless_all_errors_are_far_below(factor, near):
    """The bounds of 2 dB are drawn for an error of 0.8 dB; 0.009 dB would be a flat line."""
    response = factor * np.ones((len(FREQ_HZ), 3, 3), complex)
    curves = [Curve("left", line_of(0), FREQ_HZ, response)]
    figure = deviation(curves, AXES, shown=RIG)
    assert ("±2 dB, ±15°" in drawn(figure)) == near
    assert ("dotted" in bounds_text(curves, AGREEMENT, RIG)) == near
    assert (figure.axes[0].get_ylim()[1] > 2.0) == near


def test_panels_with_unreliable_curves_only_are_hatched():
    signals = SignalLabels(("u",), ("N",), ("y",), ("m",))
    dotted = Curve(
        "left, not to be trusted", doubtful(line_of(0)), FREQ_HZ, resonances(FREQ_HZ, 1, 1)
    )
    for figure, hatched in (([dotted], True), ([dotted, curve(m=1, p=1)], False)):
        for draw in (bode_magnitude, bode_phase, deviation):
            drawing = draw(figure, signals, shown=RIG)
            assert any(p.get_hatch() for p in drawing.axes[0].patches) == hatched
            assert "not to be trusted" in drawn(drawing)


def test_responses_are_compared_where_they_are_clear_of_their_noise():
    f = np.geomspace(0.5, 400.0, 200)
    share = np.where((f < 1.0) | (f > 80.0), 0.1, 0.005)
    share[(f > 2.9) & (f < 3.3)] = 0.1  # a resonance
    share[np.argmin(np.abs(f - 200.0))] = 0.001  # by chance
    size = np.abs(resonances(f))
    measured = curve(freq_hz=f, deviation=share[:, None, None] * size)
    found = determined(Range(0.5, 400.0), [measured])
    assert found.bottom_hz == pytest.approx(1.0, rel=0.1)
    assert found.top_hz == pytest.approx(80.0, rel=0.1)
    assert determined(Range(0.5, 400.0), [measured], 50.0).top_hz == 50.0
    noise = curve(freq_hz=f, deviation=size)
    assert determined(Range(0.5, 400.0), [noise]) == Range(0.5, 400.0)


def test_singular_values_mark_the_order_and_the_noise():
    values = np.concatenate([np.geomspace(10, 1, 9), np.geomspace(0.02, 0.01, 15)])
    spectra = [
        Spectrum(t, tuple(SingularValues(f"p{k}", line_of(k), values, 0.03) for k in range(3)), 9)
        for t in ("least squares", "correlation")
    ]
    assert spectra[0].positions[0].significant == 9
    svg = drawn(singular_values(spectra))
    assert "9 states" in svg
    assert "least squares" in svg
    assert "correlation" in svg


@pytest.mark.parametrize(
    "values", [np.array([]), np.array([1.0]), np.full(24, np.nan), np.r_[np.ones(6), np.zeros(18)]]
)
def test_singular_values_of_exact_or_missing_data(values):
    drawn(singular_values([Spectrum("", (SingularValues("p", line_of(0), values),), 6)]))


def test_figure_of_many_markov_parameters_is_small():
    t = np.arange(60_000) * 1e-3
    g = np.exp(-t)[:, None, None] * np.sin(50 * t)[:, None, None] * np.ones((3, 3))
    noisy = g + np.random.default_rng(1).normal(0, 0.1, g.shape)
    estimates = [
        Markov("correlation", line_of(1), noisy, 1e-3),
        Markov("least squares", line_of(0), g, 1e-3),
    ]
    drawn(markov_parameters(estimates, AXES))
    drawn(markov_parameters([Markov("none", line_of(0), np.full((9, 3, 3), np.nan), 1.0)], AXES))


def test_coherence_of_three_positions():
    share = np.full((len(FREQ_HZ), 3, 3), 0.9, complex)
    drawn(
        coherence([Curve(f"p{k}", line_of(k), FREQ_HZ, share) for k in range(3)], AXES, shown=RIG)
    )


def test_beam_trajectory():
    t = np.arange(60_000) * 1e-3
    x = 0.08 * np.sin(t)
    record = BeamRecord(t, x, 1e-4 * x, 1e-5 * x, x)
    drawn(beam_trajectory(record))


def test_outputs_keep_their_scale_beside_an_unstable_simulation():
    t = np.arange(512.0)
    y = np.sin(0.1 * t)[:, None]
    grown = y * np.exp(0.5 * t)[:, None]
    tail = HeldOut(("y",), ("",), t, y, grown, np.array([-np.inf]), y, np.array([100.0]))
    figure = held_out_outputs(tail)
    assert figure.axes[0].get_ylim()[1] < 2
    assert "one step ahead 100.0 %" in drawn(figure)


def test_validation_errors_with_orders_that_have_no_stable_model():
    error = np.array([0.9, 0.5, np.nan, 0.2, 0.21])
    kinds = [OrderErrors("simulation", line_of(0), error, 4)]
    assert "simulation: order 4" in drawn(validation_errors(kinds))
    drawn(validation_errors([OrderErrors("none", line_of(0), np.full(5, np.nan), 1)]))


def test_timing_histogram_and_its_quantiles():
    edges = np.array([0.0, 1e-6, 1e-5, 1e-4])
    counts = np.array([50, 49, 1])
    assert quantile_s(counts, edges, 0.5) == 1e-6
    assert quantile_s(counts, edges, 0.999) == 1e-4
    assert np.isnan(quantile_s(0 * counts, edges, 0.5))
    drawn(timing_histogram(CycleTimes(edges, counts, counts, 1e-3)))
    drawn(timing_histogram(CycleTimes(edges, 0 * counts, 0 * counts, 1e-3)))


def test_envelope_preserves_every_peak():
    x = np.random.default_rng(3).normal(size=60_000).astype(np.float32)
    x[12_345], x[54_321] = 40.0, -50.0
    band = envelope(np.arange(60_000.0), x, 700)
    assert len(band.t) == 700
    assert band.high.max() == 40.0
    assert band.low.min() == -50.0
    assert np.all(band.low <= band.high)


def test_envelope_over_columns_spans_all_columns():
    x = np.stack([np.full(1000, -2.0), np.full(1000, 3.0)], axis=1)
    band = envelope(np.arange(1000.0), x, 10)
    assert set(band.low) == {-2.0}
    assert set(band.high) == {3.0}


def test_envelope_ignores_nan():
    x = np.ones(1000)
    x[:200], x[300], x[301] = np.nan, np.inf, -np.inf
    band = envelope(np.arange(1000.0), x, 10)
    assert np.isnan(band.high[:2]).all()
    assert set(band.high[2:]) == {1.0}


def test_curves_over_time_have_gaps_between_records():
    t = np.arange(1000) * 1e-3
    first, second = (Envelope(t + start, t, t) for start in (0.0, 5.0))
    band = over_time([first, second], 100)
    gaps = np.flatnonzero(np.isnan(band.low))
    assert len(gaps) == 1
    assert band.t[gaps[0]] < 1
    assert band.t[gaps[0] + 1] == 5
    whole = over_time([first, Envelope(t + 1, t, t)], 100)
    assert not np.isnan(whole.low).any()
    assert len(whole.t) <= 101


def test_bins_over_time_have_equal_duration():
    """A step of 5 s must not have as many bins as a record of 60 s."""
    short = envelope(np.arange(5_000) * 1e-3, np.ones(5_000), 1024)
    long = envelope(5 + np.arange(60_000) * 1e-3, np.ones(60_000), 1024)
    band = over_time([short, long], 650)
    assert np.count_nonzero(band.t < 5) == pytest.approx(50, abs=1)


def test_labels_and_numbers():
    assert position_label(-0.1, [-0.1, 0.0, 0.1]) == "left (−100 mm)"
    assert position_label(0.0, [-0.1, 0.0, 0.1]) == "middle (0 mm)"
    assert position_label(0.02, [0.02]) == "beam at +20 mm"
    assert position_label(None, [None]) == "plant"
    assert signed(-0.04, 1) == "0.0"
    assert power_of_ten(1e-3) == "10⁻³"
    assert power_of_ten(2e-3) == ""
    assert engineering(2e-5) == (1e6, "µ")
    assert engineering(2e-5, "1") == (1.0, "")
    assert symbol("tau_psi") == "τψ"
    assert symbol("motor_current") == "motor_current"
    assert AXES.gain_unit(2, 0) == "m/(N m)"
    assert AXES.gain_unit(2, 2) == "m/N"
