"""The unlisted effects whose trace is published: each against an independent calculation."""

from __future__ import annotations

import numpy as np
import pytest

from levid.benchmarks.trace.simulated_unlisted_effects import (
    ClosedCover,
    PassedCoil,
    RectifiedDrive,
)
from levid.sim.effects import BeamState


def test_closed_cover_presses_ahead_of_the_beam_as_much_as_it_lifts_behind() -> None:
    cover = ClosedCover(zeta=40.0, width_m=0.24, half_length_m=0.14)
    for x, v in ((0.0, 0.3), (0.07, 0.3), (0.07, -0.3), (-0.1, 0.15), (0.05, 0.0)):
        dp = 0.5 * 1.2 * 40 * v * abs(v)
        at = (np.arange(2800) + 0.5) * 1e-4 - 0.14
        p = np.where(at > x, dp * (0.14 + x), -dp * (0.14 - x)) / 0.28
        lift = -0.24 * 1e-4 * p
        assert lift.sum() == pytest.approx(0.0, abs=1e-12)
        tau = cover.wrench(0, np.zeros(3), np.zeros(3), BeamState(x, v, 0, 0, 0, 0))
        np.testing.assert_allclose(tau, [0, lift @ at, 0], rtol=1e-5, atol=1e-15)


def test_rectified_drive_shows_the_power_of_three_half_bridges() -> None:
    """The variance of the sum of their centred pulses, over a turn of the field."""

    def power(modulation: float) -> float:
        turn = (np.arange(120) + 0.5) / 120 * 2 * np.pi
        within = np.abs((np.arange(2000) + 0.5) / 2000 - 0.5)
        legs = turn[:, None] - np.arange(3) * 2 * np.pi / 3
        shares = 0.5 + 0.5 * modulation * np.cos(legs)
        voltage = (within < 0.5 * shares[:, :, None]).sum(axis=1)
        return float(voltage.var(axis=1).mean())

    drive = RectifiedDrive(sensor=3, offset_m=1e-5, end_speed_rad_s=25.0, motor_s=0.03)

    def seen(rate: float, acceleration: float) -> float:
        drive.wrench(0, np.ones(3), np.ones(3), BeamState(0.1, 0.3, 2, 1, rate, acceleration))
        gap = drive.gap(0, np.zeros(9))
        assert not np.delete(gap, 3).any()
        return float(gap[3])

    for rate, acceleration, share in ((18, 0, 0.72), (-18, 0, 0.72), (9, 50, 0.42), (9, -50, 0.3)):
        missing = power(share) / power(0.0) - 1.0
        # The ripple of the field within a turn, and 2000 steps a period, are left out.
        assert seen(rate, acceleration) == pytest.approx(1e-5 * missing, rel=5e-3)
    assert seen(0, 0) == 0.0
    assert seen(40, 0) == seen(25, 0)  # the drive is at its limit


def test_passed_coil_pushes_the_magnets_as_one_dipole_another() -> None:
    """The force is the slope along z of the energy of two upright dipoles."""
    coil = PassedCoil(coil=5, share=0.02, at_m=0.01, apart_m=0.03)
    coil.reset(None)
    forces = np.arange(1.0, 10.0)
    np.testing.assert_array_equal(coil.coil_force(0, np.zeros(3), forces.copy()), forces)

    def energy(x_m: float, z_m: float) -> float:
        return (x_m**2 - 2 * z_m**2) / np.hypot(x_m, z_m) ** 5

    def force(x_m: float) -> float:
        return (energy(x_m, 0.03 - 1e-6) - energy(x_m, 0.03 + 1e-6)) / 2e-6

    for x in (-0.1, -0.02, 0.01, 0.02, 0.035, 0.06):
        coil.wrench(0, np.ones(3), np.ones(3), BeamState(x, 0.3, 2, 1, 5, 9))
        pushed = coil.coil_force(0, np.zeros(3), forces.copy())
        share = 0.02 * force(x - 0.01) / force(0.0)
        assert pushed[5] / 6.0 - 1.0 == pytest.approx(share, rel=1e-6, abs=1e-9)
        np.testing.assert_array_equal(np.delete(pushed, 5), np.delete(forces, 5))
