"""Test checks of identified models: long responses, unstable loops, uncertain orders."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest

from levid.identification.identify import identify
from levid.identification.nonparametric.markov_parameters import MarkovEstimate
from levid.identification.options import Options
from levid.identification.records.record import Record
from levid.identification.results import ClosedLoopPoint
from levid.identification.results_to_json import summary
from levid.identification.subspace.model_checks import has_decayed, settling_time
from levid.model.second_order import StateSpace


@pytest.fixture(scope="module")
def ringing(rig) -> list[Record]:
    """Return records of a rig with 4/9 of the air damping, which rings twice as long.

    The loop's resonances decay by 1/e in 2.5 s, so that 4 % are left after 8 s.
    """
    M, D, K = rig.matrices(0.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rig, "matrices", lambda _x_b: (M, 4 / 9 * D, K))
        return rig.records([0.0], 1000.0, 60.0, at_rest=False)


def _point(records: list[Record], options: Options) -> ClosedLoopPoint:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = identify(records, options)
        text = summary(result)
    json.dumps(text, allow_nan=False)
    (point,) = result.points
    assert isinstance(point, ClosedLoopPoint)
    assert text["points"][0]["trusted"] == point.trusted
    return point


def test_slowly_decaying_loop_gets_a_longer_impulse_response(rig, ringing):
    point = _point(ringing, Options(lag_s=rig.LAG_S))
    assert len(point.markov["least_squares"].g) > 10_000
    assert any("rings for more than" in text for text in point.remarks)
    assert any("are left out at the start of records" in text for text in point.remarks)
    assert point.order == 9
    assert point.trusted
    for axis, holdout in enumerate(point.holdout):
        # Sensor noise leaves 0.2 to 0.3 %, as with full damping.
        assert holdout.simulated_fit_percent[axis] > 99.5


def test_model_with_too_few_states_is_not_trusted(rig, ringing):
    """Order 6 without three integrators leaves three states for three axes."""
    point = _point(ringing, Options(lag_s=rig.LAG_S, order=6, impulse_s=4.0))
    assert not point.trusted
    text = "; ".join(point.doubts)
    assert "3 degrees of freedom need at least 6 states, the plant has 3" in text
    # The response from the sensitivity needs no model and stays valid.
    assert np.all(np.isfinite(point.from_sensitivity.H))


def test_held_out_data_show_a_fit_that_does_not_explain_them(rig, ringing):
    # The end of the second record does not follow a linear model of its beginning.
    broken = ringing[1].y.copy()
    broken[45_000:] *= 1.2
    records = [ringing[0], Record(**{**ringing[1].__dict__, "y": broken}), ringing[2]]
    point = _point(records, Options(lag_s=rig.LAG_S))
    # The impulse response has the same error as the model: the data are at fault, not the model.
    assert point.trusted
    assert point.holdout[1].simulated_fit_percent[1] < 90


def _markov(decay_per_s: float, noise: float) -> MarkovEstimate:
    t = 1e-2 * np.arange(600)
    g = np.exp(-decay_per_s * t)[:, None, None] * np.eye(2)
    g = g + noise * np.random.default_rng(0).normal(size=g.shape)
    return MarkovEstimate("made", g, np.full((2, 2), noise), np.ones(2), 1e-2)


def test_decay_of_an_impulse_response_is_checked_against_noise_and_size():
    assert has_decayed(_markov(2.0, 1e-6))  # e^-10: negligible, even if far above noise
    assert not has_decayed(_markov(0.5, 1e-6))  # e^-2.5
    assert has_decayed(_markov(0.5, 0.1))  # below the noise: more taps would only add noise


def test_settling_time_is_that_of_the_slowest_observable_mode():
    Ts_s = 1e-2
    slow, fast = np.exp(-0.5 * Ts_s), np.exp(-5.0 * Ts_s)
    model = StateSpace(np.diag([slow, fast]), np.eye(2), np.eye(2), np.zeros((2, 2)), Ts_s)
    # The slow mode decays as e^-0.5t: to 3e-3 in 5.8 / 0.5 s.
    assert settling_time(model, 1.0, 60.0) == pytest.approx(-np.log(3e-3) / 0.5, rel=0.02)
    assert settling_time(model, 20.0, 60.0) == 20.0
    unstable = StateSpace(np.diag([1.1, fast]), np.eye(2), np.eye(2), np.zeros((2, 2)), Ts_s)
    assert settling_time(unstable, 1.0, 60.0) == 60.0


def test_model_of_undetermined_order_is_not_trusted(rig, ringing):
    """The outputs are sensor noise; the logged excitation was never applied."""
    rng = np.random.default_rng(0)
    not_excited = [
        Record(**{**r.__dict__, "y": 1e-6 * rng.normal(size=r.y.shape), "u": r.v}) for r in ringing
    ]
    point = _point(not_excited, Options(lag_s=rig.LAG_S, impulse_s=1.0))
    assert any("states above its noise" in text for text in point.doubts)
