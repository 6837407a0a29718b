"""Free-form effects: a residual without a known cause as a smooth function of measured signals.

A free form is a force on one DOF, the force of one coil or the reading error of one sensor. It is a
function of one signal, a signal times a function of another, a resonant response or a decaying
response to a signal. It does not name a cause: it gives the location, the signals that the residual
depends on and the function, and it improves the model.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from .base import Effect, Places, Quantity, Signals, Term, on_coil, on_dof, on_sensor, resolved
from .freeform_beam_position import wave_effect, wave_effects, wave_signals
from .freeform_coil_hysteresis import hysteresis_effect, hysteresis_effects, hysteresis_signal
from .freeform_leaky_integral import (
    leaky_integral_effect,
    leaky_integral_effects,
    leaky_integral_signals,
)
from .freeform_resonant_response import (
    filtered_response_effect,
    filtered_response_effects,
    filtered_response_signal,
)
from .freeform_sensor_heating import (
    thermal_reading_effect,
    thermal_reading_effects,
    thermal_reading_signals,
)
from .operating_range import Extent

Array = NDArray[np.float64]

DEGREE = 6
"""Degree of a polynomial in one signal."""
_PRODUCT_DEGREE = 2
_COMMAND_DEGREE = 3
"""Degree of a polynomial in a coil's command; each sensor has one for each coil."""
_SPLINES = 12
"""Number of cubic B-splines over the beam's travel or the session; they act locally."""
_FINE_SPLINES = 20
"""Number of cubic B-splines over a DOF for reading errors, which can have narrow steps."""
_WIDE = 3.0
"""Range of a polynomial in standard deviations; outside, it is constant."""
_TIME = "time"
_SPLINE_SIGNALS = ("x_b", _TIME)
"""Signals with functions that are splines; functions of other signals are polynomials."""
_ANGLE = "phi"
"""The rotor's angle; functions of it are its first two harmonics."""


@dataclass(frozen=True)
class Form:
    """A free form: `factor` times a function of `by`, or only the function.

    `by` and `factor` are signal names as in the key. `by` is normalised with `middle` and `scale`,
    `factor` with `unit`. `pieces`: the function is a spline, although the signal's default is a
    polynomial (a coil's force over its command, a reading error over a DOF).
    """

    by: str
    scale: float
    factor: str = ""
    unit: float = 1.0
    middle: float = 0.0
    pieces: bool = False

    @property
    def curve(self) -> bool:
        """Whether the function is a spline."""
        return self.by in _SPLINE_SIGNALS or self.pieces

    @property
    def key(self) -> str:
        """The name in a model file; it contains every field of the form."""
        by = self.by if self.by == _ANGLE else f"{self.by}[{self.scale:g}]"
        if self.by == _TIME or self.middle or self.pieces:
            by = f"{self.by}[{self.middle:g}+-{self.scale:g}]"
        if self.pieces and not self.by.startswith(_COIL):
            by += _CURVED
        return f"unknown.{self.factor}[{self.unit:g}]*{by}" if self.factor else f"unknown.{by}"

    @classmethod
    def of(cls, key: str) -> Form | None:
        """Return the form of a key; None if the key is not that of a form."""
        found = _KEY.fullmatch(key)
        if found is None or (found["scale"] is None) != (found["by"] == _ANGLE):
            return None
        if found["by"] == _TIME and found["middle"] is None:
            return None
        try:
            scale, unit = float(found["scale"] or 1.0), float(found["unit"] or 1.0)
            middle = float(found["middle"] or 0.0)
        except ValueError:
            return None
        if not (scale > 0.0 and unit > 0.0 and np.isfinite([scale, unit, middle]).all()):
            return None
        if found["curved"] and (found["middle"] is None or found["by"].startswith(_COIL)):
            return None
        coiled = found["by"].startswith(_COIL) and found["middle"] is not None
        pieces = coiled or bool(found["curved"])
        return cls(found["by"], scale, found["factor"] or "", unit, middle, pieces)

    def functions(self, signals: Signals, constant: bool, acting: bool = True) -> Array:
        """Return the contribution of one unit of each amplitude along a trajectory (N, columns).

        `constant`: include a constant column without a factor; a force's constant is not
        identifiable, a reading's is. `acting`: use the coil forces acting at a row, not those
        commanded in it.
        """
        s = (_read(signals, self.by, acting) - self.middle) / self.scale
        if not self.factor:
            alone = self._shapes(s, _degree(self.by))
            return np.column_stack([np.ones(len(s)), alone]) if constant else alone
        driven = _read(signals, self.factor, acting) / self.unit
        whole = self._shapes(s, _PRODUCT_DEGREE)
        if not self.curve and self.by != _ANGLE:
            # Zero where the signal is zero: what the factor gives there is the model's own.
            whole = whole - self._shapes(np.array([-self.middle / self.scale]), _PRODUCT_DEGREE)
        if _constant_is_new(self.factor):
            whole = np.column_stack([np.ones(len(s)), whole])
        return np.asarray(driven[:, None] * whole)

    def amplitudes(self, constant: bool) -> tuple[str, ...]:
        """Return the names of the amplitudes."""
        first = _constant_is_new(self.factor) if self.factor else constant
        if self.by == _ANGLE:
            return (*(("c0",) if first else ()), "sin", "cos", "sin2", "cos2")
        polynomial = _PRODUCT_DEGREE if self.factor else _degree(self.by)
        count = self._splines - 1 if self.curve else polynomial
        return tuple(f"c{k}" for k in range(0 if first else 1, count + 1))

    @property
    def words(self) -> str:
        """The function in words."""
        kind = "a curve" if self.curve else "a polynomial"
        if self.by == _ANGLE:
            kind = "two harmonics"
        return f"{self.factor} f({self.by}), f {kind}" if self.factor else f"f({self.by}), {kind}"

    def _shapes(self, s: Array, degree: int) -> Array:
        """Return the basis functions (N, columns) of the normalised signal, without a constant."""
        if self.by == _ANGLE:
            return np.column_stack([wave(k * s) for k in (1, 2) for wave in (np.sin, np.cos)])
        s = np.clip(s, -1.0, 1.0)
        if not self.curve:
            return np.asarray(chebyshev.chebvander(s, degree)[:, 1:], float)
        knots = np.concatenate([[-1.0] * 3, np.linspace(-1.0, 1.0, self._splines - 2), [1.0] * 3])
        pieces = BSpline.design_matrix(s, knots, 3).toarray()
        # The splines sum to one: without the middle one, no combination is constant.
        return np.delete(pieces, self._splines // 2, axis=1)

    @property
    def _splines(self) -> int:
        fine = self.pieces and not self.by.startswith(_COIL)
        return _FINE_SPLINES if fine else _SPLINES


def freeform_effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the free forms of every DOF, sensor and coil, for every signal of the plant."""
    n = len(places.dof)
    found = []
    for i in range(n):
        forms = [_form(places, extent, by) for by in _signals(places)]
        forms += [_form(places, extent, by, factor) for factor, by in _products(places)]
        found += [_effect(places, places.dof[i], form) for form in forms]
    commands = [f"{_COIL}{c}" for c in range(places.coils)]
    # A reading error can depend on the signals of a force and on coil commands.
    read = [_form(places, extent, by) for by in (*_signals(places), *commands)]
    read = [replace(form, pieces=True) if form.by in places.dof else form for form in read]
    read += [_form(places, extent, by, factor) for factor, by in _products_read(places)]
    found += [_effect(places, f"sensor:{s}", form) for form in read for s in range(places.sensors)]
    for c, own in enumerate(commands):
        forms = [_curve(extent, c)]
        others = [by for by in commands if by != own] + (["x_b"] if places.beam else [])
        forms += [_form(places, extent, by, own) for by in others]
        found += [_effect(places, places.actuator(c), form) for form in forms]
    found += [
        *hysteresis_effects(places, extent),
        *leaky_integral_effects(places, extent),
        *filtered_response_effects(places),
    ]
    found += [*wave_effects(places, extent), *thermal_reading_effects(places)]
    return resolved(found, extent.fastest_hz)


def freeform_effect(places: Places, key: str, where: Sequence[str]) -> Effect | None:
    """Return the free form with a model file's key and location; None for other keys."""
    form = Form.of(key)
    if form is None:
        return (
            filtered_response_effect(places, key, where)
            or hysteresis_effect(places, key, where)
            or leaky_integral_effect(places, key, where)
            or wave_effect(places, key, where)
            or thermal_reading_effect(places, key, where)
        )
    known = _signals(places)
    sensors, coils = [f"sensor:{s}" for s in range(places.sensors)], places.actuators
    if len(where) != 1 or where[0] not in (*places.dof, *sensors, *coils):
        return None
    if where[0] not in places.dof:
        known += [f"{_COIL}{c}" for c in range(places.coils)]
    if where[0] in coils and form.factor not in ("", f"{_COIL}{coils.index(where[0])}"):
        return None
    if form.by not in known or (form.factor and form.factor not in known):
        return None
    return _effect(places, where[0], form)


def depends_on(effect: Effect) -> tuple[str, ...]:
    """Return the signals that a free form depends on, such as x_b, theta, theta' (its rate)."""
    form = Form.of(effect.key)
    if form is None:
        motion = filtered_response_signal(effect) or hysteresis_signal(effect)
        others = (
            leaky_integral_signals(effect)
            or wave_signals(effect)
            or thermal_reading_signals(effect)
        )
        return tuple(map(_spoken, others)) if motion is None else (motion,)
    return tuple(_spoken(word) for word in (form.factor, form.by) if word)


def _spoken(word: str) -> str:
    if word.startswith(_COIL):
        return word.replace("_", ":")
    return "phi'" if word == "phi_speed" else word.replace("_rate", "'")


_KEY = re.compile(
    r"unknown\.(?:(?P<factor>\w+)\[(?P<unit>[0-9.e+-]+)\]\*)?"
    r"(?P<by>\w+)(?:\[(?:(?P<middle>[0-9.e+-]+)\+-)?(?P<scale>[0-9.e+-]+)\](?P<curved>~)?)?"
)
_CURVED = "~"
_BEAM = ("x_b", "v_b", "a_b", "phi_speed")
_COIL = "coil_"


def _signals(places: Places) -> list[str]:
    motion = [word for name in places.dof for word in (name, f"{name}_rate")]
    return [*motion, *((*_BEAM, _ANGLE) if places.beam else ()), _TIME]


def _products(places: Places) -> list[tuple[str, str]]:
    """Return pairs (factor, signal of the function that multiplies it) for forces."""
    speeds = [f"{name}_rate" for name in places.dof]
    pairs = [(a, b) for k, a in enumerate(places.dof) for b in places.dof[k + 1 :]]
    pairs += [(speed, name) for speed in speeds for name in places.dof]
    # Heat and wear change stiffness and damping over time.
    pairs += [(factor, _TIME) for factor in (*places.dof, *speeds)]
    if places.beam:
        pairs += [(factor, "x_b") for factor in (*places.dof, *speeds, "v_b", "a_b", "phi_speed")]
        # A tension stiffens and a compression softens, also the beam's reaction.
        pairs += [(factor, name) for factor in ("v_b", "a_b", "phi_speed") for name in places.dof]
        # Coriolis and gyroscopic forces.
        pairs += [(speed, by) for speed in speeds for by in ("phi_speed", "v_b")]
    return pairs


def _products_read(places: Places) -> list[tuple[str, str]]:
    """Return pairs (factor, signal of the function that multiplies it) for reading errors."""
    pairs = [(a, b) for k, a in enumerate(places.dof) for b in places.dof[k + 1 :]]
    pairs += [(name, _TIME) for name in places.dof]
    if places.beam:
        pairs += [(factor, "x_b") for factor in (*places.dof, "v_b", "a_b", "phi_speed")]
    return pairs


def _constant_is_new(factor: str) -> bool:
    """Return whether the factor alone is new; the model has the stiffness between all DOFs."""
    return factor.endswith("_rate") or factor in _BEAM or factor.startswith(_COIL)


def _degree(by: str) -> int:
    return _COMMAND_DEGREE if by.startswith(_COIL) else DEGREE


def _effect(places: Places, where: str, form: Form) -> Effect:
    if where in places.dof:
        dof = places.dof.index(where)
        what, unit = "Force", places.force_unit(dof)
        build = partial(_forces, form=form, dof=dof)
    elif where in places.actuators:
        coil = places.actuators.index(where)
        what, unit = places.worded("Force of a coil"), places.command_unit(coil)
        build = partial(_commands, form=form, coil=coil)
    else:
        sensor = int(where.partition(":")[2])
        what, unit = "Reading", places.sensor_unit
        build = partial(_readings, form=form, sensor=sensor)
    by = "the rotor's angle" if form.by == _ANGLE else _in_words(places, form.by)
    title = f"{what} that depends on {by}"
    if form.factor:
        title = f"{what} that depends on {_in_words(places, form.factor)} times a function of {by}"
    names = form.amplitudes(constant=where.startswith("sensor:"))
    amplitudes = tuple(Quantity(name, unit) for name in names)
    on = [_in_words(places, word) for word in (form.factor, form.by) if word]
    return Effect(
        form.key, title, "unknown", (where,), form.words, amplitudes, build,
        told_apart_by=f"records in which only {' and '.join(on)} change",
    )  # fmt: skip


def _forces(signals: Signals, _shape: Sequence[float], *, form: Form, dof: int) -> list[Term]:
    return [on_dof(signals, dof, column) for column in form.functions(signals, constant=False).T]


def _commands(signals: Signals, _shape: Sequence[float], *, form: Form, coil: int) -> list[Term]:
    columns = form.functions(signals, constant=False, acting=False).T
    return [on_coil(signals, coil, column) for column in columns]


def _in_words(places: Places, word: str) -> str:
    if not word.startswith(_COIL):
        return word
    return f"the command of {places.actuator(int(word.removeprefix(_COIL)))}"


def _readings(signals: Signals, _shape: Sequence[float], *, form: Form, sensor: int) -> list[Term]:
    columns = form.functions(signals, constant=True).T
    return [on_sensor(signals, sensor, column) for column in columns]


def _read(signals: Signals, word: str, acting: bool) -> Array:
    places = signals.places
    if word.startswith(_COIL):
        commanded = signals.coil[:, int(word.removeprefix(_COIL))]
        return signals.acting(commanded) if acting else commanded
    if word in places.dof:
        return np.asarray(signals.q[:, places.dof.index(word)])
    if word.endswith("_rate"):
        return np.asarray(signals.qd[:, places.dof.index(word.removesuffix("_rate"))])
    return {
        "x_b": signals.x_b_m,
        "v_b": signals.v_b_m_s,
        "a_b": signals.a_b_m_s2,
        "phi_speed": signals.phi_rad_s,
        _ANGLE: signals.phi_rad,
        _TIME: signals.time_s,
    }[word]


def _scale(places: Places, extent: Extent, word: str) -> float:
    """Return the scale that normalises a signal, to three digits, as in the key."""
    if word in places.dof:
        scale = _WIDE * extent.reach[places.dof.index(word)]
    elif word.endswith("_rate"):
        scale = _WIDE * extent.speed[places.dof.index(word.removesuffix("_rate"))]
    elif word == _TIME:
        scale = 0.5 * (places.span_s[1] - places.span_s[0]) or 1.0
    elif word == _ANGLE:
        scale = 1.0
    elif word.startswith(_COIL):
        scale = extent.command
    else:
        beam = max(0.5 * extent.beam_m, 1e-3)
        v, a, phi = extent.beam_rates
        # Without motion any scale is valid: use the rig's.
        scale = {
            "x_b": beam,
            "v_b": v or 4 * beam,
            "a_b": a or 40 * beam,
            "phi_speed": phi or 40.0,
        }[word]
    return float(f"{scale:.3g}")


def _middle(places: Places, extent: Extent, word: str) -> float:
    """Return the middle that a signal is counted from, as in the key."""
    if word in places.dof:
        return extent.around(places.dof.index(word))
    if word == "x_b":
        return extent.beam_middle_m
    return float(f"{0.5 * sum(places.span_s):g}") if word == _TIME else 0.0


def _curve(extent: Extent, coil: int) -> Form:
    """Return the free form of a coil's force over its own command."""
    middle, sd = extent.commands[coil] if extent.commands else (0.0, extent.command / _WIDE)
    return Form(f"{_COIL}{coil}", float(f"{_WIDE * sd:.3g}"), middle=middle, pieces=True)


def _form(places: Places, extent: Extent, by: str, factor: str = "") -> Form:
    scale, middle = _scale(places, extent, by), _middle(places, extent, by)
    return Form(by, scale, factor, _scale(places, extent, factor) if factor else 1.0, middle)
