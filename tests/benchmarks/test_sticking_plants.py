"""Test the plants that stick and twist: linear ones move exactly, and friction holds at rest."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cont2discrete

from levid.benchmarks.trace.moves_and_shafts import KINDS, declared
from levid.benchmarks.trace.sticking_plants import TS, Shaft, Stage


def simulated(A: np.ndarray, B: np.ndarray, C: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return outputs of a linear plant with held inputs, exactly."""
    Phi, Gamma, *_ = cont2discrete((A, B, C, np.zeros((len(C), 1))), TS)
    x, y = np.zeros(len(A)), np.zeros((len(u), len(C)))
    for k, now in enumerate(u):
        y[k] = C @ x
        x = Phi @ x + Gamma @ now
    return y


def test_linear_shaft_moves_as_its_exact_discretisation() -> None:
    p = Shaft()
    u, y = p.flown(3, rows=1000)
    K, D = np.array([[p.k, -p.k], [-p.k, p.k]]), np.array([[p.d1 + p.c, -p.c], [-p.c, p.c]])
    M = np.diag([p.j1, p.j2])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    B = np.array([[0.0], [0.0], [1 / p.j1], [0.0]])
    exact = simulated(A, B, np.eye(2, 4), u)
    assert np.abs(exact - y).max() < 1e-5 * np.ptp(y) + 5 * 2e-6  # five deviations of the noise


def test_stage_without_friction_moves_as_its_exact_discretisation() -> None:
    p = Stage()
    u, y = p.flown(3, rows=2000)
    A, B = np.array([[0.0, 1.0], [0.0, -p.d / p.m]]), np.array([[0.0], [p.kf / p.m]])
    exact = simulated(A, B, np.eye(1, 2), u)
    assert np.abs(exact - y).max() < 1e-4 * np.ptp(y) + 5 * 3e-7


def test_friction_holds_the_stage_while_the_force_is_below_it() -> None:
    p = Stage(friction=2.4)
    u, y = p.flown(3, rows=3000)
    rests = np.convolve(np.abs(np.diff(y[:, 0])) > 5e-6, np.ones(50), "same") == 0.0
    assert rests.mean() > 0.05  # the loop settles slowly
    force = p.kf * u[1:, 0][rests]
    assert np.abs(force).max() < 1.05 * p.friction
    assert np.ptp(force) > 0.5 * p.friction  # the loop's integral drives it meanwhile


@pytest.mark.parametrize("name", KINDS)
def test_declared_parameters_are_ten_to_twenty_percent_off(name: str) -> None:
    kind, rng = KINDS[name], np.random.default_rng(1)
    plant = kind.draw(rng)
    for key, parameter in declared(kind, plant, rng).parameters.items():
        off = abs(parameter.value / getattr(plant, key) - 1.0)
        assert off < 1e-6 if parameter.fixed else 0.099 < off < 0.201
