"""Test the detection of masses on springs on the DOFs; scipy simulates them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from effect_test_helpers import rig_places
from scipy import signal

from levid.identification.trace.records.dof_resonances import dof_resonances

TS_S, ROWS = 1e-3, 40_000
MASS_KG, DAMPER_N_S_M, SPRING_N_M = 7.0, 36.0, 2600.0
SENSOR_M = 1e-7 / 3


def lifted(seed: int, loose_kg: float, f_hz: float, zeta: float) -> SimpleNamespace:
    """Return a record of the platform's lift, with a mass on a spring on it."""
    rng, w = np.random.default_rng(seed), 2 * np.pi * f_hz
    k, c = loose_kg * w * w, 2 * zeta * loose_kg * w
    A = np.array([
        [0, 1, 0, 0],
        [-(SPRING_N_M + k) / MASS_KG, -(DAMPER_N_S_M + c) / MASS_KG, k / MASS_KG, c / MASS_KG],
        [0, 0, 0, 1],
        [w * w, 2 * zeta * w, -w * w, -2 * zeta * w],
    ])  # fmt: skip
    B = np.array([[0], [1 / MASS_KG], [0], [0]])
    plant = signal.StateSpace(A, B, [[1, 0, 0, 0]], [[0]]).to_discrete(TS_S)
    force = signal.lfilter(*signal.butter(2, 0.3), rng.standard_normal(ROWS)) * 3.0
    _, z, _ = signal.dlsim(plant, np.roll(force, 1))
    y = np.zeros((ROWS, 3))
    y[:, 2] = z[:, 0] + SENSOR_M * rng.standard_normal(ROWS)
    places = rig_places()
    coil = np.outer(force, np.linalg.pinv(places.coil_shape)[2])
    experiment = SimpleNamespace(Ts_s=TS_S, delay_cycles=1, moving=False, y=y)
    return SimpleNamespace(
        experiment=experiment, places=places, coil=coil, rows=ROWS, still=False, gap=y
    )


@pytest.mark.parametrize("f_hz", [8.0, 9.1, 22.0, 40.0, 63.0])
def test_small_mass_on_a_spring_is_found_near_its_frequency(f_hz: float) -> None:
    (found,) = dof_resonances([lifted(seed, 0.05, f_hz, 0.02) for seed in (1, 2)])
    assert found.dof == 2
    # It begins a fit: near enough is a third of the width of the response, 4 % of the frequency.
    assert found.frequency_hz == pytest.approx(f_hz, rel=0.02)
    assert 0.005 < found.damping < 0.1


def test_platform_without_a_loose_mass_has_no_resonance() -> None:
    assert dof_resonances([lifted(2, 1e-9, 20.0, 0.02)]) == ()


def test_moving_still_and_short_records_are_not_used() -> None:
    record = lifted(3, 0.03, 20.0, 0.02)
    record.still = True
    assert dof_resonances([record]) == ()
    record.still, record.rows = False, 3000
    assert dof_resonances([record]) == ()
