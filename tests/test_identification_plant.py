"""From the loop to the plant, (14): delay and lag out, integrators cancelled, six states left."""

from __future__ import annotations

import numpy as np
import pytest

from levid.identification import loop, plant
from levid.identification.data import IdentificationError, PiController
from levid.identification.frequency import plant_from_loop_response
from levid.identification.ho_kalman import Scaling, decompose, order_from_gap, realise
from levid.identification.simulate import simulate
from levid.model.second_order import StateSpace

TS = 1e-3
FREQ = np.geomspace(0.5, 100.0, 60)
SCALING = Scaling(np.array([3e-4, 3e-4, 9e-5]), np.array([0.1, 0.1, 1.3]))


@pytest.fixture(scope="module")
def controller(rig):
    return PiController(rig.KP, rig.KI)


@pytest.fixture(scope="module")
def exact(rig):
    """The plant with the beam at +0.1 m, and 3 s of the exact Markov parameters of its loop."""
    true = rig.sampled_plant(0.1, TS)
    return true, rig.closed_loop_markov(true, 3000)


def test_series_inverse_is_exact():
    rng = np.random.default_rng(0)
    a = 0.3 * rng.normal(size=(50, 3, 3)) * 0.8 ** np.arange(50)[:, None, None]
    a[0] += 2 * np.eye(3)
    unit = loop.product(a, loop.inverse(a))
    expected = np.zeros_like(unit)
    expected[0] = np.eye(3)
    np.testing.assert_allclose(unit, expected, atol=1e-12)


def test_without_delay_and_lag_the_loop_has_nine_states_to_rounding(rig, exact, controller):
    _, g = exact
    pole = np.exp(-TS / rig.LAG_S)
    core = loop.without_delay(g, 2, pole, controller, TS)
    s = decompose(core, TS, SCALING).singular_values
    choice = order_from_gap(s)
    assert choice.order == 9  # six of the platform, three of the controller
    assert s[9] < 1e-12 * s[0]
    # With the lag left in, three fast states stay, five orders below; with the delay left in too,
    # nothing but the shift by two taps is taken off and more remains.
    lagged = decompose(loop.without_delay(g, 2, 0.0, controller, TS), TS, SCALING).singular_values
    assert 1e-8 * s[0] < lagged[9] < 1e-4 * s[8]
    assert lagged[12] < 1e-11 * s[0]


def test_plant_is_recovered_exactly_with_six_states(rig, exact, controller):
    true, g = exact
    pole = np.exp(-TS / rig.LAG_S)
    core = loop.without_delay(g, 2, pole, controller, TS)
    model = realise(decompose(core, TS, SCALING), 9)
    P = plant.Plant(plant.plant_from_loop(model, controller), 2, pole)
    assert P.core.A.shape == (6, 6)
    expected = true.frequency_response(FREQ)
    # Off-diagonals are down to 1e-4 of the diagonal: compare against the geometric mean of it.
    diagonal = np.abs(np.einsum("fii->fi", expected))
    size = np.sqrt(diagonal[:, :, None] * diagonal[:, None, :])
    # Singular values reach down to 1 / 20 of the first: rounding of 1e-13 grows to 1e-8 at most.
    assert np.abs((P.response(FREQ) - expected) / size).max() < 1e-8
    np.testing.assert_allclose(P.state_space().response(FREQ), P.response(FREQ), rtol=1e-9)
    # The plant's poles, to rounding: decay 2.5 to 2.6 1/s, 19 to 56 rad/s.
    ours = np.sort(np.abs(np.linalg.eigvals(P.core.A)))
    theirs = np.sort(np.abs(np.linalg.eigvals(true.A)))[3:]
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_closing_the_loop_again_gives_the_identified_loop_back(rig, exact, controller):
    _, g = exact
    core = loop.without_delay(g, 2, 0.0, controller, TS)
    model = realise(decompose(core, TS, SCALING), 12)
    P = plant.Plant(plant.plant_from_loop(model, controller), 2)
    closed = plant.closed_loop(P.state_space(), controller)
    impulse = np.zeros((3000, 3))
    impulse[0, 1] = 1.0
    np.testing.assert_allclose(simulate(closed, impulse), g[:, :, 1], atol=1e-9 * np.abs(g).max())


def test_integral_action_is_certain_even_when_the_model_is_not(exact, controller):
    _, g = exact
    noisy = g + 1e-7 * np.random.default_rng(1).normal(size=g.shape)  # 1e-3 of the largest tap
    core = loop.without_delay(noisy, 2, 0.0, controller, TS)
    raw = realise(decompose(core, TS, SCALING), 9)
    model = plant.with_integral_action(raw, controller)
    at_rest = model.C @ np.linalg.solve(np.eye(9) - model.A, model.B) + model.D
    before = raw.C @ np.linalg.solve(np.eye(9) - raw.A, raw.B) + raw.D
    stiffness = np.diag([210.0, 190.0, 2600.0])  # N m/rad, N/m: G(1) against 1 / k
    assert np.abs(stiffness @ at_rest).max() < 1e-9
    assert np.abs(stiffness @ before).max() > 1e-5
    # With those zeros, the n + 3 states of (14) are those of the result and six at z = 1.
    reduced = plant.plant_from_loop(raw, controller)
    full = plant._closed_with(model, controller)
    np.testing.assert_allclose(
        reduced.response(FREQ), full.response(FREQ), rtol=1e-6, atol=1e-9 / 2600
    )


@pytest.mark.parametrize("poles", [(0.99, 0.95), (1.0, 1.0), (1.01, 0.9)])
def test_the_plant_may_be_stable_marginal_or_unstable(poles):
    true = StateSpace(
        np.array([[poles[0], 0.1], [0.0, poles[1]]]),
        np.array([[0.0], [0.1]]),
        np.array([[1.0, 0.0]]),
        np.zeros((1, 1)),
        0.1,
    )
    controller = PiController(np.array([3.0]), np.array([1.0]))
    closed = plant.closed_loop(true, controller)
    found = plant.plant_from_loop(closed, controller)
    assert len(found.A) == 2
    freq = np.array([0.05, 0.3, 1.0, 4.0])
    np.testing.assert_allclose(found.response(freq), true.response(freq), rtol=1e-9)
    np.testing.assert_allclose(
        np.sort(np.linalg.eigvals(found.A).real), np.sort(poles), atol=1e-6
    )  # a double pole moves by the root of rounding


def test_without_integral_action_nothing_cancels():
    true = StateSpace(
        np.array([[0.9]]), np.array([[1.0]]), np.array([[0.1]]), np.zeros((1, 1)), 0.1
    )
    controller = PiController(np.array([2.0]), np.array([0.0]))
    found = plant.plant_from_loop(plant.closed_loop(true, controller), controller)
    np.testing.assert_allclose(np.linalg.eigvals(found.A), [0.9], atol=1e-12)


def test_equation_14_holds_point_by_point(rig, exact, controller):
    true, _ = exact
    P = true.frequency_response(FREQ)
    C = controller.response(FREQ, TS)
    G = P @ np.linalg.inv(np.eye(3) + C[:, :, None] * P)
    found = plant_from_loop_response(G, controller, FREQ, TS)
    np.testing.assert_allclose(found, P, rtol=1e-9, atol=1e-12 * np.abs(P).max())


def test_a_loop_smaller_than_its_controller_is_an_error(controller):
    small = StateSpace(np.eye(2) * 0.5, np.ones((2, 3)), np.ones((3, 2)), np.zeros((3, 3)), TS)
    with pytest.raises(IdentificationError, match="more than 3 states"):
        plant.plant_from_loop(small, controller)
