"""Free-form hysteresis of a coil's force over its command, such as that of an iron core.

The force is a weighted sum of stop operators of several widths: Prandtl's rate-independent model
(Brokate and Sprekels, *Hysteresis and Phase Transitions*, 1996, ch. 2). Like the forms in
`freeform` it does not name a cause: it gives the coil and the widths.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from math import inf

from .base import Effect, Places, Quantity, Signals, Term, on_coil
from .lag_and_hysteresis_recursions import slip_range
from .operating_range import Extent

_KEY = re.compile(r"unknown\.hysteresis\.command\[(?P<scale>[0-9.e+-]+)\]")
_WIDTHS = (0.05, 0.15, 0.4, 1.0, 2.5)
"""Widths of the stop operators over the command's standard deviation: from a small reversal dead
zone to an operator that never slips fully."""
_WIDE = 3.0


def hysteresis_effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the hysteresis effect of every coil."""
    return [_hysteresis(places, coil, _scale(extent, coil)) for coil in range(places.coils)]


def hysteresis_effect(places: Places, key: str, where: Sequence[str]) -> Effect | None:
    """Return the hysteresis effect with a model file's key and location; None for other keys."""
    found = _KEY.fullmatch(key)
    coils = places.actuators
    if found is None or len(where) != 1 or where[0] not in coils:
        return None
    try:
        scale = float(found["scale"])
    except ValueError:
        return None
    return _hysteresis(places, coils.index(where[0]), scale) if 0.0 < scale < inf else None


def hysteresis_signal(effect: Effect) -> str | None:
    """Return the coil of a hysteresis effect; None for other effects."""
    return effect.where[0] if _KEY.fullmatch(effect.key) else None


def _scale(extent: Extent, coil: int) -> float:
    sd = extent.commands[coil][1] if extent.commands else extent.command / _WIDE
    return float(f"{sd:.3g}")


def _hysteresis(places: Places, coil: int, scale: float) -> Effect:
    widths = ", ".join(f"{scale * w:.3g}" for w in _WIDTHS)
    unit = places.command_unit(coil)
    return Effect(
        f"unknown.hysteresis.command[{scale:g}]",
        places.worded("Force of a coil that depends on its command with hysteresis"),
        "unknown",
        (places.actuator(coil),),
        f"sum of c_k s_k, s_k' = F'/r_k within -1 .. 1, r_k = {widths} {unit}",
        tuple(Quantity(f"c{k}", unit) for k in range(1, len(_WIDTHS) + 1)),
        partial(_forces, coil=coil, scale=scale),
        initial_force_decay=partial(_remains, coil=coil, scale=scale),
        told_apart_by=places.worded(
            "excitation of this coil alone, with large slow and small minor loops"
        ),
    )


def _forces(signals: Signals, _: Sequence[float], *, coil: int, scale: float) -> list[Term]:
    stops = (slip_range(signals.coil[:, coil], scale * width) for width in _WIDTHS)
    return [on_coil(signals, coil, middle) for middle, _ in stops]


def _remains(signals: Signals, _: Sequence[float], *, coil: int, scale: float) -> list[Term]:
    """Return the decay of the stop operators' unknown initial states."""
    stops = (slip_range(signals.coil[:, coil], scale * width) for width in _WIDTHS)
    return [on_coil(signals, coil, half) for _, half in stops]
