"""Test identification without a known controller, on a known system and on measured data."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from repository_folders import ROOT
from scipy.signal import lfilter

from levid.identification.identify import identify
from levid.identification.options import Options
from levid.identification.records.record import IdentificationError, Record
from levid.identification.results import OpenLoopPoint
from levid.identification.subspace import starting_models
from levid.identification.subspace.identify_innovation_model import innovation_model
from levid.identification.subspace.simulation import simulate
from levid.model.second_order import StateSpace

DATA = ROOT.parent / "shared" / "data"

TRUE = StateSpace(
    np.array([[0.95, 0.2, 0.0, 0.0], [-0.2, 0.95, 0.0, 0.0], [0, 0, 0.8, 0.4], [0, 0, -0.4, 0.8]]),
    np.array([[0.0, 0.3], [1.0, 0.0], [0.5, 1.0], [0.0, 0.5]]),
    np.array([[1.0, 0.0, 0.5, 0.0], [0.0, 0.5, 1.0, 0.0]]),
    np.array([[0.0, 0.0], [0.1, 0.0]]),
    0.02,
)


def _records(seed: int, count: int = 1, rows: int = 2400) -> list[Record]:
    """Return records of TRUE under coloured, correlated inputs, with noise and offsets."""
    rng = np.random.default_rng(seed)
    records = []
    for number in range(count):
        u = lfilter([1.0], [1.0, -0.9], rng.normal(size=(rows, 2)), axis=0)
        u[:, 1] += 0.5 * u[:, 0]
        y = simulate(TRUE, u, rng.normal(size=4))
        y += 0.01 * y.std(axis=0) * rng.normal(size=y.shape) + [3.0, -1.0]
        records.append(
            Record(f"r{number}", 0.02, u + 2.0, y, ("a", "b"), ("N", "N"), ("c", "d"), ("m", "m"))
        )
    return records


@cache
def _identified(seed: int, count: int = 1) -> OpenLoopPoint:
    """Return the result for `_records`, which several tests use."""
    (point,) = identify(_records(seed, count)).points
    assert isinstance(point, OpenLoopPoint)
    return point


@pytest.mark.parametrize("count", [1, 2])
def test_known_system_is_identified_from_coloured_inputs(count):
    point = _identified(1, count)
    assert point.order == 4
    true = TRUE.response(point.response.freq_hz)
    low = point.response.freq_hz < 10.0  # above, the inputs have less than 1 % of their power
    error = np.abs(point.response.H - true)[low] / np.abs(true).max()
    # Noise of 1 %, 1800 rows and 28 parameters give 1e-3, and ten times that where inputs are weak.
    assert error.max() < 0.01
    for holdout in point.holdout:
        # The noise is 1 %.
        assert np.all(holdout.simulated_fit_percent > 98.5)
        assert holdout.predicted_fit_percent is not None
        assert np.all(holdout.predicted_fit_percent > 98.0)
        assert len(holdout.time_s) == 600


@pytest.mark.parametrize("seed", [3, 4, 5, 6, 7])
def test_true_order_is_found_for_every_noise_seed(seed):
    point = _identified(seed)
    # With fewer states the error is 20 times the noise; more states win with a probability of 4 %.
    assert point.order == 4
    # The noise does not fit the predictor's structure, which costs a state or two.
    assert 4 <= point.predictor_order <= 6


def test_given_order_is_used():
    (point,) = identify(_records(2), Options(order=6)).points
    assert isinstance(point, OpenLoopPoint)
    assert (point.order, point.predictor_order) == (6, 6)
    assert len(point.model.A) == 6


def test_impulse_response_is_as_long_as_validation_asks() -> None:
    rng = np.random.default_rng(4)
    u = rng.normal(size=(4000, 1))
    # Poles of 0.9 have decayed to 0.5 % after 50 rows, those of 0.99 to 13 % after 200.
    for pole, taps in ((0.9, 50), (0.99, 200)):
        y = lfilter([0.0, 1.0], [1.0, -pole], u, axis=0)
        y += 0.05 * y.std() * rng.normal(size=y.shape)
        record = Record("r", 0.02, u, y, ("u",), ("N",), ("y",), ("m",))
        (point,) = identify([record], Options(order=1)).points
        assert isinstance(point, OpenLoopPoint)
        assert point.impulse.chosen_by == "validation"
        assert sorted(point.impulse.validation_error) == [50, 100, 200]
        assert point.impulse.taps == len(point.markov["least_squares"].g) == taps
        (given,) = identify([record], Options(order=1, impulse_s=0.8)).points
        assert isinstance(given, OpenLoopPoint)
        assert (given.impulse.taps, given.impulse.chosen_by) == (40, "given")
        # The refinement makes the model independent of the length: by a tenth of its error.
        error = point.modes.frequency_se_hz[0]
        assert given.modes.frequency_hz[0] == pytest.approx(
            point.modes.frequency_hz[0], abs=0.1 * error
        )


def test_held_out_data_do_not_affect_the_model():
    (record,) = _records(3)
    spoilt = record.y.copy()
    spoilt[1800:] = 0.0
    first = _identified(3)
    (second,) = identify([Record(**{**record.__dict__, "y": spoilt})]).points
    assert isinstance(second, OpenLoopPoint)
    np.testing.assert_array_equal(first.model.A, second.model.A)
    np.testing.assert_array_equal(first.predictor.K, second.predictor.K)


@pytest.mark.parametrize("noise", [0.0, 1e-8, 1e-6])
def test_data_without_noise_are_identified(noise):
    (record,) = _records(1)
    rng = np.random.default_rng(1)
    y = simulate(TRUE, record.v, rng.normal(size=4))
    y += noise * y.std(axis=0) * rng.normal(size=y.shape)
    (point,) = identify([replace(record, y=y)]).points
    assert isinstance(point, OpenLoopPoint)
    assert point.order == 4
    (holdout,) = point.holdout
    # The impulse response, truncated to 4 rows per tap, has an error of 0.3 %.
    assert np.all(holdout.simulated_fit_percent > 99.0)
    assert holdout.predicted_fit_percent is not None
    assert np.all(holdout.predicted_fit_percent > 99.9)


def test_first_order_system_without_noise_gets_order_one():
    rng = np.random.default_rng(2)
    u = rng.normal(size=(2000, 1))
    y = lfilter([0.0, 1.0], [1.0, -0.5], u, axis=0)
    (point,) = identify([Record("r", 0.02, u, y, ("u",), ("N",), ("y",), ("m",))]).points
    assert isinstance(point, OpenLoopPoint)
    assert point.order == 1
    assert point.model.A[0, 0] == pytest.approx(0.5, abs=1e-6)


def test_short_record_beside_a_long_one_is_left_out():
    long, short = _records(1, 2)
    alone = _identified(1)
    np.testing.assert_array_equal(_records(1)[0].y, long.y)
    (both,) = identify([short.rows(0, 60), long]).points
    assert isinstance(both, OpenLoopPoint)
    assert both.records == alone.records == ("r0",)
    assert both.order == alone.order
    assert both.remarks == (
        "'r1' is left out: its 60 rows would shorten the impulse response of all",
    )


def test_short_record_with_the_only_excitation_of_an_input_is_used():
    long, short = _records(1, 2)
    still = replace(long, v=long.v * [1.0, 0.0])
    (point,) = identify([still, short.rows(0, 200)], Options(order=4)).points
    assert isinstance(point, OpenLoopPoint)
    assert point.records == ("r0", "r1")


def test_constant_output_is_rejected_with_its_name():
    (record,) = _records(1)
    y = record.y.copy()
    y[:, 1] = 0.1
    with pytest.raises(IdentificationError, match=r"'r0': expected outputs that vary, found 'd'"):
        identify([replace(record, y=y)])
    settled = record.y.copy()
    settled[1200:, 1] = settled[1199, 1]
    identify(
        [replace(record, y=settled)]
    )  # constant only in the validation part: the other output determines the order


def test_orders_without_a_predictor_are_skipped(monkeypatch):
    def failing(sequence, order, Ts_s):
        if order in refused:
            raise IdentificationError(f"no steady-state predictor of order {order}: test")
        return innovation_model(sequence, order, Ts_s)

    monkeypatch.setattr(starting_models, "innovation_model", failing)
    refused = {1, 2, 9}
    (point,) = identify(_records(3)).points
    assert isinstance(point, OpenLoopPoint)
    assert np.isnan(point.predictor_validation_error[[0, 1, 8]]).all()
    assert point.predictor_order >= 4
    refused = set(range(100))
    with pytest.raises(IdentificationError, match="no steady-state predictor of order 1: test"):
        identify(_records(3))


def test_records_of_equal_names_have_separate_initial_states():
    apart, alike = ([replace(r, name=n) for r, n in zip(_records(5, 2), names, strict=True)]
                    for names in (("a", "b"), ("a", "a")))  # fmt: skip
    (one,), (other,) = (identify(records, Options(order=4)).points for records in (apart, alike))
    assert isinstance(one, OpenLoopPoint)
    assert isinstance(other, OpenLoopPoint)
    assert np.isfinite(one.validation_error[3])
    np.testing.assert_array_equal(one.validation_error, other.validation_error)
    np.testing.assert_array_equal(one.model.A, other.model.A)


def test_short_record_with_the_only_excitation_of_an_input_sets_the_segment_length():
    records = _records(6, 2)
    inputs = [records[0].v * [1.0, 0.0], records[1].v[:480] * [0.0, 1.0]]
    parts = [
        replace(
            r, v=v, y=simulate(TRUE, v) + 0.01 * np.random.default_rng(k).normal(size=(len(v), 2))
        )
        for k, (r, v) in enumerate(zip(records, inputs, strict=True))
    ]
    (point,) = identify(parts).points
    assert isinstance(point, OpenLoopPoint)
    # Three quarters of 480 rows give two segments of 3.6 s.
    assert point.from_spectra.freq_hz[0] == pytest.approx(1 / 3.6)
    # A record that is not needed is left out, as in the test above.
    (point,) = identify([*parts, parts[1].rows(0, 100)], Options(order=4)).points
    assert isinstance(point, OpenLoopPoint)
    assert point.from_spectra.freq_hz[0] == pytest.approx(1 / 3.6)


def test_segments_longer_than_every_record_are_rejected():
    with pytest.raises(IdentificationError, match=r"two segments of 40 s .*, found at most 30 s"):
        identify(_records(1, rows=2000), Options(segment_s=40.0))


def test_record_too_short_for_a_predictor_is_rejected():
    (record,) = _records(4, rows=40)
    with pytest.raises(IdentificationError):
        identify([record])


def test_measured_cd_player_arm_is_predicted_and_simulated():
    path = DATA / "daisy" / "CD_player_arm.dat"
    if not path.exists():
        pytest.skip(f"measured data not here: {path.name}")
    data = np.loadtxt(path)
    record = Record(
        "cd", 1.0, data[:, :2], data[:, 2:], ("u1", "u2"), ("1", "1"), ("y1", "y2"), ("1", "1")
    )
    (point,) = identify([record]).points
    assert isinstance(point, OpenLoopPoint)
    (holdout,) = point.holdout
    assert len(holdout.measured) == 512
    # Found: 75.8 and 84.6 % simulated, 95.9 and 94.9 % one step ahead; a margin for other BLAS.
    assert np.all(holdout.simulated_fit_percent > [73.0, 82.0])
    assert holdout.predicted_fit_percent is not None
    assert np.all(holdout.predicted_fit_percent > [94.0, 93.0])
