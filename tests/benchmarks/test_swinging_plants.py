"""Test the simulated plants of benchmarks/trace/sensors_and_swings.py, and its judgement."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim

from levid.benchmarks.trace.sensors_and_swings import KINDS, declared
from levid.benchmarks.trace.swinging_plants import Plant


def test_a_linear_axis_moves_as_its_exact_discretisation() -> None:
    plant = Plant(m1=2.0, d1=10.0, k1=800.0, rows=1000, noise=0.0)
    u, y = plant.flown(3)
    A, B = np.array([[0.0, 1.0], [-400.0, -5.0]]), np.array([[0.0], [0.5]])
    system = cont2discrete((A, B, np.array([[1.0, 0.0]]), np.zeros((1, 1))), plant.Ts_s)
    _, exact, _ = dlsim(system, u)
    # The midpoint rule in tenths of a row: a tenth of the noise.
    np.testing.assert_allclose(y, exact, atol=1.5e-4 * np.abs(exact).max())


def test_a_swinging_arm_keeps_its_energy() -> None:
    plant = Plant(
        m1=1.2, d1=0.0, k1=0.0, m2=0.04, h=0.1, w=0.98, sizes=(0.0, 0.0), rows=400, noise=0.0
    )
    flown = Plant(**{**vars(plant), "sizes": (8.0, 0.0), "rows": 400})
    u, y = flown.flown(1)
    Ts_s, (x, arm) = plant.Ts_s, y.T
    v, rate = np.gradient(x, Ts_s), np.gradient(arm, Ts_s)
    energy = 0.6 * v**2 + 0.02 * rate**2 + 0.1 * v * rate * np.cos(arm) - 0.98 * np.cos(arm)
    # What the force does: its power over each row, that of a held force by the way of the cart.
    work = np.concatenate([[0.0], np.cumsum(u[:-1, 0] * np.diff(x))])
    inner = slice(2, -2)  # central differences over two rows of 5 ms: within 2 %
    np.testing.assert_allclose(
        (energy - work)[inner] - (energy - work)[2], 0.0, atol=0.02 * work.std()
    )


def test_readings_are_those_of_the_calibration() -> None:
    plant = Plant(m1=2.0, d1=10.0, k1=800.0, sizes=(10.0, 0.0), noise=0.0, rows=1000)
    bent = Plant(**{**vars(plant), "bend2": 3.0, "bend3": 100.0})
    (_, h), (_, r) = plant.flown(2), bent.flown(2)
    np.testing.assert_allclose(r + 3.0 * r**2 + 100.0 * r**3, h, atol=1e-9)


@pytest.mark.parametrize("name", KINDS)
def test_declared_parameters_are_off_and_named_as_the_plants(name: str) -> None:
    kind, rng = KINDS[name], np.random.default_rng(5)
    plant = kind.draw(rng)
    config = declared(kind, plant, rng)
    for free in kind.names:
        truth = 2.0 * plant.mean if free == "b" else getattr(plant, free)
        assert 0.09 < abs(config.parameters[free].value / truth - 1.0) < 0.21
    assert len(config.inputs) == plant.inputs
    assert len(config.dof) == plant.axes
