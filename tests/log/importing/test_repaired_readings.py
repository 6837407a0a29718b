"""Wrapped signals are unwrapped; codes and spikes are left out, and steps and impacts are not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

from levid.log.errors import LogError
from levid.log.importing.repaired_readings import repaired
from levid.log.importing.signals_yaml import SignalsFile

N = 4000
TIME_S = np.arange(N) * 1e-3
RNG = np.random.default_rng(5)
NOISE = 1e-3 * RNG.standard_normal(N)
FORCE = np.repeat(RNG.standard_normal(N // 8), 8)
SMOOTH = np.sin(2 * np.pi * 3.0 * TIME_S) + NOISE


def signals(**keys):
    return SignalsFile.model_validate(
        {
            "levid": "signals",
            "rate_hz": 1000,
            "missing": keys.pop("missing", []),
            "columns": [
                {"column": 0, "name": "u", "unit": "N", "role": "input"},
                {"column": 1, "name": "y", "unit": "m", "role": "output", **keys},
            ],
        }
    )


def read(y, u=FORCE, **keys):
    found = repaired("data", signals(**keys), [u, y])
    return found.values[1], found.remarks


@pytest.mark.parametrize("wrap", [2 * np.pi, 360.0, 2.0**16, 2.0**24, 2.0**32, 1.0, 4000.0])
@pytest.mark.parametrize("turns", [3.3, -0.7, 40.0])
@pytest.mark.parametrize("low", [0.0, 0.5])
def test_wrapped_angle_or_counter_is_unwrapped(wrap, turns, low):
    # Within 4 s; at 40 turns a row moves by a hundredth of a turn.
    true = wrap * (turns * TIME_S / TIME_S[-1] + 0.05 * np.sin(40 * TIME_S) + 0.3)
    wrapped = (true + low * wrap) % wrap - low * wrap
    found, remarks = read(wrapped)
    error = found - true
    np.testing.assert_allclose(error, error[0], atol=1e-6 * wrap)
    jumps = np.count_nonzero(np.abs(np.diff(wrapped)) > 0.5 * wrap)
    assert len(remarks) == bool(jumps)
    assert all(f"unwrapped at {jumps} rows" in remark for remark in remarks)


def test_counter_that_dithers_at_the_end_of_its_range_is_unwrapped():
    true = np.rint(4 * np.sin(3 * TIME_S) + 0.6 * RNG.standard_normal(N))
    found, remarks = read(true % 65536)
    error = found - true
    np.testing.assert_array_equal(error, error[0])
    assert remarks


def test_pendulum_about_the_end_of_the_range_is_unwrapped():
    true = np.pi + 0.2 * np.sin(6 * TIME_S) + NOISE
    found, _ = read(np.angle(np.exp(1j * true)))
    error = found - true
    np.testing.assert_allclose(error, error[0], atol=1e-9)


def test_unusual_range_of_jumps_is_asked_for():
    true = 5.37 * (TIME_S + 0.1)
    with pytest.raises(LogError, match=r"jumps by 5\.37 .* set wraps: RANGE for this column"):
        read(true % 5.37)
    found, _ = read(true % 5.37, wraps=5.37)
    np.testing.assert_allclose(found - true, found[0] - true[0], atol=1e-9)


def test_stated_jumps_are_kept():
    y = 360.0 * TIME_S % 360.0
    found, remarks = read(y, wraps="none")
    np.testing.assert_array_equal(found, y)
    assert remarks == ()


SQUARE = np.sign(np.sin(2 * np.pi * 2.0 * TIME_S + 0.1))
JUMPING = {
    "square wave": SQUARE,
    "noisy square wave": 180.0 * SQUARE + NOISE,
    "steps": np.repeat(RNG.standard_normal(20), N // 20) + NOISE,
    "random levels": np.repeat(np.sign(RNG.standard_normal(200)), N // 200) + NOISE,
    "slow response to a step": np.where(TIME_S > 1, 1 - np.exp(-(TIME_S - 1) / 0.02), 0) + NOISE,
    "impact that rings": np.where(TIME_S > 2, np.exp(-30 * (TIME_S - 2)), 0)
    * np.cos(1500 * (TIME_S - 2))
    * 50
    + NOISE,
    "white noise": RNG.standard_normal(N),
    "heavy tails": RNG.standard_t(3, N),
    "at rest, then motion": np.where(TIME_S > 3.5, np.sin(300 * (TIME_S - 3.5)), 0) + 1e-6 * NOISE,
    "coarse encoder": np.rint(5 * np.sin(4 * TIME_S)),
    "constant": np.full(N, 3.0),
    "one bit": np.where(RNG.random(N) < 0.01, 1.0, 0.0),
}


@pytest.mark.parametrize("name", JUMPING)
def test_signal_that_jumps_by_design_is_not_changed(name):
    found, remarks = read(JUMPING[name])
    np.testing.assert_array_equal(found, JUMPING[name])
    assert remarks == ()


def resonant(force, hz, damping):
    w, row = 2 * np.pi * hz, TIME_S[1]
    step = expm(row * np.array([[0, 1, 0], [-w * w, -2 * damping * w, 1], [0, 0, 0]]))
    state, found = np.zeros(2), np.empty((N, 2))
    for k in range(N):
        found[k] = state
        state = step[:2, :2] @ state + step[:2, 2] * force[k]
    return found


def drawn(kind, rng):
    """Return input and output of a clean record."""
    force, y = np.zeros(N), np.zeros(N)
    events = rng.integers(50, N - 50, rng.integers(2, 12))
    if kind == "fast steps":
        force = np.repeat(rng.standard_normal(20), N // 20)
        y = lfilter([rng.uniform(0.3, 1)], [1, -rng.uniform(0, 0.7)], force)
    elif kind == "impulses on a resonant plant":
        force[events] = 1.0
        y = resonant(force, rng.uniform(2, 200), rng.uniform(0.02, 0.9))[:, rng.integers(2)]
    elif kind == "impacts":
        for event in events:
            rows = rng.integers(3, 15)
            y[event : event + rows] += rng.uniform(0.3, 1) * np.sin(np.pi * np.arange(rows) / rows)
    elif kind == "valve":
        for event in events:
            y[event : event + rng.integers(1, 20)] = 1.0
    else:
        y = rng.standard_t(rng.choice([2.5, 4.0]), N)
    return force, y + np.std(y) * rng.choice([0, 1e-4, 1e-2]) * rng.standard_normal(N)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    "kind", ["fast steps", "impulses on a resonant plant", "impacts", "valve", "heavy tails"]
)
def test_clean_record_is_not_changed(kind, seed):
    force, y = drawn(kind, np.random.default_rng(seed))
    found, _ = read(y, force)
    np.testing.assert_array_equal(found, y)


@pytest.mark.parametrize("bad", [9999.0, -1290.0, 0.0, 160.0, 359.0])
@pytest.mark.parametrize("keys", [{}, {"wraps": 360}])
def test_spikes_of_a_wrapped_angle_turn_no_other_row(bad, keys):
    true = 700.0 * np.sin(2 * TIME_S) + 0.1 * NOISE
    wrapped, rows = true % 360.0, [500, 1501, 1502, 2502]
    wrapped[rows] = bad
    found, remarks = read(wrapped, **keys)
    known = ~np.isnan(found)
    assert np.flatnonzero(~known).tolist() == rows
    np.testing.assert_allclose((found - true)[known], found[0] - true[0], atol=1e-9)
    assert len(remarks) == 2


def test_spikes_of_a_fast_angle_turn_no_other_row():
    true = np.cumsum(0.3 * 2 * np.pi * np.sin(5 * TIME_S))  # up to 0.3 turns from row to row
    wrapped = np.angle(np.exp(1j * true))
    wrapped[[300, 1700]] = [50.0, -50.0]
    found, _ = read(wrapped)
    known = ~np.isnan(found)
    assert np.flatnonzero(~known).tolist() == [300, 1700]
    np.testing.assert_allclose((found - true)[known], found[0] - true[0], atol=1e-9)


def test_saw_tooth_that_is_commanded_is_kept():
    saw = 100.0 * (0.7 * TIME_S % 1.0)
    found, remarks = read(0.5 * saw, saw)
    np.testing.assert_array_equal(found, 0.5 * saw)
    assert "jumps by 50 where an input jumps" in remarks[1]
    columns = [
        {"column": 0, "name": "r", "unit": "m", "role": "reference"},
        {"column": 1, "name": "y", "unit": "m", "role": "output"},
    ]
    file = SignalsFile.model_validate({"levid": "signals", "rate_hz": 1000, "columns": columns})
    for y, kept in ((SMOOTH, True), (saw + NOISE, False)):
        found = repaired("data", file, [saw, y])
        assert np.array_equal(found.values[0], saw) == kept


@pytest.mark.parametrize("levels", [(0, 65535), (-32768, 32767), (0, 999)])
def test_levels_of_an_input_are_no_codes(levels):
    force = np.where(np.arange(N) % 500 < 40, levels[1], levels[0]).astype(float)
    found = repaired("data", signals(), [force, SMOOTH])
    np.testing.assert_array_equal(found.values[0], force)
    assert found.remarks == ()


def test_doubtful_spikes_are_shown_and_left_out_on_request():
    bad = np.sign(np.sin(30 * TIME_S)) + NOISE
    bad[700] += 2.5
    found, (remark,) = read(bad)
    np.testing.assert_array_equal(found, bad)
    assert "in row 700) are kept (the signal itself jumps as far" in remark
    found, _ = read(bad, outliers="mask")
    assert np.flatnonzero(np.isnan(found)).tolist() == [700]


@pytest.mark.parametrize(
    "code", [-9999.0, -999.25, 9.9e37, 9.91e37, 1e30, 2147483647.0, -32768.0, -1e31, 3.4e38, 65535]
)
@pytest.mark.parametrize("rows", [[700], list(range(1000, 1300)), [5, 2000, 2001, 3999]])
@pytest.mark.parametrize("role", ["output", "input"])
def test_code_for_no_reading_is_left_out_and_shown(code, rows, role):
    bad = SMOOTH.copy()
    bad[rows] = code
    values = (FORCE, bad) if role == "output" else (bad, SMOOTH)
    found = repaired("data", signals(), values)
    changed = found.values[1 if role == "output" else 0]
    assert np.flatnonzero(np.isnan(changed)).tolist() == rows
    (remark,) = found.remarks
    assert f"{code:.6g} in row {rows[0]}" in remark


@pytest.mark.parametrize("y", [SMOOTH, 1e-6 * SMOOTH, 100 + SMOOTH, np.rint(50 * SMOOTH)])
@pytest.mark.parametrize(
    "rows", [[700], [700, 701], [3, 1000, 2500], [700, 703, 706], [0], [N - 1]]
)
@pytest.mark.parametrize("sign", [1, -1])
def test_spike_is_left_out_and_shown(y, rows, sign):
    bad = y.copy()
    bad[rows] += sign * 3 * np.ptp(y)
    found, (remark,) = read(bad)
    assert np.flatnonzero(np.isnan(found)).tolist() == rows
    assert f"in row {rows[0]}" in remark
    kept, (remark,) = read(bad, outliers="keep")
    np.testing.assert_array_equal(kept, bad)
    assert "are kept" in remark


def test_spike_within_the_range_of_a_smooth_motion_is_left_out():
    bad = 5.0 * np.sin(2 * np.pi * 3.0 * TIME_S) + 1e-2 * NOISE
    bad[700] -= 2.0  # 15 times the step from row to row
    found, _ = read(bad)
    assert np.flatnonzero(np.isnan(found)).tolist() == [700]


def test_lost_decimal_point_is_left_out():
    bad = 2.5 + 0.1 * SMOOTH
    bad[1234] *= 1000
    found, _ = read(bad)
    assert np.flatnonzero(np.isnan(found)).tolist() == [1234]


def test_spike_at_a_pulse_of_the_input_is_kept():
    pulse = np.zeros(N)
    pulse[2000] = 5.0
    y = NOISE.copy()
    y[2000] += 1.0
    found, remarks = read(y, pulse)
    np.testing.assert_array_equal(found, y)
    assert any("in row 2000) are kept (an input" in remark for remark in remarks)


def test_value_of_an_input_far_beyond_all_others_is_shown():
    force = FORCE.copy()
    force[1500] = 1e4
    found = repaired("data", signals(), [force, SMOOTH])
    np.testing.assert_array_equal(found.values[0], force)
    assert "(10000 in row 1500) are kept (it may jump by design; if" in found.remarks[0]


def test_level_far_from_all_other_values_is_shown():
    bad = 2.5 + 0.1 * SMOOTH
    bad[:20] = 0.0
    found, (remark,) = read(bad)
    np.testing.assert_array_equal(found, bad)
    assert "0 in 20 rows, from row 0 on" in remark
    assert "set missing: [0]" in remark


@pytest.mark.parametrize("rows", [0, 1, 2, 3, 5, 7, 12, 25])
@pytest.mark.parametrize("keys", [{}, {"wraps": 360}])
def test_short_or_empty_columns_are_kept(rows, keys):
    for y in (np.full(rows, np.nan), np.arange(rows) % 2.0, 100.0 * np.arange(rows) % 360.0):
        found, _ = read(y, np.zeros(rows), **keys)
        assert found.shape == y.shape


def test_stated_codes_are_left_out():
    bad = SMOOTH.copy()
    bad[[10, 20]] = 0.5
    found, (remark,) = read(bad, missing=[0.5, "lost"])
    assert np.flatnonzero(np.isnan(found)).tolist() == [10, 20]
    assert "2 values listed in missing" in remark


def test_wrapped_signal_with_codes_is_repaired():
    true = 360.0 * TIME_S
    bad = true % 360.0
    bad[[100, 1700]] = -9999.0
    found, _ = read(bad)
    known = ~np.isnan(found)
    assert np.flatnonzero(~known).tolist() == [100, 1700]
    np.testing.assert_allclose(found[known], true[known], atol=1e-9)
