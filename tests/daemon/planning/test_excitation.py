"""Test excitation and trajectories: level, spectrum, smoothness, limits."""

import numpy as np
import pytest

from levid.config.base import ConfigError
from levid.config.session import Excitation
from levid.daemon.planning import excitation as excitation_module
from levid.daemon.planning import point_to_point
from levid.daemon.planning.excitation import fade


def excitation(**more: object) -> Excitation:
    return Excitation.model_validate({"input": "psi", "rms_n_m": 0.1, **more})


def signal(spec: Excitation, n: int, rate_hz: float, rng: np.random.Generator) -> np.ndarray:
    found: list[np.ndarray] = []
    for block in excitation_module.signal(spec, n, rate_hz, rng):
        found.append(block)
        if sum(map(len, found)) >= n:
            break
    return np.concatenate(found)[:n]


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


def test_band_limited_noise_of_a_long_record_is_joined_of_blocks(monkeypatch) -> None:
    monkeypatch.setattr(excitation_module, "_MOST_ROWS", 1 << 14)
    n, rate = 200_000, 1000.0
    v = signal(excitation(band_hz=[5.0, 50.0]), n, rate, np.random.default_rng(4))
    # Power in bands of 90 Hz s of a Gaussian signal scatters by 1 / sqrt(90 * 200): four of that,
    # within joints (a third of each hop) as between them.
    hop, joint = 3 << 12, 1 << 12
    k = np.arange(hop, n // hop * hop)
    in_joint = k % hop < joint
    for part in (k[in_joint], k[~in_joint]):
        assert abs(np.mean(v[part] ** 2) / 0.1**2 - 1) < 4 / np.sqrt(90 * len(part) / rate)
    # A fade of 4 s leaks into lines beside the band, and nowhere else.
    power = np.abs(np.fft.rfft(v * np.hanning(n))) ** 2
    freq = np.fft.rfftfreq(n, 1 / rate)
    assert power[(freq < 4) | (freq > 51)].sum() < 1e-6 * power.sum()


def test_longest_period_of_a_multisine() -> None:
    spec = excitation(signal="multisine", period_s=2000.0, band_hz=[1.0, 20.0])
    with pytest.raises(ConfigError, match="period_s: expected at most 1049 s at 1000 Hz"):
        signal(spec, 1000, 1000.0, np.random.default_rng(1))


def test_fade_begins_and_ends_at_zero_and_is_one_between() -> None:
    window = fade(0, 1000, 1000, 0.1, 1000.0)
    assert window[0] == window[-1] == 0.0
    assert np.all(window[100:-100] == 1.0)
    # Half a cosine over 100 samples rises by at most pi/2 / 100 a sample.
    assert np.abs(np.diff(window)).max() <= np.pi / 200


@pytest.mark.parametrize("cycles", [1, 7, 150, 1000])
def test_fade_in_pieces_is_that_of_the_whole(cycles: int) -> None:
    whole = fade(0, cycles, cycles, 0.1, 1000.0)
    for size in (1, 3, 60, 101):
        pieces = [
            fade(at, min(at + size, cycles), cycles, 0.1, 1000.0) for at in range(0, cycles, size)
        ]
        np.testing.assert_array_equal(np.concatenate(pieces), whole)


def repeated_step_by_step(start, legs, n, Ts_s) -> np.ndarray:
    """As Repeated.setpoints, by appending one part after the other."""
    parts: list[np.ndarray] = []
    length, at = 0, start
    while length < n:
        before = length
        for leg in legs:
            part = point_to_point.move(at, leg.to, leg.velocity, leg.acceleration, Ts_s)
            if length + len(part) > n:
                return np.vstack([*parts, point_to_point.hold(at, n - length)])
            dwell = min(round(leg.dwell_s / Ts_s), n - length - len(part))
            parts += [part, point_to_point.hold(leg.to, dwell)]
            length, at = length + len(part) + dwell, leg.to
            if length == n:
                break
        if length - before <= len(legs):
            break
    return np.vstack([*parts, point_to_point.hold(at, n - length)])


@pytest.mark.parametrize("n", [1500, 1501, 6000, 20_000])
@pytest.mark.parametrize("dwell_s", [0.0, 0.2, 30.0])
def test_repeated_legs_are_the_moves_and_rests_one_after_the_other(n: int, dwell_s: float) -> None:
    legs = [
        point_to_point.Leg(0.1, 0.25, 1.0, dwell_s),
        point_to_point.Leg(-0.02, 0.5, 2.0, 0.1),
        point_to_point.Leg(-0.02, 0.5, 2.0, 0.0),
    ]
    repeated = point_to_point.Repeated(0.03, legs, n, 1e-3)
    wanted = repeated_step_by_step(0.03, legs, n, 1e-3)
    found = repeated.setpoints()
    np.testing.assert_array_equal(found, wanted)
    assert repeated.end == wanted[-1, 0]
    different = np.unique(np.vstack([repeated.moves(), point_to_point.hold(0.03, 1)]), axis=0)
    np.testing.assert_array_equal(np.unique(np.vstack([wanted, different]), axis=0), different)


def test_legs_of_no_length_hold() -> None:
    legs = [point_to_point.Leg(0.1, 1.0, 1.0, 0.0)]
    repeated = point_to_point.Repeated(0.1, legs, 50, 1e-3)
    np.testing.assert_array_equal(repeated.setpoints(), point_to_point.hold(0.1, 50))


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
