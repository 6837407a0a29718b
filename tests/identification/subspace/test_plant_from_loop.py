"""Test the plant from the identified loop, eq. (14): no delay, lag or integrators, six states."""

from __future__ import annotations

import numpy as np
import pytest

from levid.identification.nonparametric.frequency_response import plant_from_loop_response
from levid.identification.records.record import IdentificationError, PiController
from levid.identification.subspace import delay_removal, plant_from_loop
from levid.identification.subspace.ho_kalman import Scaling, decompose, realise
from levid.identification.subspace.simulation import simulate
from levid.model.second_order import StateSpace

TS = 1e-3
FREQ = np.geomspace(0.5, 100.0, 60)
SCALING = Scaling(np.array([3e-4, 3e-4, 9e-5]), np.array([0.1, 0.1, 1.3]))


@pytest.fixture(scope="module")
def controller(rig):
    return PiController(rig.KP, rig.KI)


@pytest.fixture(scope="module")
def exact(rig):
    """Return the plant with the beam at +0.1 m and 3 s of exact Markov parameters of its loop."""
    true = rig.sampled_plant(0.1, TS)
    return true, rig.closed_loop_markov(true, 3000)


def test_series_inverse_is_exact():
    rng = np.random.default_rng(0)
    a = 0.3 * rng.normal(size=(50, 3, 3)) * 0.8 ** np.arange(50)[:, None, None]
    a[0] += 2 * np.eye(3)
    unit = delay_removal.product(a, delay_removal.inverse(a))
    expected = np.zeros_like(unit)
    expected[0] = np.eye(3)
    np.testing.assert_allclose(unit, expected, atol=1e-12)


def test_loop_without_delay_and_lag_has_exactly_nine_states(rig, exact, controller):
    _, g = exact
    pole = np.exp(-TS / rig.LAG_S)
    core = delay_removal.without_delay(g, 2, pole, controller, TS)
    s = decompose(core, TS, SCALING).singular_values
    # Six of the platform, three of the controller.
    assert s[9] < 1e-12 * s[0] < 1e-6 * s[8]
    # Without removal of the lag, three fast states remain, five orders of magnitude smaller.
    lagged = decompose(
        delay_removal.without_delay(g, 2, 0.0, controller, TS), TS, SCALING
    ).singular_values
    assert 1e-8 * s[0] < lagged[9] < 1e-4 * s[8]
    assert lagged[12] < 1e-11 * s[0]


def test_plant_is_recovered_exactly_with_six_states(rig, exact, controller):
    true, g = exact
    pole = np.exp(-TS / rig.LAG_S)
    core = delay_removal.without_delay(g, 2, pole, controller, TS)
    model = realise(decompose(core, TS, SCALING), 9)
    P = plant_from_loop.IdentifiedPlant(plant_from_loop.plant_from_loop(model, controller), 2, pole)
    assert P.core.A.shape == (6, 6)
    expected = true.frequency_response(FREQ)
    # Off-diagonals are as small as 1e-4 of the diagonal: compare with its geometric mean.
    diagonal = np.abs(np.einsum("fii->fi", expected))
    size = np.sqrt(diagonal[:, :, None] * diagonal[:, None, :])
    # The smallest singular value is 1 / 20 of the first: rounding of 1e-13 grows to 1e-8 at most.
    assert np.abs((P.response(FREQ) - expected) / size).max() < 1e-8
    np.testing.assert_allclose(P.state_space().response(FREQ), P.response(FREQ), rtol=1e-9)
    # The plant's poles, to rounding: decay rates of 2.5 to 2.6 1/s, 19 to 56 rad/s.
    ours = np.sort(np.abs(np.linalg.eigvals(P.core.A)))
    theirs = np.sort(np.abs(np.linalg.eigvals(true.A)))[3:]
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_closing_the_loop_with_the_plant_gives_the_identified_loop(rig, exact, controller):
    _, g = exact
    core = delay_removal.without_delay(g, 2, 0.0, controller, TS)
    model = realise(decompose(core, TS, SCALING), 12)
    P = plant_from_loop.IdentifiedPlant(plant_from_loop.plant_from_loop(model, controller), 2)
    closed = plant_from_loop.closed_loop(P.state_space(), controller)
    impulse = np.zeros((3000, 3))
    impulse[0, 1] = 1.0
    np.testing.assert_allclose(simulate(closed, impulse), g[:, :, 1], atol=1e-9 * np.abs(g).max())


def test_cancelling_states_are_removed_despite_noise(exact, controller):
    true, g = exact
    pole = float(np.exp(-TS / 0.3e-3))
    z = np.exp(2j * np.pi * FREQ * TS)[:, None, None]
    expected = true.frequency_response(FREQ)
    # Errors of couplings are relative to both axes that they couple.
    diagonal = np.abs(np.einsum("fii->fi", expected))
    size = np.sqrt(diagonal[:, :, None] * diagonal[:, None, :])
    noise = 1e-9 * (SCALING.outputs / SCALING.outputs.max())[:, None] / SCALING.inputs
    noisy = g + noise * np.random.default_rng(0).normal(size=g.shape)
    core = delay_removal.without_delay(noisy, 2, pole, controller, TS)
    model = realise(decompose(core, TS, SCALING), 9)
    found = plant_from_loop.IdentifiedPlant(
        plant_from_loop.plant_from_loop(model, controller), 2, pole
    )
    assert len(found.core.A) == 6
    known = z**-2 * (1 - pole) / (1 - pole / z)
    pointwise = known * plant_from_loop_response(model.response(FREQ), controller, FREQ, TS)
    # The noise gives an error of about 1e-3; removing the states adds 2 to 16 % of it over seeds.
    cost = np.abs((pointwise - expected) / size).max()
    assert 1e-4 < cost < 1e-2
    assert np.abs((found.response(FREQ) - pointwise) / size).max() < 0.5 * cost


@pytest.mark.parametrize("poles", [(0.99, 0.95), (1.0, 1.0), (1.01, 0.9)])
def test_stable_marginal_and_unstable_plants_are_recovered(poles):
    true = StateSpace(
        np.array([[poles[0], 0.1], [0.0, poles[1]]]),
        np.array([[0.0], [0.1]]),
        np.array([[1.0, 0.0]]),
        np.zeros((1, 1)),
        0.1,
    )
    controller = PiController(np.array([3.0]), np.array([1.0]))
    closed = plant_from_loop.closed_loop(true, controller)
    found = plant_from_loop.plant_from_loop(closed, controller)
    assert len(found.A) == 2
    freq = np.array([0.05, 0.3, 1.0, 4.0])
    np.testing.assert_allclose(found.response(freq), true.response(freq), rtol=1e-9)
    np.testing.assert_allclose(
        np.sort(np.linalg.eigvals(found.A).real), np.sort(poles), atol=1e-6
    )  # a double pole has an error of the square root of rounding


def test_controller_without_integral_action_cancels_no_states():
    true = StateSpace(
        np.array([[0.9]]), np.array([[1.0]]), np.array([[0.1]]), np.zeros((1, 1)), 0.1
    )
    controller = PiController(np.array([2.0]), np.array([0.0]))
    found = plant_from_loop.plant_from_loop(
        plant_from_loop.closed_loop(true, controller), controller
    )
    np.testing.assert_allclose(np.linalg.eigvals(found.A), [0.9], atol=1e-12)


def test_equation_14_holds_at_each_frequency(rig, exact, controller):
    true, _ = exact
    P = true.frequency_response(FREQ)
    C = controller.response(FREQ, TS)
    G = P @ np.linalg.inv(np.eye(3) + C[:, :, None] * P)
    found = plant_from_loop_response(G, controller, FREQ, TS)
    np.testing.assert_allclose(found, P, rtol=1e-9, atol=1e-12 * np.abs(P).max())


def test_loop_with_fewer_states_than_its_controller_is_rejected(controller):
    small = StateSpace(np.eye(2) * 0.5, np.ones((2, 3)), np.ones((3, 2)), np.zeros((3, 3)), TS)
    with pytest.raises(IdentificationError, match="3 integrators"):
        plant_from_loop.plant_from_loop(small, controller)


def test_small_change_of_the_loop_gives_the_change_without_delay_and_lag(rig, exact, controller):
    pole, g = np.exp(-TS / rig.LAG_S), exact[1]
    change = delay_removal.change_without_delay(g, 2, pole, controller, TS)
    dg = 1e-6 * np.random.default_rng(0).normal(size=g.shape) * np.abs(g).max(axis=0)
    dg[:2] = 0.0
    before, after = (
        delay_removal.without_delay(x, 2, pole, controller, TS) for x in (g - dg, g + dg)
    )
    expected = 0.5 * (after - before)
    np.testing.assert_allclose(change(dg), expected, atol=1e-6 * np.abs(expected).max())
