"""Shared helpers for tests of effects: the rig's geometry, effect classes, effects after reset."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from typing import Any

import numpy as np

from levid.model.effects.base import Places, Signals
from levid.model.geometry import shape_matrix
from levid.sim import effects
from levid.sim.effects import HOOKS, EffectGeometry, EffectPlant

CLASSES = {
    "rod_stiffness", "air_damping", "friction", "flexible_mode", "centre_of_mass", "payload",
    "beam_motion", "cogging", "rotor", "coil_gain", "force_constant", "actuator_lag", "delay",
    "dead_zone", "force_offset", "thermal_drift", "saturation", "sensor_gain", "sensor_offset",
    "sensor_nonlinearity", "sensor_crosstalk", "sensor_lag", "sensor_stuck", "vibration",
    "external_field", "sensor_scale", "coil_scale", "arm_length", "backlash",
}  # fmt: skip
"""Effect classes that `levid trace` can report on the rig, apart from `unknown`."""
DT_S, R_M, BEAM_Z_M = 1e-4, 0.12, 0.06
X_M, Y_M = R_M * np.repeat([1.0, 0.0, -1.0], 3), R_M * np.tile([1.0, 0.0, -1.0], 3)
"""Positions of the coils, and of the sensors under them."""


def rig_places(span_s: tuple[float, float] = (0.0, 60.0), lacks: int = 0) -> Places:
    """Return the rig's actuators and sensors, for a session of this time span.

    The first `lacks` coils, and the sensors under them, are left out.
    """
    shape, xy = shape_matrix(X_M, Y_M)[lacks:], np.stack([X_M, Y_M], axis=1)[lacks:]
    return Places(
        ("psi", "theta", "z"), ("rad", "rad", "m"), shape, shape, "N", ("N m", "N m", "N"), "m",
        xy, xy, beam=True, span_s=span_s,
    )  # fmt: skip


def effect_plant(seed: int = 1) -> EffectPlant:
    """Return the plant description that the rig passes to an effect."""
    geometry = EffectGeometry(R_M, X_M, Y_M, BEAM_Z_M, X_M, Y_M)
    return EffectPlant(DT_S, np.random.default_rng(seed), geometry)


def fresh(effect: Any, seed: int = 1) -> Any:
    """Reset the effect for the rig and steps of DT_S, if it has a `reset`; return it."""
    if hasattr(effect, "reset"):
        effect.reset(effect_plant(seed))
    return effect


def shipped_effects() -> set[str]:
    """Return module:Class of each class in sim.effects with a hook, except base classes."""
    found = {}
    for module in pkgutil.iter_modules(effects.__path__):
        # These modules hold no effects: the contract, its loader, and effects of model files.
        if module.name in ("effect_interface", "declared", "loader"):
            continue
        name = f"{effects.__name__}.{module.name}"
        for cls in vars(importlib.import_module(name)).values():
            hooked = inspect.isclass(cls) and any(hasattr(cls, hook) for hook in HOOKS)
            if hooked and cls.__module__ == name:
                found[f"{module.name}:{cls.__name__}"] = cls
    bases = {base for cls in found.values() for base in cls.__mro__[1:]}
    return {use for use, cls in found.items() if cls not in bases}


def moving() -> Signals:
    draw = np.random.default_rng(1).standard_normal
    motion = [1e-3 * draw((200, 3)) for _ in range(3)]
    return Signals(
        0.01, np.arange(200) * 0.01, *motion, draw((200, 9)),
        *(draw(200) for _ in range(6)), 1, rig_places((0.0, 2.0)),
    )  # fmt: skip


def acts(term):
    """Return the contribution of a term: a force, a reading or a coil input."""
    (there,) = (part for part in (term.force, term.gap, term.held) if part is not None)
    return there
