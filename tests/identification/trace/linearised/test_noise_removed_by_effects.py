"""Test the noise that effects in the readings remove: two descriptions of one motion fit alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from declared_model_records import PLACES, point, record

from levid.identification.trace.linearised.linearisation_point import WorkingPoint, along
from levid.identification.trace.linearised.noise_removed_by_effects import noise_removed
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

EFFECTS = {e.key: e for e in all_effects(PLACES, Extent.typical(PLACES))}
SCALED = ("m_p", "m_b", "J_psi", "J_theta", "J_psitheta", "d", *(
    f"k_{k}" for k in ("psi", "theta", "z", "psitheta", "psiz", "thetaz")
))  # fmt: skip


def described(scale: float) -> WorkingPoint:
    """Return a description of the true plant in which all sensors read too much by `scale`.

    In its units masses, damping, stiffness and the noise of forces are larger by as much.
    """
    here, effect = point(), EFFECTS["sensor_scale"]
    model = here.model
    values = {k: v * (1.0 + scale) if k in SCALED else v for k, v in model.values.items()}
    placed = (Placed(effect, (), (scale,)),)
    noise = here.disturbance.noise.scaled(force=(1.0 + scale) ** 2)
    disturbance = replace(here.disturbance, noise=noise)
    return replace(
        here, model=replace(model, values=values), placed=placed, disturbance=disturbance
    )


@pytest.mark.parametrize("scale", [0.08, -0.08])
def test_with_the_noise_removed_two_descriptions_of_one_motion_fit_alike(scale: float) -> None:
    made = record("fixed", 21_000)
    squares = float(np.sum(along(point(), made).errors ** 2))
    instead = described(scale)
    own = float(np.sum(along(instead, made).errors ** 2))
    removed = float(noise_removed(instead, made).sum())
    assert abs(own - squares) > 0.1 * squares
    # The simulated noise is another one: the squares of some 1000 numbers scatter by 4 %.
    assert own + removed == pytest.approx(squares, abs=0.04 * abs(removed))


def test_effects_of_force_remove_no_noise() -> None:
    here, effect = point(), EFFECTS["coil_scale"]
    here = replace(here, placed=(Placed(effect, (), (0.08,)),))
    assert not np.any(noise_removed(here, record("fixed", 21_000)))
