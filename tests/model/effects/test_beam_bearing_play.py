"""Test the play of the beam in its bearings against the simulator's, and in its limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_test_helpers import BEAM_Z_M, rig_places

from levid.model.effects import beam_bearing_play
from levid.model.effects.base import Signals
from levid.model.effects.operating_range import Extent
from levid.sim.effects import EffectGeometry, EffectPlant
from levid.sim.effects.bearing import BearingPlay
from levid.sim.effects.effect_interface import BeamState

MASS_KG, STIFFNESS_N_M, DAMPING_N_S_M, G = 1.4, 3.2e5, 400.0, 9.81
RATE_RAD_S = np.sqrt(STIFFNESS_N_M / MASS_KG)
TS, FINE = 1e-3, 100
THETA = 1


def tilting(rows: int, Ts_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return tilt, rate and acceleration (N,) of four tones."""
    w = 2 * np.pi * np.array([2.0, 5.0, 11.0, 17.0])
    angle = w * (np.arange(rows) * Ts_s)[:, None] + np.array([0.3, 1.0, 2.0, 4.0])
    size = 1e-3 / w * w[0]
    return (
        (size * np.sin(angle)).sum(axis=1),
        (size * w * np.cos(angle)).sum(axis=1),
        (-size * w * w * np.sin(angle)).sum(axis=1),
    )


def signals(rows: int, a_b_m_s2: np.ndarray | float = 0.0) -> Signals:
    q, qd, qdd = np.zeros((3, rows, 3))
    q[:, THETA], qd[:, THETA], qdd[:, THETA] = tilting(rows, TS)
    still = np.zeros(rows)
    return Signals(
        TS, np.arange(rows) * TS, q, qd, qdd, np.zeros((rows, 9)), still, still,
        still + a_b_m_s2, still, still, still, 1, rig_places((0.0, rows * TS)),
    )  # fmt: skip


def force(s: Signals, half_m: float, where: str = "theta") -> np.ndarray:
    """Return the generalised force (N, n) of the beam's whole inertia."""
    effects = beam_bearing_play.effects(s.places, Extent.typical(s.places))
    (effect,) = (e for e in effects if e.where[1] == where)
    damping = DAMPING_N_S_M / (2 * MASS_KG * RATE_RAD_S)
    shape = (RATE_RAD_S / (2 * np.pi), damping, half_m / BEAM_Z_M, BEAM_Z_M)
    (term,) = effect.build(s, shape)
    assert term.force is not None
    return np.asarray(MASS_KG * BEAM_Z_M**2 * term.force)


def simulated(rows: int, play_m: float, a_b_m_s2: float = 0.0) -> np.ndarray:
    """Return the torque (N,) of the simulator's effect at the rows, in steps of TS / FINE."""
    effect = BearingPlay("x", MASS_KG, play_m, STIFFNESS_N_M, DAMPING_N_S_M)
    nowhere = np.zeros(1)
    geometry = EffectGeometry(0.12, nowhere, nowhere, BEAM_Z_M, nowhere, nowhere)
    effect.reset(EffectPlant(TS / FINE, np.random.default_rng(0), geometry))
    q, qd, _ = tilting(rows * FINE, TS / FINE)
    beam = BeamState(0.0, 0.0, a_b_m_s2, 0.0, 0.0, 0.0)
    return np.array(
        [
            effect.wrench(0.0, np.array([0.0, a, 0.0]), np.array([0.0, b, 0.0]), beam)[THETA]
            for a, b in zip(q, qd, strict=True)
        ]
    )[::FINE]


def smooth(torque: np.ndarray) -> np.ndarray:
    """Return means over ten rows: the blow of a contact takes less than one."""
    return np.asarray(torque[200:].reshape(-1, 10).mean(axis=1))


@pytest.mark.parametrize(("a_b_m_s2", "tolerance"), [(0.0, 0.1), (0.5, 0.01)])
def test_law_is_that_of_the_simulator(a_b_m_s2: float, tolerance: float) -> None:
    """Both integrate the same equation by other methods, in steps that differ by a factor of 30.

    Where the beam bounces, one that comes a little later makes the next ones later; pushed by its
    acceleration, it stays on one side. The simulated beam starts unstrained, so the first rows are
    not compared.
    """
    rows, play_m = 1000, 5e-6
    found = force(signals(rows, a_b_m_s2), 0.5 * play_m)
    expected = smooth(simulated(rows, play_m, a_b_m_s2))
    assert not np.any(np.delete(found, THETA, axis=1))
    assert (smooth(found[:, THETA]) - expected).std() < tolerance * expected.std()
    if a_b_m_s2 == 0.0:
        rigid = smooth(force(signals(rows), 1e-12)[:, THETA])
        assert (rigid - expected).std() > 0.3 * expected.std()


def test_beam_without_room_adds_its_inertia() -> None:
    """Far below the contact's 76 Hz the force is -m q'', as the declared model has it."""
    s = signals(3000)
    inertia = MASS_KG * BEAM_Z_M**2 * s.qdd[:, THETA]
    off = force(s, 1e-12)[500:, THETA] + inertia[500:]
    assert off.std() < 0.1 * inertia.std()


def test_beam_in_a_wide_gap_falls_freely() -> None:
    """Nothing touches: the beam moves by its weight only, and its place pulls at the platform."""
    rows = 300
    s = signals(rows)
    q = s.q[:, THETA]
    found = force(s, 1e-2)[:, THETA]
    # It starts on the stop to which the tilt pulls it, with the platform's speed.
    place, rate = np.sign(q[0]) * 1e-2 / BEAM_Z_M + q[0], s.qd[0, THETA]
    pull = G * q / BEAM_Z_M
    moved = np.concatenate([[0.0], np.cumsum(0.5 * (pull[1:] + pull[:-1]) * TS)])
    way = np.concatenate([[0.0], np.cumsum(0.5 * (moved[1:] + moved[:-1]) * TS)])
    x = place + rate * np.arange(rows) * TS + way - q
    free = np.abs(x) < 1e-2 / BEAM_Z_M
    expected = MASS_KG * BEAM_Z_M**2 * G / BEAM_Z_M * (x - q)
    last = 10 + int(np.argmin(free[10:]))  # before it comes to the other stop
    assert last > 30
    np.testing.assert_allclose(found[10:last], expected[10:last], rtol=1e-3)


def test_shift_across_the_rails_does_not_feel_the_beams_acceleration() -> None:
    s = signals(500)
    q = np.roll(s.q, -1, axis=1)
    across = replace(s, q=q, qd=np.roll(s.qd, -1, axis=1), qdd=np.roll(s.qdd, -1, axis=1))
    pushed = replace(across, a_b_m_s2=np.full(500, 2.0))
    np.testing.assert_array_equal(force(across, 1e-6, "psi"), force(pushed, 1e-6, "psi"))
    assert np.any(force(across, 1e-6, "theta") != force(pushed, 1e-6, "theta"))
