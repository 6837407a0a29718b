"""Test the independent simulation of plants that are not the rig: known answers, drawn effects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import StateSpace, lsim

from levid.benchmarks.trace.imported_plant_cases import PLANTS, declared
from levid.benchmarks.trace.imported_plant_effects import CASES, LAWS, SIZES, case
from levid.benchmarks.trace.imported_plant_simulation import Acting, Kind, Linear, simulated
from levid.identification.trace.records.record_from_log import imported_places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

Array = NDArray[np.float64]


def spring_mass(Ts_s: float = 0.01) -> Linear:
    """A mass of 2 kg on a spring of 200 N/m with 3 N s/m, in open loop."""
    one = np.eye(1)
    return Linear(2.0 * one, 3.0 * one, 200.0 * one, one, 0 * one, 0 * one, np.zeros(1), Ts_s, 20)


def test_a_linear_plant_moves_as_its_exact_discretisation() -> None:
    v = np.random.default_rng(0).normal(size=(400, 1))
    motion = simulated(spring_mass(), v, np.random.default_rng(1))
    A, B = np.array([[0.0, 1.0], [-100.0, -1.5]]), np.array([[0.0], [0.5]])
    system = StateSpace(A, B, np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    _, y, _ = lsim(system, v[:, 0], 0.01 * np.arange(400), interp=False)
    # The midpoint rule's phase error: (omega h)^2 / 24 of a radian for each radian of motion, of
    # which there are forty.
    assert np.max(np.abs(motion.y[:, 0] - y)) < 1e-3 * np.max(np.abs(y))


def test_dry_friction_stops_a_mass_after_a_known_way() -> None:
    one = np.eye(1)
    free = Linear(one, 0 * one, 0 * one, one, 0 * one, 0 * one, np.zeros(1), 1e-3, 20)
    v = np.zeros((3500, 1))
    v[:1000] = 3.0
    numbers = np.array([1.0, 1e-4])
    motion = simulated(free, v, np.random.default_rng(0), Acting(Kind.COULOMB, 0, numbers))
    # 2 m/s^2 for 1 s, then -1 m/s^2 from 2 m/s: 1 m and 2 m.
    assert motion.q[-1, 0] == pytest.approx(3.0, abs=3e-3)
    assert abs(motion.w[-1, 0]) < 1e-6


@pytest.mark.parametrize(
    ("kind", "numbers", "commands", "forces"),
    [
        (Kind.DEAD_ZONE, [0.5], [2.0, 0.3, -1.0], [1.5, 0.0, -0.5]),
        (Kind.SATURATION, [2.0], [2.0, 0.3, -1.0], [0.5, 0.3, -0.5]),
        (Kind.QUANTISED, [0.4], [2.0, 0.3, -1.1], [2.0, 0.4, -1.2]),
        (Kind.SQUARED, [0.5], [2.0, 0.2, -1.0], [4.0, 0.22, -1.5]),
    ],
)
def test_an_actuator_gives_the_force_of_its_characteristic(
    kind: Kind, numbers: list[float], commands: list[float], forces: list[float]
) -> None:
    v = np.array(commands)[:, None]
    acting = Acting(kind, 0, np.array(numbers))
    motion = simulated(spring_mass(), v, np.random.default_rng(0), acting)
    np.testing.assert_allclose(motion.effect[:, 0] + v[:, 0], forces, atol=1e-12)


QUICKEST = ("pendulum", "levitation", "stage", "drive", "geared")


@pytest.mark.parametrize(
    ("plant", "law"),
    [
        *((next(p for p in QUICKEST if law in CASES[p]), law) for law in LAWS),
        ("pendulum", "gravity+coulomb"),
        ("stage", "coulomb+squared_actuator"),
        ("helicopter", "coulomb+drag"),
    ],
)
def test_forces_and_motion_of_a_case_balance(plant: str, law: str) -> None:
    drawn = case(plant, law, 900_000)
    m = drawn.motion
    linear = drawn.plant.linear(np.zeros(len(drawn.plant.dof)))
    inertia, rest = m.a @ linear.M.T, m.w @ linear.D.T + m.q @ linear.K.T
    left = inertia + rest - m.u @ linear.B.T - m.effect
    # Means of position and speed over a step are those of its ends, of which the rule takes the
    # middle: an error of the order (h d / m)^2, 0.6 % for a pendulum in a drag that stops it.
    assert np.all(left.std(axis=0) < 1e-2 * (inertia.std(axis=0) + rest.std(axis=0)))
    for effect in drawn.effects:
        if effect.law.kind not in (Kind.SINE, Kind.MAGNET, Kind.BENT):
            assert 0.2 * SIZES[0] < effect.size < 1.5 * SIZES[1]


def test_right_names_are_in_the_table_of_the_declared_model() -> None:
    for plant, some in CASES.items():
        rng = np.random.default_rng(0)
        config, _ = declared(PLANTS[plant](rng), rng, gain_off=False)
        places = imported_places(config)
        ones = (1.0,) * len(places.dof)
        commands, joints = ((0.0, 1.0),) * places.coils, ((1.0, 1.0, 0.0),) * len(places.joints)
        extent = Extent(ones, ones, 1.0, 1.0, 0.0, commands=commands, joints=joints)
        known = {e.effect_class for e in all_effects(places, replace(extent, fastest_hz=100.0))}
        for law in some:
            assert set(LAWS[law].right) <= known
