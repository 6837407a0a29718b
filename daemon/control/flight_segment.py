"""Segment: consecutive cycles in one state, with the arrays that the loop needs to fly them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .coil_check import Pushes
from .states import State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Segment:
    """Hold `cycles` cycles in one state.

    Arrays have one row per cycle, or a single row for all cycles:
    v (n, 3): excitation in N m, N m, N; coil_excitation (n, C): in N; beam and rotor (n, 3):
    setpoints of position, velocity and acceleration; blend (n, 3): reference from the pose at rest
    (0) to the working point (1), fraction of the feed-forward, fraction of the total force.
    `engages`: control starts from the current pose. `lands`: reference and feed-forward fade out
    from their current values. `beam_feedforward`: the feed-forward carries the beam; where this
    changes, the integrators take over the weight of the beam, or give it back. `checks`: the coil
    check evaluates the readings after the segment.
    """

    state: State
    cycles: int
    v: Array
    coil_excitation: Array
    blend: Array
    beam: Array
    rotor: Array
    in_control: bool = True
    airborne: bool = True
    engages: bool = False
    lands: bool = False
    beam_feedforward: bool = True
    checks: Pushes | None = None


def idle_segment(cycles: int, coils: int, beam: Array, rotor: Array) -> Segment:
    """Return `cycles` of zero force, the manipulator held at the setpoints beam, rotor (3,)."""
    return Segment(
        State.IDLE,
        cycles,
        np.zeros((1, 3)),
        np.zeros((1, coils)),
        np.zeros((1, 3)),
        beam.reshape(1, 3),
        rotor.reshape(1, 3),
        in_control=False,
        airborne=False,
    )
