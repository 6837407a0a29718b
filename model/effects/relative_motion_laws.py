"""Laws of friction, backlash, stiffness and damping between two DOF: of couplings, gears, belts.

They are those of a single DOF, of the relative motion that a declared spring or damper sees; the
force acts on both ends. A linear spring or damper is among them: an entry of K or D with the wrong
sign leaves the declared one no value that fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from . import (
    backlash,
    damping,
    end_stop,
    friction,
    friction_leveling_off,
    linear_entries,
    stiffness,
)
from .base import Build, Effect, Joint, Places, Signals, Term
from .operating_range import Extent

_LINEAR = ("linear.stiffness", "linear.damping")


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the laws of every joint of a plant; the rig has none."""
    found = []
    for joint, seen in zip(places.joints, extent.joints, strict=True):
        alone = replace(
            places,
            dof=(joint.name,),
            dof_units=(joint.unit,),
            force_units=(joint.force_unit,),
            joints=(),
        )
        reach, speed, middle = seen
        covered = replace(extent, reach=(reach,), speed=(speed,), middle=(middle,), joints=())
        own = [
            *stiffness.effects(alone, covered),
            *damping.effects(alone, covered),
            *friction.effects(alone, covered),
            *friction_leveling_off.effects(alone, covered),
            *backlash.effects(alone, covered),
            *end_stop.effects(alone, covered),
            *(e for e in linear_entries.effects(alone) if e.key in _LINEAR),
        ]
        found += [_on_joint(e, joint, alone) for e in own if e.where == (joint.name,)]
    return found


def _on_joint(effect: Effect, joint: Joint, alone: Places) -> Effect:
    decay = effect.initial_force_decay
    return replace(
        effect,
        build=partial(_pushed, law=effect.build, joint=joint, alone=alone),
        initial_force_decay=None
        if decay is None
        else partial(_pushed, law=decay, joint=joint, alone=alone),
    )


def _pushed(
    signals: Signals, shape: Sequence[float], *, law: Build, joint: Joint, alone: Places
) -> list[Term]:
    """Return the terms of a law of one motion, as forces on the DOF of its joint."""
    q, qd, qdd = (x @ joint.motion[:, None] for x in (signals.q, signals.qd, signals.qdd))
    terms = law(replace(signals, q=q, qd=qd, qdd=qdd, places=alone), shape)
    return [
        Term(force=None if t.force is None else np.outer(t.force[:, 0], joint.pull)) for t in terms
    ]
