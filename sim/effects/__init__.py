"""Effects of the simulated plant that the declared model lacks, as classes with hooks.

A class has one or more of these hooks. Each is called once per internal step, in this order; the
effects of a SIM.yaml are called in the file's order, each with the result of the previous one:

    reset(plant)                      once before the first step, see EffectPlant
    coil_force(t_s, q, force_n)       -> (C,) N: true coil forces; force_n is their mean over the
                                         step, and the change acts over the whole step
    wrench(t_s, q, qd, beam)          -> (3,) N m, N m, N: external wrench on the platform
    mass(t_s)                         -> (3, 3) symmetric, added to the mass matrix
    beam_force(t_s, beam, q, qd)      -> N on the beam along x, from the platform
    gap(t_s, gap_m)                   -> (S,) m: gaps as the sensors measure them

q is [psi, theta, z], qd its rate, beam a BeamState, all at t_s, the step's begin. `gap` is called
at the end of the step, and once before the first step. Every array is a copy for the effect.

The modules of this package define the shipped effects; docs/effects.md lists them.
"""

from .effect_interface import HOOKS, BeamState, EffectError, EffectGeometry, EffectPlant
from .loader import Effects

__all__ = ["HOOKS", "BeamState", "EffectError", "EffectGeometry", "EffectPlant", "Effects"]
