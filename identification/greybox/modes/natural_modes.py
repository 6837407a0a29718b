"""Compute the natural frequencies of a structure with the modes beside it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from scipy.linalg import eig

from .sampled_response import LinearPlant

Origin = Literal["declared", "bending", "attached"]


def natural_modes(
    plant: LinearPlant, schedule: Mapping[str, float]
) -> tuple[tuple[float, Origin], ...]:
    """Return the natural frequencies in Hz at a point of the schedule, and what each belongs to."""
    poles = natural_poles(plant, schedule)
    return tuple((abs(s) / (2.0 * np.pi), origin) for s, origin in poles)


def natural_poles(
    plant: LinearPlant, schedule: Mapping[str, float]
) -> tuple[tuple[complex, Origin], ...]:
    """Return the poles in rad/s with positive imaginary part, by size, and what each belongs to.

    A body on the structure moves with it: its resonance is above that of the body on a base at
    rest. An oscillation belongs to a body if most of its speed is there.
    """
    at = plant.model.at(schedule)
    bodies = [m for m in plant.modes if m.kind == "attached"]
    n, b = len(at.M), len(bodies)
    M, D, K = (np.zeros((n + b, n + b)) for _ in range(3))
    M[:n, :n], D[:n, :n], K[:n, :n] = at.M, at.D, at.K
    scale = np.ones(n + b)
    scale[:n] = np.sqrt(np.diag(at.M))
    for k, body in enumerate(bodies, start=n):
        # A body of mass m on g^T q: m (w'' + g^T q'') + its spring and damper = 0.
        values, vectors = np.linalg.eigh(body.strength)
        mass, g = float(values[-1]), vectors[:, -1]
        M[:n, k], M[k, :n], M[k, k] = mass * g, mass * g, mass
        D[k, k], K[k, k] = 2.0 * body.damping * body.omega * mass, body.omega**2 * mass
        scale[k] = np.sqrt(mass) if mass > 0.0 else 1.0
    zero, eye = np.zeros_like(M), np.eye(n + b)
    s, v = eig(np.block([[zero, eye], [-K, -D]]), np.block([[eye, zero], [zero, M]]))
    found: list[tuple[complex, Origin]] = []
    for pole, vector in zip(s, v.T, strict=True):
        if pole.imag < 0.0 or not np.isfinite(pole) or pole == 0.0:
            continue
        energy = np.abs(scale * vector[: n + b]) ** 2
        of_body = float(energy[n:].sum()) > 0.5 * float(energy.sum())
        found.append((complex(pole), "attached" if of_body else "declared"))
    for m in plant.modes:
        if m.kind == "bending":
            s = m.omega * (-m.damping + 1j * np.sqrt(max(1.0 - m.damping**2, 0.0)))
            found.append((complex(s), "bending"))
    return tuple(sorted(found, key=lambda one: abs(one[0])))
