"""What an effect is: forces and false readings that depend on how a plant moves, with parameters.

A declared model is linear in its motion; an effect is what it lacks. Evaluated along a trajectory,
measured or simulated, an effect gives for each of its amplitudes what one unit of it adds to the
commands, to the generalised forces, to what the sensors show or to the drives' force. Everything
else (regression on a residual, a joint fit, a simulation in the loop) follows from these.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Loads:
    """What single actuators were told in a session: mean squares (K, C) from times_s (K,) on.

    Squares are in the actuators' unit squared, times those of Signals.time_s; the last holds on.
    """

    times_s: tuple[float, ...]
    squares: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Places:
    """Where a plant can be acted on and looked at.

    dof (n): names. coil_shape (C, p): what one unit of each single actuator adds to the model's
    inputs. sensor_shape (S, n): what each single sensor shows of the pose. `coil_xy_m` (C, 2) and
    `sensor_xy_m` (S, 2) are places on the platform, empty where nobody knows of any. The rig alone
    has a `beam`.
    """

    dof: tuple[str, ...]
    dof_units: tuple[str, ...]
    coil_shape: Array
    sensor_shape: Array
    coil_unit: str
    input_units: tuple[str, ...]
    sensor_unit: str
    coil_xy_m: Array
    sensor_xy_m: Array
    beam: bool
    span_s: tuple[float, float] = (0.0, 1.0)
    """First and last time of all records, in which onsets are looked for."""
    loads: Loads | None = None
    """What was carried through the session, where that is known."""

    @property
    def coils(self) -> int:
        """Number of actuators, C."""
        return len(self.coil_shape)

    @property
    def sensors(self) -> int:
        """Number of sensors, S."""
        return len(self.sensor_shape)

    @property
    def decoupling(self) -> Array:
        """Return T (n, S), the least-squares inverse of the sensors' shape."""
        return np.asarray(np.linalg.pinv(self.sensor_shape))

    def force_unit(self, index: int) -> str:
        """Unit of the generalised force that belongs to a DOF."""
        return self.input_units[index] if index < len(self.input_units) else "1"


@dataclass(frozen=True)
class Signals:
    """A trajectory, row by row, SI units.

    time_s (N,) since the session began, through all of its records; q, qd, qdd (N, n); coil (N, C)
    commanded in each row, acting from `delay_cycles` rows later on for one period; x_b_m, v_b_m_s,
    a_b_m_s2, phi_rad, phi_rad_s, phi_rad_s2 (N,), zeros without a beam. `wrench` (N, p) acting in
    the middle of the period after each row, in the units of the model's inputs.
    """

    Ts_s: float
    time_s: Array
    q: Array
    qd: Array
    qdd: Array
    coil: Array
    x_b_m: Array
    v_b_m_s: Array
    a_b_m_s2: Array
    phi_rad: Array
    phi_rad_s: Array
    phi_rad_s2: Array
    delay_cycles: int
    places: Places
    lag_s: float = 0.0
    """First-order lag between a held command and its force."""
    gravity_m_s2: float = 9.81
    standing: NDArray[np.bool_] | None = None
    """Where each sensor's reading stands still though it should not (N, S); None for nowhere."""

    @property
    def rows(self) -> int:
        """Number of rows, N."""
        return len(self.time_s)

    def gap(self, sensor: int) -> Array:
        """Return the true height under one sensor (N,)."""
        return np.asarray(self.q @ self.places.sensor_shape[sensor])

    def when_acting(self, values: Array) -> Array:
        """Return samples (N, ...) in the middle of the period in which each row's command acts."""
        first = np.minimum(np.arange(self.rows) + self.delay_cycles, self.rows - 1)
        second = np.minimum(first + 1, self.rows - 1)
        return np.asarray(0.5 * (values[first] + values[second]))

    def acting(self, values: Array) -> Array:
        """Return commands (N, ...) as they act at each row: means of the periods around it."""
        now = np.maximum(np.arange(self.rows) - self.delay_cycles, 0)
        return np.asarray(0.5 * (values[now] + values[np.maximum(now - 1, 0)]))


@dataclass(frozen=True)
class Term:
    """What one unit of an amplitude adds, each (N, .) or None.

    held: to the model's inputs (N, p), commanded in a row, so held, delayed and lagged as commands
    are. force: generalised force (N, n) at the rows, straight in between. gap: to what the sensors
    show (N, S). drive: to the force of the beam's drives (N,).
    """

    held: Array | None = None
    force: Array | None = None
    gap: Array | None = None
    drive: Array | None = None

    def times(self, factor: float) -> Term:
        """Return the term of another amplitude."""
        return Term(*(None if a is None else factor * a for a in self.parts))

    @property
    def parts(self) -> tuple[Array | None, Array | None, Array | None, Array | None]:
        """held, force, gap, drive."""
        return self.held, self.force, self.gap, self.drive


@dataclass(frozen=True)
class Quantity:
    """A parameter of an effect: name, SI unit, and where it can lie."""

    name: str
    unit: str
    low: float = -np.inf
    high: float = np.inf
    log: bool = False
    """Whether it is searched for in ratios rather than differences."""


Build = Callable[[Signals, Sequence[float]], "list[Term]"]


@dataclass(frozen=True)
class Effect:
    """One physical effect at one place.

    `amplitudes` multiply the terms that `build(signals, shape)` returns, one each, in order;
    `shape` are parameters that the terms themselves depend on, tried at the rows of `grid` first.
    `key` names the equation in the table, `where` the DOF, coils or sensors. `options` are what
    `build` was bound to. Effects of one `group` explain the same data alike.
    """

    key: str
    title: str
    effect_class: str
    where: tuple[str, ...]
    equation: str
    amplitudes: tuple[Quantity, ...]
    build: Build
    shape: tuple[Quantity, ...] = ()
    grid: tuple[tuple[float, ...], ...] = ((),)
    absorbed_by: str = ""
    told_apart_by: str = ""
    remains: Build | None = None
    """What is left, row by row, of a unit of force that was there before the first and that nobody
    knows; None for effects without a memory."""
    plain: Callable[[Sequence[float], Sequence[float]], tuple[float, ...]] | None = None
    """Of amplitudes and a shape, the shape that does about the same with amplitudes of one, where
    those are what the equation has in books; None where amplitudes are numbers of their own."""

    @property
    def name(self) -> str:
        """Title and place, as people say it."""
        return f"{self.title} at {in_words(self.where)}" if self.where else self.title

    @property
    def identity(self) -> str:
        """A name that no other effect at no other place has."""
        return f"{self.key}@{'+'.join(self.where)}"


@dataclass(frozen=True)
class Placed:
    """An effect with values: shape and amplitudes, and their standard errors once known."""

    effect: Effect
    shape: tuple[float, ...]
    amplitudes: tuple[float, ...]
    standard_errors: Mapping[str, float] = field(default_factory=dict)

    def term(self, signals: Signals) -> Term:
        """Return what it adds in all."""
        terms = self.effect.build(signals, self.shape)
        return total([t.times(a) for t, a in zip(terms, self.amplitudes, strict=True)])

    def with_values(self, shape: Sequence[float], amplitudes: Sequence[float]) -> Placed:
        """Return it with other values."""
        return replace(
            self, shape=tuple(map(float, shape)), amplitudes=tuple(map(float, amplitudes))
        )


def in_words(where: Sequence[str]) -> str:
    """Return places as people say them: coil:0 to coil:8 for a row of more than two."""
    words: list[str] = []
    for _, row in groupby(enumerate(where), key=_in_row):
        names = [name for _, name in row]
        words += [f"{names[0]} to {names[-1]}"] if len(names) > 2 else names
    return ", ".join(words)


def _in_row(numbered: tuple[int, str]) -> tuple[str, int | str]:
    """Return what is the same for places that follow one another in a list."""
    at, name = numbered
    kind, _, number = name.partition(":")
    return (kind, int(number) - at) if number.isdecimal() else (kind, name)


def total(terms: Sequence[Term]) -> Term:
    """Return the sum of terms."""
    sums: list[Array | None] = [None, None, None, None]
    for term in terms:
        for i, part in enumerate(term.parts):
            if part is not None:
                known = sums[i]
                sums[i] = part if known is None else known + part
    return Term(*sums)


def resolved(effects: Sequence[Effect], fastest_hz: float) -> list[Effect]:
    """Return effects with their resonances looked for up to a frequency, without those beyond it.

    Above about half of the rate of sampling a resonance looks like one below.
    """
    return [one for effect in effects if (one := _resolved(effect, fastest_hz)) is not None]


def _resolved(effect: Effect, fastest_hz: float) -> Effect | None:
    at = next((i for i, q in enumerate(effect.shape) if q.unit == "Hz" and q.log), None)
    if at is None or effect.shape[at].high <= fastest_hz:
        return effect
    grid = tuple(row for row in effect.grid if row[at] < fastest_hz)
    if not grid:
        return None
    shape = list(effect.shape)
    shape[at] = replace(shape[at], high=fastest_hz)
    return replace(effect, shape=tuple(shape), grid=grid)


def on_dof(signals: Signals, index: int, values: Array) -> Term:
    """Return a term of a generalised force (N,) on one DOF."""
    force = np.zeros((signals.rows, len(signals.places.dof)))
    force[:, index] = values
    return Term(force=force)


def on_coil(signals: Signals, coil: int, values: Array) -> Term:
    """Return a term of one actuator's force, commanded (N,)."""
    return Term(held=values[:, None] * signals.places.coil_shape[coil])


def on_sensor(signals: Signals, sensor: int, values: Array) -> Term:
    """Return a term of what one sensor shows (N,)."""
    gap = np.zeros((signals.rows, signals.places.sensors))
    gap[:, sensor] = values
    return Term(gap=gap)
