"""Test the lines of a missing force over the position: a pitch of 200 over the travel is found."""

from __future__ import annotations

import numpy as np
import pytest

from levid.identification.trace.force_balance import position_spectrum


@pytest.mark.parametrize("pitch", [0.37, 0.05])
def test_a_fine_pitch_is_found_beside_a_friction_and_noise(pitch: float) -> None:
    rng, t = np.random.default_rng(4), np.arange(20_000) * 2e-3
    q = 5.0 * np.sin(0.7 * t) + 0.8 * np.sin(4.1 * t + 1.0)
    qd = np.gradient(q, 2e-3)
    force = (
        0.3 * np.cos(2 * np.pi * q / pitch + 0.4) + np.sign(qd) + 0.5 * rng.standard_normal(len(q))
    )
    first, *_ = position_spectrum._lines(q, qd, force, np.ones(len(q)), 50.0)
    # Half of the grid's step, half a cycle over the travel.
    assert np.ptp(q) / first == pytest.approx(np.ptp(q) / pitch, abs=0.26)


def test_a_fast_part_does_not_count() -> None:
    q = np.linspace(0.0, 10.0, 4000)
    force = np.cos(2 * np.pi * q / 0.1)
    whole = np.ones(4000)
    assert position_spectrum._power(q, np.full(4000, 2.0), force, whole, 0.1, 10.0) == 0.0
    assert position_spectrum._power(q, np.full(4000, 0.5), force, whole, 0.1, 10.0) > 1000.0


def test_a_dof_at_rest_has_no_line() -> None:
    none, whole = np.zeros(100), np.ones(100)
    assert position_spectrum._lines(none, none, whole, whole, 10.0) == ()


def test_a_ripple_is_a_line_of_what_is_in_proportion_to_the_command() -> None:
    rng, t = np.random.default_rng(5), np.arange(20_000) * 2e-3
    q, u = 5.0 * np.sin(0.7 * t), rng.standard_normal(20_000)
    force = u * (1.0 + 0.2 * np.sin(2 * np.pi * q / 0.9 + 1.0)) + 0.5 * rng.standard_normal(len(q))
    first, *_ = position_spectrum._lines(q, np.gradient(q, 2e-3), force, u, 50.0)
    assert np.ptp(q) / first == pytest.approx(np.ptp(q) / 0.9, abs=0.26)


def test_an_error_of_a_scale_is_a_line_of_what_is_in_proportion_to_the_squared_speed() -> None:
    rng, t = np.random.default_rng(6), np.arange(20_000) * 2e-3
    q = 5.0 * np.sin(0.7 * t)
    qd = np.gradient(q, 2e-3)
    force = qd**2 * np.sin(2 * np.pi * q / 0.9 + 1.0) + 5.0 * rng.standard_normal(len(q))
    first, *_ = position_spectrum._lines(q, qd, force, qd**2, 50.0)
    assert np.ptp(q) / first == pytest.approx(np.ptp(q) / 0.9, abs=0.26)
