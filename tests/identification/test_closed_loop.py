"""Test closed-loop identification on records of 60 s with the rig's noise, against the truth."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from levid.identification.identify import identify
from levid.identification.options import Options
from levid.identification.records.record import IdentificationError, PiController
from levid.identification.results import ClosedLoopPoint, IdentificationResult
from levid.identification.results_to_json import summary

BEAM_M = (-0.1, 0.0, 0.1)


@pytest.fixture(scope="module")
def result(rig) -> IdentificationResult:
    return identify(rig.records(BEAM_M, 1000.0, 60.0), Options(lag_s=rig.LAG_S))


def _points(result: IdentificationResult) -> list[ClosedLoopPoint]:
    return [p for p in result.points if isinstance(p, ClosedLoopPoint)]


def _worst(found: np.ndarray, true: np.ndarray, freq_hz: np.ndarray) -> tuple[float, float]:
    """Return the largest error of the diagonal from 1 to 64 Hz in dB and degrees."""
    band = (freq_hz >= 1.0) & (freq_hz <= 64.0)
    ratio = np.einsum("fii->fi", found[band]) / np.einsum("fii->fi", true[band])
    return (
        float(np.abs(20 * np.log10(np.abs(ratio))).max()),
        float(np.abs(np.angle(ratio, deg=True)).max()),
    )


def test_least_squares_shows_the_order_nine_and_correlation_does_not(result):
    for point in _points(result):
        assert point.order == 9
        s = point.singular_values["least_squares"]
        assert len(s) >= 20
        # After 60 s the singular values of the noise are about 0.01, those of the integrators 0.7:
        # a ratio of 55 to 85 over seeds.
        assert s[8] / s[9] > 20
        # Self-noise of the correlation is a hundred times larger, as large as the integrators.
        s = point.singular_values["correlation"]
        assert s[8] / s[9] < 2
        ratio = (
            point.markov["correlation"].standard_error
            / point.markov["least_squares"].standard_error
        )
        assert np.all(np.diag(ratio) > 100)


def test_plant_by_ho_kalman_agrees_with_the_truth(rig, result):
    for point, x_b in zip(_points(result), BEAM_M, strict=True):
        assert point.plant.core.A.shape == (6, 6)
        true = rig.sampled_plant(x_b, 1e-3).frequency_response(point.freq_hz)
        # Over seeds 0.005 to 0.03 dB and 0.03 to 0.3 degrees; 2 dB and 15 degrees are required.
        dB, degrees = _worst(point.from_ho_kalman, true, point.freq_hz)
        assert dB < 0.1
        assert degrees < 1.0
        # Without realisation, the noise of all 6000 taps counts: up to 0.2 dB and 1.3 degrees.
        dB, degrees = _worst(point.from_markov, true, point.freq_hz)
        assert dB < 0.5
        assert degrees < 3.0


def test_plant_by_sensitivity_agrees_with_the_truth_within_its_intervals(rig, result):
    for point, x_b in zip(_points(result), BEAM_M, strict=True):
        true = rig.sampled_plant(x_b, 1e-3).frequency_response(point.freq_hz)
        for estimate in (point.from_sensitivity, point.from_joint):
            dB, degrees = _worst(estimate.H, true, point.freq_hz)
            assert dB < 2.0
            assert degrees < 15.0
            error = np.abs(estimate.H - true) / estimate.standard_deviation
            # 95 % of 9 x 150 errors; neighbouring bins share leakage, hence the wide margin.
            assert np.mean(error < 1.73) > 0.88
        assert np.all(point.loop_coherence >= 0.0)
        assert np.all(point.loop_coherence <= 1.0)


def test_model_simulates_the_held_out_data(result):
    for point in _points(result):
        assert len(point.holdout) == 3
        for axis, holdout in enumerate(point.holdout):
            assert holdout.time_s[0] == pytest.approx(45.0)
            assert len(holdout.measured) == 15_000
            # Sensor noise is 1e-3 of the excited axis' motion (0.34 of 330 urad in psi): 99.8 %.
            assert holdout.simulated_fit_percent[axis] > 99.5


def test_transient_at_the_start_of_a_record_does_not_bias_couplings(rig):
    """Couplings are 1 % of the diagonal, so an unmodelled transient would hide them."""
    records = []
    for axis, record in enumerate(rig.records([0.1], 1000.0, 66.0)):
        # Excitation of another input until row 6000, unknown to the record, which starts there.
        v = record.v.copy()
        v[:6000] = np.roll(v[:6000], 1, axis=1)
        y, u = rig.simulate(rig.sampled_plant(0.1, 1e-3), v, seed=100 + axis)
        late = replace(record, v=v[6000:], u=u[6000:], y=y[6000:], at_rest=False)
        records.append(late)
    (point,) = identify(records, Options(lag_s=rig.LAG_S)).points
    assert isinstance(point, ClosedLoopPoint)
    true = rig.sampled_plant(0.1, 1e-3).frequency_response(point.freq_hz)
    band = (point.freq_hz >= 1.0) & (point.freq_hz <= 64.0)
    # theta and z couple by the beam's m_b x_b, psi and theta by 3 N m/rad and 0.0015 kg m2.
    for i, j in ((1, 2), (2, 1), (0, 1), (1, 0)):
        error = np.abs(point.from_ho_kalman / true - 1)[band, i, j]
        assert np.median(error) < 0.05


def test_given_order_is_used_or_rejected_if_out_of_range(rig, result):
    records = rig.records([0.0], 1000.0, 40.0)
    (point,) = identify(records, Options(order=12, lag_s=rig.LAG_S)).points
    assert isinstance(point, ClosedLoopPoint)
    assert point.order == 12
    assert point.plant.core.A.shape == (9, 9)
    true = rig.sampled_plant(0.0, 1e-3).frequency_response(point.freq_hz)
    assert point.remarks == ()
    # Three additional states fit noise: less accurate, but still the plant.
    dB, _ = _worst(point.from_ho_kalman, true, point.freq_hz)
    assert dB < 0.3
    with pytest.raises(IdentificationError, match="expected an order of 1 to 24, found 99"):
        identify(records, Options(order=99))


def test_plant_at_10_khz_agrees_with_the_truth_without_decimation(rig):
    records = rig.records([0.1], 10_000.0, 16.0)
    (point,) = identify(records, Options(lag_s=rig.LAG_S, impulse_s=2.0, segment_s=4.0)).points
    assert isinstance(point, ClosedLoopPoint)
    assert point.order == 9
    true = rig.sampled_plant(0.1, 1e-4).frequency_response(point.freq_hz)
    # A quarter of the data and a response of 2 s: errors are 0.08 to 0.2 dB, 2 to 4 degrees.
    dB, degrees = _worst(point.from_ho_kalman, true, point.freq_hz)
    assert dB < 0.6
    assert degrees < 6.0


def test_progress_rises_to_one_and_the_summary_is_finite_json(rig):
    reported: list[tuple[str, float]] = []
    found = identify(
        rig.records([0.0, 0.1], 1000.0, 30.0),
        progress=lambda what, share: reported.append((what, share)),
    )
    shares = [share for _, share in reported]
    assert shares == sorted(shares)
    assert shares[0] == 0.0
    assert shares[-1] == 1.0
    assert {what for what, _ in reported} == {"beam at +0.0 mm", "beam at +100.0 mm"}
    text = json.loads(json.dumps(summary(found), allow_nan=False))
    assert text["Ts_s"] == 1e-3
    assert [p["order"] for p in text["points"]] == [9, 9]


def test_short_records_limit_the_impulse_response_with_a_remark(rig):
    records = rig.records([0.0], 1000.0, 10.0, at_rest=False)
    (point,) = identify(records, Options(lag_s=rig.LAG_S)).points
    assert isinstance(point, ClosedLoopPoint)
    assert len(point.remarks) == 2
    assert "impulse response is limited to 2.5 s" in point.remarks[0]
    true = rig.sampled_plant(0.0, 1e-3).frequency_response(point.freq_hz)
    # A sixth of the data and a response of 2.5 s: errors are 0.1 dB, 1 to 2.5 degrees.
    dB, degrees = _worst(point.from_ho_kalman, true, point.freq_hz)
    assert dB < 0.5
    assert degrees < 6.0


def test_joint_estimate_replaces_equation_15_for_an_axis_without_feedback(rig):
    records = rig.records([0.0], 1000.0, 10.0, at_rest=False)
    # The records have feedback on z; only the choice of the estimate is tested.
    controller = PiController(rig.KP * [1, 1, 0], rig.KI * [1, 1, 0])
    (point,) = identify(
        [replace(r, controller=controller) for r in records], Options(lag_s=rig.LAG_S)
    ).points
    assert isinstance(point, ClosedLoopPoint)
    assert point.from_sensitivity is point.from_joint
    assert any("no feedback from z" in text for text in point.remarks)


def test_invalid_options_are_rejected():
    with pytest.raises(IdentificationError, match="correlation, least_squares, found 'welch'"):
        Options(markov="welch")
    with pytest.raises(IdentificationError, match=r"holdout: expected a share of 0 to 0\.5"):
        Options(holdout=0.9)
    with pytest.raises(IdentificationError, match="segment_s: expected a positive"):
        Options(segment_s=0.0)
