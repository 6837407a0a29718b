"""Test excitation and trajectories: level, spectrum, smoothness, limits."""

import numpy as np
import pytest

from levid.config.base import ConfigError
from levid.config.session import Excitation
from levid.daemon.planning import point_to_point
from levid.daemon.planning.excitation import fade, signal


def excitation(**more: object) -> Excitation:
    return Excitation.model_validate({"input": "psi", "rms_n_m": 0.1, **more})


def test_white_noise_has_its_level_and_is_white() -> None:
    n = 200_000
    v = signal(excitation(), n, 1000.0, np.random.default_rng(1))
    # The standard error of an rms of n Gaussian samples is rms / sqrt(2 n); four of them.
    assert abs(v.std() - 0.1) < 4 * 0.1 / np.sqrt(2 * n)
    correlation = [v[:-lag] @ v[lag:] / (v @ v) for lag in (1, 2, 5, 50)]
    assert np.all(np.abs(correlation) < 4 / np.sqrt(n))


def test_band_keeps_power_inside_and_level() -> None:
    n, rate = 60_000, 1000.0
    v = signal(excitation(band_hz=[2.0, 50.0]), n, rate, np.random.default_rng(2))
    power = np.abs(np.fft.rfft(v)) ** 2
    freq = np.fft.rfftfreq(n, 1 / rate)
    assert power[(freq < 2) | (freq > 50)].sum() < 1e-20 * power.sum()
    np.testing.assert_allclose(np.sqrt(np.mean(v**2)), 0.1, rtol=1e-12)


def test_multisine_repeats_and_plays_only_its_lines() -> None:
    rate, period = 1000.0, 4.0
    spec = excitation(signal="multisine", period_s=period, band_hz=[1.0, 20.0], lines="odd")
    v = signal(spec, 16_000, rate, np.random.default_rng(3))
    np.testing.assert_array_equal(v[:4000], v[4000:8000])
    lines = np.flatnonzero(np.abs(np.fft.rfft(v[:4000])) > 1e-9)
    # Odd multiples of 1/4 Hz from 1 to 20 Hz.
    np.testing.assert_array_equal(lines, np.arange(5, 80, 2))
    np.testing.assert_allclose(np.sqrt(np.mean(v[:4000] ** 2)), 0.1, rtol=1e-12)


def test_band_above_half_the_rate_is_refused() -> None:
    with pytest.raises(ConfigError, match="half the rate, 500 Hz, found 600 Hz"):
        signal(excitation(band_hz=[1.0, 600.0]), 1000, 1000.0, np.random.default_rng(1))


def test_fade_begins_and_ends_at_zero_and_is_one_between() -> None:
    window = fade(1000, 0.1, 1000.0)
    assert window[0] == window[-1] == 0.0
    assert np.all(window[100:-100] == 1.0)
    # Half a cosine over 100 samples rises by at most pi/2 / 100 a sample.
    assert np.abs(np.diff(window)).max() <= np.pi / 200


@pytest.mark.parametrize(("start", "end"), [(0.0, 0.1), (0.1, -0.1), (-0.05, -0.049)])
@pytest.mark.parametrize(("velocity", "acceleration"), [(0.25, 1.0), (0.05, 10.0), (5.0, 0.5)])
def test_move_keeps_its_limits_and_its_derivatives_agree(
    start: float, end: float, velocity: float, acceleration: float
) -> None:
    Ts = 1e-3
    x, v, a = point_to_point.move(start, end, velocity, acceleration, Ts).T
    assert x[-1] == end
    assert v[-1] == a[-1] == 0.0
    # The quintic's own rounding, nothing else.
    assert np.abs(v).max() <= velocity * (1 + 1e-9)
    assert np.abs(a).max() <= acceleration * (1 + 1e-9)
    # Central differences of a quintic err by Ts^2/6 times the third derivative, 60 d / T^3 at most.
    T = len(x) * Ts
    error = Ts**2 / 6 * 60 * abs(end - start) / T**3
    np.testing.assert_allclose((x[2:] - x[:-2]) / (2 * Ts), v[1:-1], atol=error + 1e-12)


def test_move_to_where_it_is_stays() -> None:
    np.testing.assert_array_equal(point_to_point.move(0.1, 0.1, 1, 1, 1e-3), [[0.1, 0.0, 0.0]])
