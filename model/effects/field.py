"""Magnets of the base that pull at the moving beam: a force on the platform, periodic in the place.

What pulls the beam up does so where it stands: with z it turns theta, by the arm x_b.
The field over a row of magnets is periodic with their pitch, and its harmonics die away with the
height (Furlani, *Permanent Magnet and Electromechanical Devices*, 2001, ch. 4). Signature: follows
the place of the beam alone, at every speed the same; cogging of the drives is internal and moves
the platform only as far as it moves the beam.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_dof
from .extent import Extent

_PERIOD_M = (20e-3, 100e-3)
_THETA, _Z = 1, 2
_APART = 1.3
"""Cycles over the whole travel between two periods of the grid: less could not be told apart."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return a field's force on every DOF; nothing where there is no beam."""
    if not places.beam:
        return []
    low, high = 1 / _PERIOD_M[1], 1 / _PERIOD_M[0]
    steps = round((high - low) * max(extent.beam_m, 0.05) / _APART)
    return [
        Effect(
            "external_field",
            "Magnets of the base that pull at the beam",
            "external_field",
            (dof,),
            "force = a cos(2 pi x_b / period) + b sin(2 pi x_b / period)"
            + (", x_b times that at theta" if i == _Z else ""),
            (Quantity("a", places.force_unit(i)), Quantity("b", places.force_unit(i))),
            partial(_periodic, dof=i),
            (Quantity("period", "m", 0.25 * _PERIOD_M[0], 2 * _PERIOD_M[1], log=True),),
            tuple((float(1 / k),) for k in np.linspace(low, high, 1 + steps)),
            absorbed_by="over much less than a period: the beam's weight",
            told_apart_by="slow sweeps of the beam over its whole length",
        )
        for i, dof in enumerate(places.dof)
    ]


def _periodic(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    angle = 2 * np.pi / shape[0] * signals.x_b_m
    waves = np.cos(angle), np.sin(angle)
    if dof != _Z:
        return [on_dof(signals, dof, wave) for wave in waves]
    terms = []
    for wave in waves:
        force = np.zeros((signals.rows, len(signals.places.dof)))
        force[:, _THETA], force[:, _Z] = signals.x_b_m * wave, wave
        terms.append(Term(force=force))
    return terms
