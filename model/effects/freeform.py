"""A residual that no known effect explains, as a smooth function of what it depends on.

Each is a force on one DOF: a polynomial in one signal, or one signal times a polynomial in another.
They name nothing. They say where the force acts, on what it depends and how it looks, and leave a
model that is better after than before.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from .base import Effect, Places, Quantity, Signals, Term, on_dof
from .extent import Extent

Array = NDArray[np.float64]

DEGREE = 6
_PRODUCT_DEGREE = 2
_WIDE = 3.0
"""Standard deviations that a polynomial covers; beyond, it stays at its end."""


def freeform_effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the free-form forces of a plant, one for every DOF and signal it may depend on."""
    n, scale = len(places.dof), partial(_scale, places, extent)
    found = []
    for i in range(n):
        alone = [("position", i), ("speed", i)]
        others = [(kind, j) for j in range(n) if j != i for kind in ("position", "speed")]
        beam = [(kind, 0) for kind in ("x_b", "v_b", "a_b", "phi_speed")] if places.beam else []
        found += [_single(places, i, s, scale(s)) for s in (*alone, *others, *beam, ("time", 0))]
        if places.beam:
            found.append(_turning(places, i))
        moving = [("v_b", 0), ("phi_speed", 0)] if places.beam else []
        places_of = [alone[0], *(o for o in others if o[0] == "position")]
        where = [*places_of, ("x_b", 0)] if places.beam else places_of
        for factor in (*alone, *others, *moving):
            found += [
                _product(
                    places,
                    i,
                    factor,
                    _scale(places, extent, factor),
                    by,
                    _scale(places, extent, by),
                )
                for by in where
                if by != factor and (factor[0] != "position" or factor < by)
            ]
    return found


def freeform_effect(places: Places, key: str, where: Sequence[str]) -> Effect | None:
    """Return the free-form force that a model file names by key and DOF; None if it is none."""
    found = _KEY.fullmatch(key)
    if found is None or len(where) != 1 or where[0] not in places.dof:
        return None
    dof = places.dof.index(where[0])
    if key == _TURNING:
        return _turning(places, dof) if places.beam else None
    signals = {_words(places, s): s for s in _signals(places)}
    words, scales = [found["what"], found["by"]], [found["unit"], found["scale"]]
    if any(word is not None and word not in signals for word in words):
        return None
    first = (signals[words[0]], float(scales[0]))
    if words[1] is None:
        return _single(places, dof, *first)
    return _product(places, dof, *first, signals[words[1]], float(scales[1]))


def depends_on(effect: Effect) -> tuple[str, ...]:
    """Return the signals that a free-form force depends on: x_b, theta, theta' for its rate."""
    found = _KEY.fullmatch(effect.key)
    if found is None:
        return ()
    if effect.key == _TURNING:
        return ("phi",)
    words = [word for word in (found["what"], found["by"]) if word is not None]
    return tuple("phi'" if w == "phi_speed" else w.replace("_rate", "'") for w in words)


_TURNING = "unknown.phi"
_KEY = re.compile(
    r"unknown\.(?:phi|(?P<what>\w+)\[(?P<unit>[0-9.e+-]+)\]"
    r"(?:\*(?P<by>\w+)\[(?P<scale>[0-9.e+-]+)\])?)"
)


def _signals(places: Places) -> list[tuple[str, int]]:
    own = [(kind, i) for i in range(len(places.dof)) for kind in ("position", "speed")]
    beam = [(kind, 0) for kind in ("x_b", "v_b", "a_b", "phi_speed")] if places.beam else []
    return [*own, *beam, ("time", 0)]


def _single(places: Places, dof: int, signal: tuple[str, int], scale: float) -> Effect:
    what = _words(places, signal)
    return Effect(
        f"unknown.{what}[{scale:g}]",
        f"Force that depends on {what}",
        "unknown",
        (places.dof[dof],),
        f"f({what}), a polynomial of degree {DEGREE}",
        tuple(Quantity(f"c{k}", places.force_unit(dof)) for k in range(1, DEGREE + 1)),
        partial(_polynomial, dof=dof, signal=signal, scale=scale),
    )


def _product(
    places: Places,
    dof: int,
    factor: tuple[str, int],
    unit: float,
    by: tuple[str, int],
    scale: float,
) -> Effect:
    what, on = _words(places, factor), _words(places, by)
    return Effect(
        f"unknown.{what}[{unit:g}]*{on}[{scale:g}]",
        f"Force that depends on {what} times a function of {on}",
        "unknown",
        (places.dof[dof],),
        f"{what} f({on}), f a polynomial of degree {_PRODUCT_DEGREE}",
        tuple(Quantity(f"c{k}", places.force_unit(dof)) for k in range(1, _PRODUCT_DEGREE + 1)),
        partial(
            _factored,
            dof=dof,
            factor=factor,
            unit=unit,
            by=by,
            scale=scale,
        ),
    )


def _turning(places: Places, dof: int) -> Effect:
    names = ("sin", "cos", "sin2", "cos2")
    return Effect(
        _TURNING,
        "Force that depends on the rotor's angle",
        "unknown",
        (places.dof[dof],),
        "a sin phi + b cos phi + c sin 2 phi + d cos 2 phi",
        tuple(Quantity(name, places.force_unit(dof)) for name in names),
        partial(_angle, dof=dof),
    )


def _polynomial(
    signals: Signals, _shape: Sequence[float], *, dof: int, signal: tuple[str, int], scale: float
) -> list[Term]:
    s = np.clip(_read(signals, signal) / scale, -1.0, 1.0)
    basis = chebyshev.chebvander(s, DEGREE)
    return [on_dof(signals, dof, np.asarray(basis[:, k], float)) for k in range(1, DEGREE + 1)]


def _factored(
    signals: Signals,
    _shape: Sequence[float],
    *,
    dof: int,
    factor: tuple[str, int],
    unit: float,
    by: tuple[str, int],
    scale: float,
) -> list[Term]:
    basis = chebyshev.chebvander(np.clip(_read(signals, by) / scale, -1.0, 1.0), _PRODUCT_DEGREE)
    driven = _read(signals, factor) / unit
    return [
        on_dof(signals, dof, np.asarray(driven * basis[:, k], float))
        for k in range(1, _PRODUCT_DEGREE + 1)
    ]


def _angle(signals: Signals, _shape: Sequence[float], *, dof: int) -> list[Term]:
    phi = signals.phi_rad
    waves: tuple[Callable[[Array], Array], ...] = (np.sin, np.cos)
    return [on_dof(signals, dof, wave(k * phi)) for k in (1, 2) for wave in waves]


def _read(signals: Signals, signal: tuple[str, int]) -> Array:
    kind, i = signal
    if kind == "position":
        return np.asarray(signals.q[:, i])
    if kind == "speed":
        return np.asarray(signals.qd[:, i])
    if kind == "time":
        first, last = signals.places.span_s
        return np.asarray(signals.time_s - 0.5 * (first + last))
    return {
        "x_b": signals.x_b_m,
        "v_b": signals.v_b_m_s,
        "a_b": signals.a_b_m_s2,
        "phi_speed": signals.phi_rad_s,
    }[kind]


def _words(places: Places, signal: tuple[str, int]) -> str:
    kind, i = signal
    return {"position": places.dof[i], "speed": f"{places.dof[i]}_rate"}.get(kind, kind)


def _scale(places: Places, extent: Extent, signal: tuple[str, int]) -> float:
    """Return what a signal is measured by, to three digits, as it stands in the key."""
    kind, i = signal
    if kind == "position":
        scale = _WIDE * extent.reach[i]
    elif kind == "speed":
        scale = _WIDE * extent.speed[i]
    elif kind == "time":
        scale = 0.5 * (places.span_s[1] - places.span_s[0]) or 1.0
    else:
        beam = max(0.5 * extent.beam_m, 1e-3)
        scale = {"x_b": beam, "v_b": 4 * beam, "a_b": 40 * beam, "phi_speed": 40.0}[kind]
    return float(f"{scale:.3g}")
