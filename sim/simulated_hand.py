"""A hand that lifts the resting platform against its upper stops, for commissioning a simulator."""

from __future__ import annotations

import numpy as np

from ..config.sim import SimConfig
from .plant_arrays import GRAVITY_M_S2, stops_at
from .plant_kernels import Array

HOLDS = ("rest", "all", "x", "y")
"""At rest, lifted as a whole, at the side of positive x, at that of positive y."""
_WHOLE, _SIDE = 2.0, 1.2
"""Force over the weight: a side needs half of it, and the other side must stay down."""


def hand(config: SimConfig, hold: str) -> Array:
    """Return the wrench (3,) in N m, N m, N of a hand; raises ValueError for another hold."""
    if hold not in HOLDS:
        raise ValueError(f"expected one of {', '.join(HOLDS)}, found '{hold}'")
    x, y = (max(map(abs, places)) for places in stops_at(config))
    weight_n = (config.platform.m_p_kg + config.beam.m_b_kg) * GRAVITY_M_S2
    side_n = _SIDE * weight_n
    return {
        "rest": np.zeros(3),
        "all": np.array([0.0, 0.0, _WHOLE * weight_n]),
        "x": np.array([0.0, side_n * x, side_n]),
        "y": np.array([side_n * y, 0.0, side_n]),
    }[hold]
