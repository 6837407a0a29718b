"""Say whether a rig's control loop is stable with its declared model, and with how much margin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...config.model import ModelConfig
from ...config.rig import RigConfig
from ...identification.greybox.declared_model_from_config import declared_model
from ...model.controller import pi_controller
from ...model.second_order import SecondOrder, StateSpace, discretise

Array = NDArray[np.float64]

_FACTORS = np.geomspace(1.0, 100.0, 201)
"""Factors of all gains, 2.3 % apart."""
_BEAM = (-1.0, 0.0, 1.0)
"""Positions of the beam over its limit."""
_ROUNDING = 1e-9


@dataclass(frozen=True)
class LoopStability:
    """growth_s: time in which a deviation grows by e, infinite for a stable loop.

    gain_factor: largest factor of all gains up to which the loop is stable, at most 100, and at
    least as much as is still stable of an unstable one.
    """

    growth_s: float
    gain_factor: float


def loop_stability(rig: RigConfig, period_s: float) -> LoopStability | None:
    """Return the stability of the PI loop at the beam's limits and centre; None without a model.

    The model's lag and delay count, and the cycle between a reading and the force that follows from
    it. Limits of forces and the feed-forward do not: a loop that is stable without limits may leave
    them.
    """
    config = rig.model
    if not isinstance(config, ModelConfig):
        return None
    model = declared_model(config)
    positions = [n for n, s in config.scheduling.items() if _is_position(s.signal, s.derivative)]
    plants = []
    for share in _BEAM:
        at = model.at(dict.fromkeys(positions, share * rig.limits.beam_m))
        late_s = max(at.delay_s, 0.0) + period_s
        plants.append(
            discretise(
                SecondOrder(at.M, at.D, at.K, at.B, at.force, max(at.lag_s, 0.0), late_s), period_s
            )
        )

    def radius(factor: float) -> float:
        return max(_radius(rig, plant, factor) for plant in plants)

    now = radius(1.0)
    if now > 1.0 + _ROUNDING:
        fewer = next((f for f in _FACTORS if radius(1.0 / f) <= 1.0 + _ROUNDING), np.inf)
        return LoopStability(float(period_s / np.log(now)), float(1.0 / fewer))
    stable = [radius(f) <= 1.0 + _ROUNDING for f in _FACTORS]
    last = int(np.argmin(stable)) - 1 if not all(stable) else len(stable) - 1
    return LoopStability(np.inf, float(_FACTORS[last]))


def _is_position(signal: str, derivative: bool) -> bool:
    return signal in ("beam_m", "beam_ref_m") and not derivative


def _radius(rig: RigConfig, plant: StateSpace, factor: float) -> float:
    """Return the spectral radius of the loop with all gains times a factor."""
    kp, ki = (factor * np.array(gains) for gains in (rig.control.kp, rig.control.ki))
    C = pi_controller(kp, ki, plant.Ts_s)
    B_y, D_y = C.by_output
    closed = np.block([[plant.A + plant.B @ D_y @ plant.C, plant.B @ C.C], [B_y @ plant.C, C.A]])
    return float(np.abs(np.linalg.eigvals(closed)).max())
