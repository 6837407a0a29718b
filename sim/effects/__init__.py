"""Effects: what the simulated plant does and the declared model does not know, as small classes.

A class has any of these hooks; each is called once per internal step, in this order, and effects
chain in the order of the SIM.yaml:

    reset(plant)                      once before the first step, see EffectPlant
    coil_force(t_s, q, force_n)       -> (C,) N: what the coils really give; force_n is their mean
                                         over the step, and what is changed acts over the whole step
    wrench(t_s, q, qd, beam)          -> (3,) N m, N m, N from outside the platform
    mass(t_s)                         -> (3, 3) symmetric, added to the mass matrix
    beam_force(t_s, beam, q, qd)      -> N on the beam along x, from the platform
    gap(t_s, gap_m)                   -> (S,) m: what the sensors really see

q is [psi, theta, z], qd its rate, beam a BeamState, all at t_s, the step's begin; `gap` is called
at the end of the step, and once before the first. Every array is the effect's own copy.

Shipped effects stand in the modules of this package, a family a file; docs/effects.md lists them.
"""

from .contract import HOOKS, BeamState, EffectError, EffectGeometry, EffectPlant
from .loader import Effects

__all__ = ["HOOKS", "BeamState", "EffectError", "EffectGeometry", "EffectPlant", "Effects"]
