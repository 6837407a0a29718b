"""Compute the sampled response of the declared model with modes, and its sensitivities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ....model.declared_model import DeclaredModel
from ....model.second_order import SecondOrder
from ...loop_spectra.spectral_lines import PointLines
from .mode import Mode
from .transients import transient_columns

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_IMAGES = 24
"""Images of the spectrum on either side that count; the response falls with the third power of the
frequency at least, so what is left out is below 1e-5 of it."""
_NODES = 49
"""Frequencies at which images are computed: in the band they are smooth."""
_DIFFERENCE = 1e-4

ParameterName = str | tuple[int, str] | tuple[int, int, int]
"""A parameter of the model file; (mode, "omega" or "damping"); (mode, row, column) of strength."""


@dataclass(frozen=True)
class LinearPlant:
    """The declared model at its parameter values, and modes beside it."""

    model: DeclaredModel
    modes: tuple[Mode, ...] = ()

    def moved(self, names: Sequence[ParameterName], step: Array) -> LinearPlant:
        """Return the plant with its parameters changed by step (N,), in SI units."""
        values, modes = {}, [replace(m, strength=m.strength.copy()) for m in self.modes]
        for name, change in zip(names, step.tolist(), strict=True):
            if isinstance(name, str):
                values[name] = self.model.values[name] + change
            elif len(name) == 3:
                k, i, j = name
                modes[k].strength[i, j] += change
                if modes[k].kind == "attached" and i != j:
                    modes[k].strength[j, i] += change
            else:
                k, what = name
                modes[k] = replace(modes[k], **{what: getattr(modes[k], what) + change})
        return LinearPlant(self.model.with_values(values), tuple(modes))

    def response(self, point: PointLines) -> Complex:
        """Return P (F, n, p) from the command to the output at the point's lines, held (zoh).

        It is the sum over the images s + 2 pi k j / Ts of the continuous response times hold, lag
        and delay, which is exact for any fraction of a period.
        """
        at = self.model.at(point.schedule)
        f, Ts_s, delay_s = point.freq_hz, point.Ts_s, point.delay_s
        nodes = np.linspace(f[0], f[-1], _NODES) if len(f) > _NODES else f
        orders = np.array([k for k in range(-_IMAGES, _IMAGES + 1) if k != 0])
        shifted = (nodes + orders[:, None] / Ts_s).ravel()
        images = _held_response(at, self.modes, shifted, Ts_s, delay_s)
        summed = images.reshape(len(orders), len(nodes), *images.shape[1:]).sum(axis=0)
        if len(f) > _NODES:
            summed = CubicSpline(nodes, summed)(f)
        return np.asarray(_held_response(at, self.modes, f, Ts_s, delay_s) + summed)

    def compliance(self, point: PointLines) -> Complex:
        """Return the response (F, n, p) to a force that acts at once and is not held."""
        return continuous_response(self, point.schedule, point.freq_hz)

    def free_motions(self, point: PointLines) -> Complex:
        """Return columns (F, n, T) of the motions that begin and end of a record leave."""
        return transient_columns(self.model.at(point.schedule), self.modes, point)


def continuous_response(
    plant: LinearPlant, schedule: Mapping[str, float], freq_hz: Array
) -> Complex:
    """Return the response (F, n, p) from an acting force to the output, without hold and lag."""
    s = np.asarray(2j * np.pi * freq_hz)
    return _continuous(plant.model.at(schedule), plant.modes, s)[0]


def sensitivities(
    plant: LinearPlant, point: PointLines, names: Sequence[ParameterName], scales: Array
) -> Complex:
    """Return dP / dparameter (N, F, n, p) for parameters by name.

    `scales` (N,): typical changes, for the differences of the declared matrices.
    """
    at = plant.model.at(point.schedule)
    changes = [
        _change(plant.model, point.schedule, name, _DIFFERENCE * scale)
        if isinstance(name, str)
        else None
        for name, scale in zip(names, scales, strict=True)
    ]
    f = point.freq_hz
    found = _held_sensitivities(at, plant.modes, names, changes, f, point)
    nodes = np.linspace(f[0], f[-1], _NODES) if len(f) > _NODES else f
    images = sum(
        (
            _held_sensitivities(at, plant.modes, names, changes, nodes + k / point.Ts_s, point)
            for k in (-2, -1, 1, 2)  # an error in them slows the search down, no more
        ),
        start=np.zeros(1),
    )
    return found + (CubicSpline(nodes, images, axis=1)(f) if len(f) > _NODES else images)


def _held_sensitivities(
    at: SecondOrder,
    modes: Sequence[Mode],
    names: Sequence[ParameterName],
    changes: Sequence[SecondOrder | None],
    freq_hz: Array,
    point: PointLines,
) -> Complex:
    s, g = held(at, freq_hz, point.Ts_s, point.delay_s)
    X, Q = _continuous(at, modes, s)
    QB = Q @ at.B
    # A changed entry of row a and column b changes P by - g Q[:, a] (Q B)[b, :] s^power.
    by_entry = np.einsum("f,fia,fbj->abfij", -g, Q, QB, optimize=True)
    lag = -s / (1.0 + s * at.lag_s)
    found = np.zeros((len(names), *X.shape), complex)
    for k, (name, change) in enumerate(zip(names, changes, strict=True)):
        if change is None:
            assert not isinstance(name, str)
            found[k] = _by_mode(modes[name[0]], name, s, g, Q, QB)
            continue
        for matrix, power in ((change.M, s * s), (change.D, s), (change.K, np.ones_like(s))):
            for a, b in np.argwhere(matrix != 0.0):
                found[k] += (matrix[a, b] * power)[:, None, None] * by_entry[a, b]
        if np.any(change.B):
            found[k] += g[:, None, None] * (Q @ change.B)
        if change.lag_s or change.delay_s:
            found[k] += (g * (change.lag_s * lag - change.delay_s * s))[:, None, None] * X
    return found


def _held_response(
    at: SecondOrder, modes: Sequence[Mode], freq_hz: Array, Ts_s: float, delay_s: float
) -> Complex:
    s, g = held(at, freq_hz, Ts_s, delay_s)
    return np.asarray(g[:, None, None] * _continuous(at, modes, s)[0])


def held(at: SecondOrder, freq_hz: Array, Ts_s: float, delay_s: float) -> tuple[Complex, Complex]:
    """Return s (F,), and hold times delay times lag (F,)."""
    s = np.asarray(2j * np.pi * freq_hz)
    hold = -np.expm1(-s * Ts_s) / (s * Ts_s)
    return s, np.asarray(hold * np.exp(-s * (at.delay_s + delay_s)) / (1.0 + s * at.lag_s))


def _continuous(at: SecondOrder, modes: Sequence[Mode], s: Complex) -> tuple[Complex, Complex]:
    """Return the response (F, n, p) without hold and lag, and the compliance Q (F, n, n)."""
    Z = (s * s)[:, None, None] * at.M + s[:, None, None] * at.D + at.K
    for m in modes:
        if m.kind == "attached":
            Z = Z - (s**4 / m.denominator(s))[:, None, None] * m.strength
    Q = np.linalg.inv(Z)
    X = Q @ at.B
    for m in modes:
        if m.kind != "attached":
            X = X + m.strength / m.denominator(s)[:, None, None]
    return np.asarray(X), np.asarray(Q)


def _by_mode(
    m: Mode,
    name: tuple[int, str] | tuple[int, int, int],
    s: Complex,
    g: Complex,
    Q: Complex,
    QB: Complex,
) -> Complex:
    d = m.denominator(s)
    if len(name) == 2:
        slope = 2.0 * (m.damping * s + m.omega) if name[1] == "omega" else 2.0 * m.omega * s
        factor = -(g * slope / d**2)[:, None, None]
        if m.kind == "attached":
            return np.asarray(factor * (s**4)[:, None, None] * (Q @ m.strength @ QB))
        return np.asarray(factor * m.strength)
    _, i, j = name
    if m.kind == "attached":
        part = Q[:, :, i, None] * QB[:, j, None, :]
        if i != j:
            part = part + Q[:, :, j, None] * QB[:, i, None, :]
        return np.asarray((g * s**4 / d)[:, None, None] * part)
    found = np.zeros_like(QB)
    found[:, i, j] = g / d
    return found


def _change(
    model: DeclaredModel, schedule: Mapping[str, float], name: str, step: float
) -> SecondOrder:
    """Return the derivatives of the matrices with respect to a parameter."""
    value = model.values[name]
    below, above = value - step, value + step
    if name in model.lag.names:
        below = max(below, 0.0)  # a lag is not negative
    along = {key: np.array([x]) for key, x in schedule.items()}
    entries = model.changes(name, below, above, along)
    n, p = len(model.dof), len(model.inputs)
    found = {key: np.zeros((n, p if key == "B" else n)) for key in ("M", "D", "K", "B")}
    for key, matrix in found.items():
        for row, column, change in entries[key]:
            matrix[row, column] = float(np.ravel(change)[0]) / (above - below)
    low, high = ({**model.values, **schedule, name: x} for x in (below, above))
    lag_s, delay_s = (
        (formula(high) - formula(low)) / (above - below) if name in formula.names else 0.0
        for formula in (model.lag, model.delay)
    )
    return SecondOrder(**found, force=np.zeros(n), lag_s=lag_s, delay_s=delay_s)
