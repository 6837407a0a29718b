"""Say whether a rig's control loop is stable with its declared model, and with how much margin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...config.model import ModelConfig
from ...config.rig import RigConfig
from ...identification.greybox.declared_model_from_config import declared_model
from ...identification.subspace.simulation import spectral_radius
from ...model.controller import closed_loop, pi_controller
from ...model.second_order import SecondOrder, StateSpace, discretise
from .feed_forward import beam_derivatives
from .preflight_findings import Check, Finding, Outcome

Array = NDArray[np.float64]

_FACTORS = np.geomspace(1.0, 100.0, 201)
"""Factors of all gains, 2.3 % apart."""
_BEAM = (-1.0, 0.0, 1.0)
"""Positions of the beam over its limit."""
USUAL_GAIN_FACTOR = 2.0
"""Factor of all gains up to which a loop is usually stable: a gain margin of 6 dB."""
LEAST_GAIN_FACTOR = 1.5
"""Factor below which the loop may be unstable with the real plant, whose mass and coil gains may
each differ by a fifth from the declared: 1.2 / 0.8."""
_STABLE = 1.0 + 1e-9
"""Largest spectral radius of a stable loop: 1, and rounding."""


@dataclass(frozen=True)
class LoopStability:
    """Whether a loop is stable, and the factor of all gains at which that changes.

    growth_s: time in s in which a deviation grows by e, infinite for a stable loop. gain_factor: of
    a stable loop the largest factor of its gains up to which it stays stable, 100 if it is larger;
    of an unstable one the largest factor below 1 with which it is stable, 0 if there is none.
    """

    growth_s: float
    gain_factor: float


def loop_finding(rig: RigConfig, period_s: float) -> Finding:
    """Return whether the loop is stable with a usual margin; see loop_stability."""
    found = loop_stability(rig, period_s)
    if found is None:
        return Finding(Check.LOOP, Outcome.UNKNOWN, "the rig has no model")
    if np.isfinite(found.growth_s):
        words = f"unstable with the model: a deviation grows by e in {found.growth_s:.2g} s"
    else:
        words = f"stable with the model up to {found.gain_factor:.2g} times the gains"
    enough = not np.isfinite(found.growth_s) and found.gain_factor >= LEAST_GAIN_FACTOR
    return Finding.of(
        Check.LOOP,
        enough,
        f"{words}; expected {LEAST_GAIN_FACTOR:g} times or more",
        "lower the gains in RIG.yaml, or correct the model's delay and lag",
    )


def loop_stability(rig: RigConfig, period_s: float) -> LoopStability | None:
    """Return the stability of the PI loop, the worst with the beam at its limits and its centre.

    The model's lag and delay count, and the cycle between a reading and the force that follows from
    it. Limits of forces and the feed-forward do not: a loop that is stable without limits may leave
    them. None for a rig without a model.

    Raises:
        ConfigError: the model does not fit a rig.
    """
    found = [declared_plant(rig, share * rig.limits.beam_m, period_s) for share in _BEAM]
    plants = [plant for plant in found if plant is not None]
    if not plants:
        return None

    def radius(factor: float) -> float:
        return max(_radius(rig, plant, factor) for plant in plants)

    now = radius(1.0)
    if now > _STABLE:
        fewer = next((f for f in _FACTORS if radius(1.0 / f) <= _STABLE), np.inf)
        return LoopStability(float(period_s / np.log(now)), float(1.0 / fewer))
    stable = [radius(f) <= _STABLE for f in _FACTORS]
    last = int(np.argmin(stable)) - 1 if not all(stable) else len(stable) - 1
    return LoopStability(np.inf, float(_FACTORS[last]))


def declared_plant(rig: RigConfig, beam_m: float, period_s: float) -> StateSpace | None:
    """Return the declared plant with the beam at beam_m, sampled; None for a rig without a model.

    Its inputs act in the period after the one in which they were computed, and after the model's
    delay and lag. Raises ConfigError if the model does not fit a rig.
    """
    config = rig.model
    if not isinstance(config, ModelConfig):
        return None
    model = declared_model(config)
    positions = [name for name, order in beam_derivatives(config, model).items() if order == 0]
    at = model.at(dict.fromkeys(positions, beam_m))
    late_s = max(at.delay_s, 0.0) + period_s
    return discretise(
        SecondOrder(at.M, at.D, at.K, at.B, at.force, max(at.lag_s, 0.0), late_s), period_s
    )


def _radius(rig: RigConfig, plant: StateSpace, factor: float) -> float:
    """Return the spectral radius of the loop with all gains times a factor."""
    kp, ki = (factor * np.array(gains) for gains in (rig.control.kp, rig.control.ki))
    return spectral_radius(closed_loop(plant, pi_controller(kp, ki, plant.Ts_s)))
