"""Test the self-test of readings at rest, and the limits of late cycles."""

import re

import numpy as np
import pytest

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.control.late_cycle_detector import Lateness
from levid.daemon.control.self_test import self_test
from levid.log.signals import cycle_dtype
from levid.model.geometry import shape_matrix

RIG = load_rig(shipped("rigs/loopback.yaml"))


def at_rest(n: int = 200) -> np.ndarray:
    """Rows on the stops, a little tilted, with the sensors' noise of 0.1 um."""
    rng = np.random.default_rng(1)
    rows = np.zeros(n, cycle_dtype(9, 9))
    q = np.array([1e-4, -2e-4, -0.9e-3])
    plane = shape_matrix(RIG.geometry.coil_x_m, RIG.geometry.coil_y_m) @ q
    rows["gap_m"] = plane + rng.normal(0, 1e-7, (n, 9))
    rows["coil_readback_n"] = rng.normal(0, 1e-3, (n, 9))
    return rows


def test_sound_rig_passes() -> None:
    assert self_test(at_rest(), RIG) == ""


def test_no_rows_fail() -> None:
    assert self_test(at_rest(0), RIG) == "no channel responded"


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        (("gap_m", 4), 1.2e-3, "sensor 4 reads"),
        (("gap_m", 2), np.nan, "sensor"),
        (("gap_m", 7), -0.5e-3, "sensor 7 is .* off the plane"),
        (("coil_readback_n", 5), 1.0, "coil 5 "),
        (("beam_m", None), 0.15, "the beam is at"),
        (("beam_m_s", None), 0.1, "the beam moves"),
        (("rotor_rad_s", None), 1.0, "the rotor turns"),
    ],
)
def test_implausible_reading_is_named(field, value, words) -> None:
    rows = at_rest()
    name, channel = field
    if channel is None:
        rows[name] = value
    else:
        rows[name][:, channel] = value
    assert re.match(words, self_test(rows, RIG))


def test_moving_platform_fails() -> None:
    rows = at_rest()
    rows["gap_m"] += np.linspace(0, 3e-4, len(rows))[:, None]
    assert "at rest" in self_test(rows, RIG)


def lateness(longest_stall: int = 500, **limits: float) -> Lateness:
    return Lateness(RIG.limits.model_copy(update=limits), 1000.0, longest_stall)


def test_late_cycles_in_a_row_exceed_their_limit_and_punctual_cycles_recover() -> None:
    late = lateness(late_cycles=20)
    assert not any(late.exceeded(1) for _ in range(20))
    assert late.exceeded(1)
    late = lateness(late_cycles=20)
    for _ in range(50):  # one in eleven for ever
        assert not late.exceeded(1)
        assert not any(late.exceeded(0) for _ in range(10))
    assert late.late == 50


def test_separate_late_cycles_exceed_the_limit_of_a_window() -> None:
    late = lateness(late_in_window=30, late_window_s=1.0)
    found = [late.exceeded(int(k % 20 == 0)) for k in range(900)]
    assert found.index(True) == 600  # the 31st


def test_late_cycles_across_a_window_boundary_are_counted() -> None:
    late = lateness(late_in_window=30, late_window_s=1.0)
    # 25 late cycles before 1 s, and 25 after it: 50 within half a second.
    found = [late.exceeded(int(750 <= k < 1250 and k % 10 == 0)) for k in range(1300)]
    assert 1050 <= found.index(True) <= 1070
    late = lateness(late_in_window=30, late_window_s=1.0)
    # 25 per second stay below the limit for any length of time.
    assert not any(late.exceeded(int(k % 40 == 0)) for k in range(20_000))


def test_one_long_stall_exceeds_its_limit() -> None:
    late = lateness(longest_stall=500)
    assert not late.exceeded(500)
    assert late.exceeded(501)
    assert "stalled for 0.501 s" in late.reason


def test_readback_too_noisy_to_judge_coils_by_is_named() -> None:
    rows = at_rest()
    # Three times five standard deviations in a row do not occur; at a limit of two they would.
    rows["coil_readback_n"][:, 3] = np.random.default_rng(2).normal(0, 0.25, len(rows))
    assert self_test(rows, RIG).startswith("coil 3 reads back noise of 2.")
