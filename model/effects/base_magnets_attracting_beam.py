"""Magnets of the base that attract the moving beam: a force on the platform, periodic in x_b.

A vertical force on the beam at x_b acts on z and, with the arm x_b, on theta. The field over a row
of magnets is periodic with their pitch; its harmonics decay with the height (Furlani, *Permanent
Magnet and Electromechanical Devices*, 2001, ch. 4). Signature: a force that depends on the beam's
position only, not on its speed. Cogging of the drives, in contrast, is an internal force and moves
the platform only through the beam's motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof
from .operating_range import Extent

PERIOD_M = (20e-3, 100e-3)
_THETA, _Z = 1, 2
_APART = 1.3
"""Difference of neighbouring grid periods, in cycles over the travel; less is not resolvable."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the magnets' force on every DOF; empty for a plant without a beam."""
    if not places.beam:
        return []
    return [
        Effect(
            "external_field",
            "Magnets of the base that attract the beam",
            "external_field",
            (dof,),
            "force = a cos(2 pi x_b / period) + b sin(2 pi x_b / period)"
            + (", x_b times that at theta" if at_the_beam(i) else ""),
            (Quantity("a", places.force_unit(i)), Quantity("b", places.force_unit(i))),
            partial(_periodic, dof=i),
            (Quantity("period", "m", 0.25 * PERIOD_M[0], 2 * PERIOD_M[1], log=True),),
            tuple((period,) for period in periods_m(extent)),
            absorbed_by="over much less than a period: the beam's weight",
            told_apart_by="slow beam sweeps over the whole travel",
        )
        for i, dof in enumerate(places.dof)
    ]


def periods_m(extent: Extent) -> tuple[float, ...]:
    """Return the start values of the period of a wave along the beam's travel, in m."""
    low, high = 1 / PERIOD_M[1], 1 / PERIOD_M[0]
    steps = round((high - low) * max(extent.beam_m, 0.05) / _APART)
    return tuple(float(1 / k) for k in np.linspace(low, high, 1 + steps))


def at_the_beam(dof: int) -> bool:
    """Return whether a force on this DOF acts at the beam's position, so on theta too."""
    return dof == _Z


def waves_along(
    signals: Signals, period_m: float, dof: int, driven: Array | None = None
) -> list[Term]:
    """Return the terms of a cosine and a sine along x_b, multiplied by `driven` (N,) if given."""
    angle = 2 * np.pi / period_m * signals.x_b_m
    waves = np.cos(angle), np.sin(angle)
    if driven is not None:
        waves = driven * waves[0], driven * waves[1]
    if not at_the_beam(dof):
        return [on_dof(signals, dof, wave) for wave in waves]
    terms = []
    for wave in waves:
        force = np.zeros((signals.rows, len(signals.places.dof)))
        force[:, _THETA], force[:, _Z] = signals.x_b_m * wave, wave
        terms.append(Term(force=force))
    return terms


def _periodic(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    return waves_along(signals, shape[0], dof)
