"""Test hysteresis, lag and oscillator recursions along signals with known responses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from levid.model.effects import lag_and_hysteresis_recursions
from levid.model.effects.lag_and_hysteresis_recursions import smooth_oscillator

TS = 1e-3


def test_dahl_friction_follows_its_exponential_at_any_rate():
    x = np.concatenate([np.linspace(0, 1e-4, 50), np.linspace(1e-4, -2e-4, 200)])
    f = lag_and_hysteresis_recursions._dahl(x, 3e-5)
    np.testing.assert_allclose(f[:50], 1 - np.exp(-x[:50] / 3e-5), atol=1e-12)
    np.testing.assert_allclose(f[-1], -1 + (1 + f[49]) * np.exp(-3e-4 / 3e-5), atol=1e-12)


def test_bouc_wen_and_lugre_include_dahl_as_a_special_case():
    x = 1e-4 * np.sin(2 * np.pi * np.arange(3000) / 1000)
    f = lag_and_hysteresis_recursions.dahl(x, 3e-5, TS)
    # Midpoint rule with steps of at most 1/5 of the break-away distance.
    np.testing.assert_allclose(
        lag_and_hysteresis_recursions.bouc_wen(x, 3e-5, 1.0, 1.0, TS), f, atol=2e-3
    )
    np.testing.assert_allclose(
        lag_and_hysteresis_recursions.lugre(x, x, 3e-5, 0.0, 1.0, TS), f, atol=1e-12
    )


def test_maxwell_elements_approximate_other_loops():
    t = np.arange(8000) * TS
    x = 1e-4 * sum(np.sin(2 * np.pi * f * t + f) for f in (0.75, 2.25, 5.5))
    x *= 0.6 + 0.4 * np.sin(2 * np.pi * t / 8)
    v = np.gradient(x, TS)
    for loop in (
        lag_and_hysteresis_recursions.bouc_wen(x, 2e-5, 1.0, 0.5, TS),
        lag_and_hysteresis_recursions.bouc_wen(x, 6e-5, 2.0, 0.5, TS),
        lag_and_hysteresis_recursions.lugre(x, v, 4e-5, 0.4, 1e-3, TS),
    ):
        ratios = []
        for x_s in np.geomspace(2e-6, 1e-4, 12):
            basis = [lag_and_hysteresis_recursions.slip(x, x_s * ratio, TS) for ratio in (1, 4, 16)]
            ratios.append(_residual_norm(loop, [*basis, x, v]) / _residual_norm(loop, [x, v]))
        # Relative to the residual with stiffness and damping alone; found: 0.10 to 0.2.
        assert min(ratios) < 0.25


def _residual_norm(values, columns) -> float:
    A = np.stack([*columns, np.ones_like(values)], axis=1)
    A /= np.linalg.norm(A, axis=0)
    return float(np.linalg.norm(values - A @ np.linalg.lstsq(A, values, rcond=None)[0]))


def test_slip_element_follows_masing_loop():
    x = 5e-5 * np.sin(2 * np.pi * np.arange(4000) / 1000)
    f = lag_and_hysteresis_recursions.slip(x, 2e-5, TS)
    assert f.max() == 1
    assert f.min() == -1
    # It slips 2 * 5e-5 - 2 * 2e-5 in each direction at a force of 1. The error of 1000 linear
    # segments per period is below 1 %.
    loop = np.sum(0.5 * (f[1001:2001] + f[1000:2000]) * np.diff(x[1000:2001]))
    assert loop == pytest.approx(4 * (5e-5 - 2e-5), rel=0.01)


def test_hysteresis_of_periodic_motion_has_no_transient():
    x = 1e-4 * np.sin(2 * np.pi * np.arange(8000) / 500)
    for kernel in (
        lag_and_hysteresis_recursions.dahl,
        lag_and_hysteresis_recursions.slip,
        lag_and_hysteresis_recursions.play,
        lag_and_hysteresis_recursions.jumping,
    ):
        f = kernel(x, 2e-5, TS)
        np.testing.assert_allclose(f[:500], f[500:1000], atol=1e-9)


def test_play_stays_within_its_width_and_sticks():
    x = 1e-4 * np.sin(2 * np.pi * np.arange(4000) / 1000)
    p = lag_and_hysteresis_recursions.play(x, 2e-5, TS)
    assert np.abs(p - x).max() == pytest.approx(2e-5)
    assert p.max() == pytest.approx(8e-5)
    stuck = lag_and_hysteresis_recursions.jumping(x, 2e-5, TS)
    assert np.abs(stuck - x).max() <= 2e-5
    # It moves 4e-4 per period in steps of at least 2e-5.
    assert np.count_nonzero(np.diff(stuck[1000:2001])) <= 20


def test_lag_of_a_ramp_is_its_time_constant():
    ramp = np.arange(2000) * TS
    np.testing.assert_allclose(
        lag_and_hysteresis_recursions.lagged(ramp, 0.02, TS)[1000:], ramp[1000:] - 0.02
    )


def test_mean_of_a_lagged_command_agrees_with_the_exact_step_response():
    held, tau = np.repeat([0.0, 1.0], 5), 0.7e-3
    mean = lag_and_hysteresis_recursions.lagged_mean(held, tau, TS)
    fine = np.arange(0.5e-6, TS, 1e-6)
    for k in range(3):
        # The midpoint rule at 1 us has an error of (Ts / tau 1e-3)^2 / 24.
        expected = np.mean(1 - np.exp(-(fine + k * TS) / tau))
        assert mean[5 + k] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("tau", [0.05e-3, 0.3e-3, 1e-3, 20e-3])
def test_commands_are_recovered_from_means_of_the_lagged_command(tau: float):
    held = np.random.default_rng(1).normal(size=400)
    mean = lag_and_hysteresis_recursions.lagged_mean(held, tau, TS)
    np.testing.assert_allclose(
        lag_and_hysteresis_recursions.held_for(mean, tau, TS), held, atol=1e-9
    )


def test_lagged_command_is_exact_at_any_time_in_a_period():
    held, tau = np.repeat([0.0, 1.0], 5), 0.7e-3
    for share in (0.0, 0.3, 1.0):
        found = lag_and_hysteresis_recursions.lagged_within(held, tau, TS, share)
        since = (np.arange(5) + share) * TS
        np.testing.assert_allclose(found[5:], 1 - np.exp(-since / tau), atol=1e-12)


def test_oscillator_step_response_is_exact():
    f, zeta = 40.0, 0.05
    force = np.repeat([0.0, 1.0], [10, 500])
    eta = lag_and_hysteresis_recursions.oscillator(force, f, zeta, TS)
    t, w = np.arange(500) * TS, 2 * np.pi * f
    wd = w * np.sqrt(1 - zeta**2)
    step = 1 - np.exp(-zeta * w * t) * (np.cos(wd * t) + zeta * w / wd * np.sin(wd * t))
    np.testing.assert_allclose(eta[10:, 0], step / w**2, atol=1e-12 / w)
    np.testing.assert_allclose(eta[10:, 1], np.exp(-zeta * w * t) * np.sin(wd * t) / wd, atol=1e-12)


def test_yielding_spring_below_its_limit_equals_a_linear_spring():
    t = np.arange(4000) * TS
    w, zeta = 2 * np.pi * 20.0, 0.1
    wd = 2 * np.pi * 17.0
    q = 1e-4 * np.sin(wd * t)
    x, taken = lag_and_hysteresis_recursions.yielding(
        q, wd * 1e-4 * np.cos(wd * t), 0 * q, w, zeta, 1e3, TS
    )
    answer = wd**2 / (w**2 - wd**2 + 2j * zeta * w * wd)
    # The transient has decayed: exp(-zeta w 2 s) is 1e-11. An error of 0.1 % in the resonance
    # frequency is amplified 20 times near resonance.
    expected = np.imag(answer * 1e-4 * np.exp(1j * wd * t))
    np.testing.assert_allclose(x[2000:], expected[2000:], atol=0.02 * np.abs(answer) * 1e-4)
    # The spring force accelerates the mass: x'' + q'' = -taken.
    rate = np.gradient(np.gradient(x + q, TS), TS)
    np.testing.assert_allclose(taken[2000:-2], -rate[2000:-2], atol=0.03 * np.abs(taken).max())


@pytest.mark.parametrize("pull", [0.5, -0.5, 3.0])
def test_static_deflection_of_a_yielding_spring(pull: float):
    """Iwan's initial loading curve: a deflection x carries the force x - x^2 / (2 x_s)."""
    w, x_s, rest = 10.0, 0.1, np.zeros(3000)
    x, taken = lag_and_hysteresis_recursions.yielding(rest, rest, rest + pull, w, 0.5, x_s, TS)
    carried = abs(pull) / w**2
    np.testing.assert_allclose(np.abs(x), x_s * (1 - np.sqrt(1 - 2 * carried / x_s)), rtol=0.02)
    np.testing.assert_allclose(taken, pull, rtol=0.01)


def test_relative_loss_of_a_yielding_spring_grows_with_amplitude():
    t = np.arange(6000) * TS
    wd, x_s = 2 * np.pi * 2.0, 1e-4
    lost = []
    for size in (1e-5, 1e-4, 1e-3):
        q, qd = size * np.sin(wd * t), size * wd * np.cos(wd * t)
        # Far below resonance the mass follows: the work per period is that of the external force.
        x, taken = lag_and_hysteresis_recursions.yielding(
            q, qd, size * 1e3 * np.sin(wd * t), 50.0, 0.01, x_s, TS
        )
        lost.append(float(np.sum(taken[3000:5999] * np.diff(x[3000:]))) / size**2)
    assert lost[0] < lost[1] < lost[2]


def test_slip_element_stays_within_its_range():
    """Stop operators preserve order: the extreme initial forces bound all others."""
    rng = np.random.default_rng(3)
    x = np.cumsum(rng.normal(0.0, 3e-6, 4000))
    middle, half = lag_and_hysteresis_recursions.slip_range(x, 4e-5)
    assert half[0] == 1.0
    assert np.all(np.diff(half) <= 1e-15)
    for held in np.linspace(-1.0, 1.0, 9):
        f = lag_and_hysteresis_recursions._slip(x, 4e-5, held)
        assert np.all(np.abs(f - middle) <= half + 1e-12)
    travel = np.maximum.accumulate(x) - np.minimum.accumulate(x)
    assert np.all(
        half[travel > 8e-5] == 0.0
    )  # a travel of twice the break-away distance erases the initial force
    assert half[travel < 4e-5][-1] > 0.0


def way_of_a_mass(force: np.ndarray, step_s: float) -> np.ndarray:
    """Return the way of a mass of 1 kg, exact for a force that is constant over each step."""
    speed = np.concatenate([[0.0], np.cumsum(force)]) * step_s
    return np.cumsum(0.5 * (speed[1:] + speed[:-1])) * step_s


@pytest.mark.parametrize("tau", [0.2e-3, 1e-3, 5e-3])
def test_a_lagged_command_moves_a_mass_as_far_as_its_mean_and_moment(tau: float):
    held, fine = np.repeat(np.random.default_rng(2).normal(size=20), 5), 1000
    mean = lag_and_hysteresis_recursions.lagged_mean(held, tau, TS)
    moment = lag_and_hysteresis_recursions.lagged_moment(held, tau, TS)
    shares = (np.arange(fine) + 0.5) / fine
    within = lag_and_hysteresis_recursions.lagged_within
    force = np.stack([within(held, tau, TS, share) for share in shares], axis=1)
    exact = way_of_a_mass(force.reshape(-1), TS / fine)[fine - 1 :: fine]
    off = [
        np.abs(way_of_a_mass(f, TS) - exact)[:-1].max()
        for f in (mean, lag_and_hysteresis_recursions.with_moment(mean, moment))
    ]
    # What is left is the pair's own way, within a period of each change.
    assert off[1] < 0.6 * off[0]
    steady = np.arange(100) % 5 == 3  # the command changes at 0, and 2 periods later
    ways = way_of_a_mass(lag_and_hysteresis_recursions.with_moment(mean, moment), TS)
    assert np.abs(ways - exact)[steady].max() < 0.1 * off[0]


@pytest.mark.parametrize("tau", [0.3e-3, 2e-3, 50e-3])
def test_lag_of_a_motion_is_exact_for_a_parabola_and_for_a_slow_wave(tau: float):
    t = np.arange(4000) * TS
    lagged_motion = lag_and_hysteresis_recursions.lagged_motion
    way = lagged_motion(0.5 * t**2, tau, TS)[:-2]
    # t^2 / 2 after a lag is t^2 / 2 - tau t + tau^2, once the begin has decayed.
    np.testing.assert_allclose(way[1000:], (0.5 * t**2 - tau * t + tau**2)[1000:-2], rtol=1e-9)
    w = 2 * np.pi * 20
    exact = np.imag(np.exp(1j * w * t) / (1 + 1j * w * tau))[1000:-10]
    lines = lag_and_hysteresis_recursions.lagged(np.sin(w * t), tau, TS)[1000:-10]
    curved = lagged_motion(np.sin(w * t), tau, TS)[1000:-10]
    assert np.abs(curved - exact).max() < 0.1 * np.abs(lines - exact).max()


@pytest.mark.parametrize("tau", [0.3e-3, 3e-3])
def test_oscillator_is_exact_for_a_lagged_command(tau: float):
    held, fine = np.random.default_rng(3).normal(size=60), 2000
    recursions, f, zeta = lag_and_hysteresis_recursions, 115.0, 0.01
    found = recursions.oscillator(held, f, zeta, TS, tau)
    shares = (np.arange(fine) + 0.5) / fine
    force = np.stack([recursions.lagged_within(held, tau, TS, s) for s in shares], axis=1)
    exact = recursions.oscillator(force.reshape(-1), f, zeta, TS / fine)[::fine]
    # The midpoint rule has an error of (Ts / tau / fine)^2 / 24.
    size = np.abs(exact).max(axis=0)
    np.testing.assert_allclose(found / size, exact / size, atol=1e-6)


@pytest.mark.parametrize(
    ("frequency_hz", "damping"), [(23.0, 0.05), (60.0, 0.04), (5.0, 0.3), (5.0, 1.0), (9.0, 1.7)]
)
def test_oscillator_driven_by_a_smooth_force(frequency_hz: float, damping: float) -> None:
    """At a 28th of the sampling rate its error is below 10^-5, at the ends too."""
    Ts_s = 2e-3
    t = Ts_s * np.arange(800)
    w = 2 * np.pi * frequency_hz

    def force(s: float | np.ndarray) -> float | np.ndarray:
        return np.sin(2 * np.pi * 18.0 * s + 0.3) + 0.5 * np.cos(2 * np.pi * 7.0 * s)

    exact = solve_ivp(
        lambda s, x: [x[1], force(s) - w * w * x[0] - 2 * damping * w * x[1]],
        (0.0, t[-1]), [force(0.0) / w**2, 0.0], t_eval=t, rtol=1e-10, atol=1e-14,
    ).y.T  # fmt: skip
    found = smooth_oscillator(force(t), frequency_hz, damping, Ts_s)
    assert np.all(np.abs(found - exact).max(axis=0) < 1e-5 * exact.std(axis=0))
    assert smooth_oscillator(np.ones(1), 5.0, 0.1, Ts_s).shape == (1, 2)


@pytest.mark.parametrize(("frequency_hz", "damping"), [(30.0, 0.6), (200.0, 1.0), (5.0, 0.01)])
def test_second_order_lag_moves_a_mass_as_its_mean_and_moment(
    frequency_hz: float, damping: float
) -> None:
    held = np.random.default_rng(3).standard_normal(40)
    mean, moment = lag_and_hysteresis_recursions.resonant(held, frequency_hz, damping, TS)
    w, start = 2 * np.pi * frequency_hz, [held[0], 0.0, 0.0, 0.0]
    for row, command in enumerate(held):

        def rates(t: float, s: np.ndarray, command: float = command) -> list[float]:
            pull = w * w * (command - s[0]) - 2 * damping * w * s[1]
            return [s[1], pull, s[0], s[0] * (t / TS - 0.5)]

        end = solve_ivp(rates, (0.0, TS), start, rtol=1e-9, atol=1e-12).y[:, -1]
        np.testing.assert_allclose([mean[row], moment[row]], end[2:] / TS, rtol=1e-5, atol=1e-7)
        start = [*end[:2], 0.0, 0.0]
