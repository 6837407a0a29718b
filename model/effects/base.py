"""Define an effect: forces and reading errors as parametrised functions of a plant's motion.

A declared model is linear in its motion; effects add what it lacks. An effect is evaluated along a
measured or simulated trajectory. For each of its amplitudes it returns the contribution of one unit
to the commands, the generalised forces, the readings or the drives' force. Regression on a
residual, joint fits and closed-loop simulations all use these contributions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_COIL = "coil:"
_CARRIERS = ("beam", "rotor")
"""Locations that are neither DOF, actuators nor sensors."""
_OTHER_WORDS = (("a coil", "an actuator"), ("coil", "actuator"), ("the height", "the position"))
"""Words for the rig, and those for plants with any actuators."""


@dataclass(frozen=True)
class Loads:
    """Mean squares (K, C) of the actuator commands in a session, each valid from times_s (K,) on.

    Squares are in the actuators' unit squared; times_s is on the time axis of Signals.time_s. The
    last row is valid until the end. between (K,): whether a row is of the time between records, and
    its squares are those of the next record to it; empty without such rows.
    """

    times_s: tuple[float, ...]
    squares: tuple[tuple[float, ...], ...]
    between: tuple[bool, ...] = ()


@dataclass(frozen=True, eq=False)
class Joint:
    """A relative motion of DOF that a spring or damper of the model sees.

    name: the motion in words. motion (n,): its change per change of each DOF. pull (n,): force on
    each DOF per force of the joint.
    """

    name: str
    motion: Array
    pull: Array
    unit: str
    force_unit: str


@dataclass(frozen=True)
class Places:
    """DOF, actuators and sensors of a plant: the locations where effects can act.

    dof (n): names. coil_shape (C, p): contribution of one unit of each actuator to the model's
    inputs. sensor_shape (S, n): reading of each sensor per unit of pose. coil_xy_m (C, 2) and
    sensor_xy_m (S, 2): positions on the platform, empty if unknown. beam: whether the plant is the
    rig, with a beam.
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
    """First and last time of all records; effects with an onset are searched in between."""
    loads: Loads | None = None
    """Actuator commands over the session, if known."""
    input_names: tuple[str, ...] = ()
    """Names of the actuators (C,), with which a plant that is not the rig names their location."""

    force_units: tuple[str, ...] = ()
    """Units of the generalised forces (n,), if they are not those of the inputs."""

    input_motion: Array | None = None
    """Motion of each actuator per unit of pose (C, n), where it is not that of coil_shape: of an
    actuator that pushes one DOF, that DOF."""

    joints: tuple[Joint, ...] = ()
    """Relative motions of the DOF of an imported plant."""

    @property
    def coils(self) -> int:
        """Number of actuators, C."""
        return len(self.coil_shape)

    @property
    def sensors(self) -> int:
        """Number of sensors, S."""
        return len(self.sensor_shape)

    @property
    def actuator_motion(self) -> Array:
        """Motion of each actuator along its force, per unit of pose (C, n)."""
        return self.coil_shape if self.input_motion is None else self.input_motion

    def command_unit(self, index: int) -> str:
        """Unit of an actuator's command: its input's, or where these are no inputs, the coils'."""
        own = not self.beam and len(self.input_units) == self.coils
        return self.input_units[index] if own else self.coil_unit

    @property
    def one_command_unit(self) -> bool:
        """Whether all actuators have commands of one unit, and can have a limit in common."""
        return len({self.command_unit(c) for c in range(self.coils)}) == 1

    def motion_unit(self, index: int) -> str:
        """Unit of the motion of an actuator: that of the DOF that it pushes most."""
        if self.input_motion is None:
            return self.sensor_unit
        return self.dof_units[int(np.argmax(np.abs(self.input_motion[index])))]

    @property
    def decoupling(self) -> Array:
        """Return T (n, S), the least-squares inverse of the sensors' shape."""
        return np.asarray(np.linalg.pinv(self.sensor_shape))

    def actuator(self, index: int) -> str:
        """Return the location of an actuator: its input's name, or coil:N.

        It is coil:N on the rig, without a name, and if the name is that of another location.
        """
        if self.beam or index >= len(self.input_names):
            return f"{_COIL}{index}"
        name = self.input_names[index]
        taken = name in (*self.dof, *_CARRIERS) or self.input_names.count(name) > 1
        return f"{_COIL}{index}" if taken else name

    @property
    def actuators(self) -> tuple[str, ...]:
        """Locations of the actuators (C,), as effects name them."""
        return tuple(self.actuator(c) for c in range(self.coils))

    def motion_at(self, place: str) -> tuple[Array, Array]:
        """Return the motion at a DOF, a joint or an actuator per unit of pose (n,), and the force
        on each DOF per force there (n,); zeros for other places."""
        for joint in self.joints:
            if joint.name == place:
                return joint.motion, joint.pull
        found = np.zeros(len(self.dof))
        if place in self.dof:
            found = np.eye(len(self.dof))[self.dof.index(place)]
        elif place in self.actuators:
            found = self.actuator_motion[self.actuators.index(place)]
        return found, found

    def worded(self, text: str) -> str:
        """Return a text about the rig's coils and their heights in the words for this plant."""
        if self.beam:
            return text
        for word, other in _OTHER_WORDS:
            text = text.replace(word, other)
        return text

    def force_unit(self, index: int) -> str:
        """Unit of the generalised force that belongs to a DOF."""
        units = self.force_units or self.input_units
        return units[index] if index < len(units) else "1"


@dataclass(frozen=True)
class Signals:
    """A trajectory with N rows, in SI units.

    time_s (N,) since the session's begin, continuous over its records; q, qd, qdd (N, n); coil
    (N, C) commanded in each row, acting `delay_cycles` rows later for one period; x_b_m, v_b_m_s,
    a_b_m_s2, phi_rad, phi_rad_s, phi_rad_s2 (N,), zero without a beam.
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
    stuck: NDArray[np.bool_] | None = None
    """Rows where a sensor's reading is frozen (N, S); None if there are none."""
    sensor_arms: tuple[float, ...] = ()
    """Relative errors of the sensors' arms by DOF (n,); empty if they stand where declared."""
    around_rows: bool = False
    """Whether a force that turns within a row is its mean around the row, not that of the row: the
    force passes a low-pass then, and is not held or joined by lines from row to row."""

    @property
    def rows(self) -> int:
        """Number of rows, N."""
        return len(self.time_s)

    def gap(self, sensor: int) -> Array:
        """Return the true height at one sensor (N,) in m."""
        shape = self.places.sensor_shape[sensor]
        if self.sensor_arms:
            shape = shape * (1.0 + np.array(self.sensor_arms))
        return np.asarray(self.q @ shape)

    def while_acting(
        self, values: Array, rates: Array, law: Callable[[Array], Array]
    ) -> tuple[Array, Array]:
        """Return a law of samples over the periods in which the rows' commands act: means and first
        moments (..., N, C), these in periods from the middle.

        By Simpson's rule; values and rates (N, C) at the rows give those in the middle. The law of
        a mean of both ends would lack what it does between them.
        """
        first = np.minimum(np.arange(self.rows) + self.delay_cycles, self.rows - 1)
        second = np.minimum(first + 1, self.rows - 1)
        begin, end = values[first], values[second]
        middle = 0.5 * (begin + end) + self.Ts_s / 8.0 * (rates[first] - rates[second])
        begin, middle, end = law(begin), law(middle), law(end)
        return (begin + 4.0 * middle + end) / 6.0, (end - begin) / 12.0

    def acting(self, values: Array) -> Array:
        """Return the commands acting at each row (N, ...): means over the periods around it."""
        now = np.maximum(np.arange(self.rows) - self.delay_cycles, 0)
        return np.asarray(0.5 * (values[now] + values[np.maximum(now - 1, 0)]))


@dataclass(frozen=True)
class Term:
    """Contribution of one unit of an amplitude; each part has N rows or is None.

    held: addition to the model's inputs (N, p), held, delayed and lagged like a command. force:
    generalised force (N, n), linear between rows. gap: addition to the readings (N, S). drive:
    addition to the force of the beam's drives (N,).
    """

    held: Array | None = None
    force: Array | None = None
    gap: Array | None = None
    drive: Array | None = None

    def times(self, factor: float) -> Term:
        """Return the term multiplied by a factor."""
        return Term(*(None if a is None else factor * a for a in self.parts))

    @property
    def parts(self) -> tuple[Array | None, Array | None, Array | None, Array | None]:
        """The parts held, force, gap, drive, in this order."""
        return self.held, self.force, self.gap, self.drive


@dataclass(frozen=True)
class Quantity:
    """A parameter of an effect: name, SI unit and bounds."""

    name: str
    unit: str
    low: float = -np.inf
    high: float = np.inf
    log: bool = False
    """Whether a search takes steps in the logarithm of the value."""
    ends: bool = False
    """Whether the law at `high` is a limit that it may have, as a hard corner of a saturation. With
    others, a fit that ends there looks for what this law is not."""
    difference: float = 1e-3
    """Relative change with which such a value's derivatives are computed: more, where each bounce
    off a stop comes otherwise after the last one came a little otherwise."""
    another_above: float = np.inf
    """Value above which another law is meant, though this one is defined there."""
    another_below: bool = False
    """Whether another law begins at `low`, so that a fit which ends there looks for that one. Of an
    amplitude: whether without it nothing is left of what the law is named after."""
    corner: bool = False
    """Whether it is the frequency of a filter of commands: far above what records resolve, such a
    filter still makes them late."""


Reshape = Callable[[Sequence[float], Sequence[float]], tuple[float, ...]]
Build = Callable[[Signals, Sequence[float]], "list[Term]"]


@dataclass(frozen=True)
class Effect:
    """One physical effect at one location.

    `amplitudes` multiply the terms that `build(signals, shape)` returns, in this order. `shape` has
    the nonlinear parameters of the terms; the rows of `grid` are their start values. `key` names
    the equation in the effects table, `where` the DOF, coils or sensors. `absorbed_by` names the
    model parameters that can imitate the effect, `told_apart_by` the excitation that distinguishes
    it from its alternatives.
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
    initial_force_decay: Build | None = None
    """Terms of the decay of an unknown initial force (1 at row 0); None for effects without
    memory."""
    shape_of_unit_amplitude: Reshape | None = None
    """Function of amplitudes and shape that returns the shape with about the same effect at
    amplitudes of 1, for effects whose textbook equation has no amplitude; else None."""
    exact: bool = False
    """Whether the equation has no error of its own: it is one of geometry, or a linear term."""
    contains: Mapping[str, Callable[[Sequence[float]], tuple[float, ...]]] = field(
        default_factory=dict, compare=False
    )
    """Simpler laws, by key, that this one becomes without one of its amplitudes, or where no motion
    reaches one of its edges; the function returns their shape for a shape of this one."""
    along_motion: Callable[[Signals, Sequence[float], Sequence[float]], Term] | None = None
    """Function of a true motion, shape and amplitudes that returns the whole contribution, for
    effects whose terms are functions of the readings; None if terms are those of the motion."""
    equal_numbers: tuple[str, str] | None = None
    """Two numbers, by name, that are one if the law is all there is: lateness and duration of a
    lag; None without such a pair."""
    whole: bool = False
    """Whether its depth is 1 where the law is all there is: other values stand for another law."""
    same_if_linear: tuple[str, ...] = ()
    """Effects, by key, that no record tells from this one in a plant that is linear otherwise."""
    beside: str = ""
    """Key of the law at its place beside which alone it is asked: one more of the same kind."""
    before_lag: str = ""
    """Key of the law that does the same to the command, before a lag that the actuator has; this
    one acts behind it. Empty for laws that have no such twin."""
    of_session_time: bool = False
    """Whether it depends on the session's time: told from what it does, not declared."""
    linear: bool = False
    """Whether its force is in proportion to a term of a linear model: no other law, which becomes
    one at the end of its range, is then meant."""
    scales_readings: bool = False
    """Whether the first amplitude is a scale error of all readings, those of other effects too."""
    sensor_arms: tuple[int, ...] = ()
    coil_arms: tuple[int, ...] = ()
    """DOF by number for which the first amplitude is a relative error of the sensors' or the coils'
    arms: other effects of sensors read heights there, and of coils have torques by them."""

    @property
    def name(self) -> str:
        """Title and location in words."""
        return f"{self.title} at {in_words(self.where)}" if self.where else self.title

    @property
    def identity(self) -> str:
        """Unique name of this effect at this location."""
        return f"{self.key}@{'+'.join(self.where)}"

    def simpler(
        self, shape: Sequence[float], table: Sequence[Effect]
    ) -> list[tuple[Effect, tuple[float, ...]]]:
        """Return the laws that it contains and a table has at its place, the simplest first.

        Each comes with the shape that this law's shape becomes.
        """
        there = {e.key: e for e in table if e.where == self.where}
        pairs = self.contains.items()
        return [(there[key], tuple(reshape(shape))) for key, reshape in pairs if key in there]


@dataclass(frozen=True)
class Placed:
    """An effect with values of shape and amplitudes, and their standard errors if known."""

    effect: Effect
    shape: tuple[float, ...]
    amplitudes: tuple[float, ...]
    standard_errors: Mapping[str, float] = field(default_factory=dict)
    plain: bool = False
    """Whether a fit holds it to the law as textbooks have it: a depth of 1 (`Effect.whole`), one
    number for two that are equal (`Effect.equal_numbers`), a limit that ends (`Quantity.ends`)."""

    @property
    def values(self) -> tuple[float, ...]:
        """Amplitudes, then the numbers of the shape."""
        return (*self.amplitudes, *self.shape)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """What its values are, in their order."""
        return (*self.effect.amplitudes, *self.effect.shape)

    @property
    def lacks_its_own_force(self) -> bool:
        """Whether the force that its law is named after is zero, and only others are left."""
        pairs = zip(self.effect.amplitudes, self.amplitudes, strict=True)
        return any(q.another_below and value <= q.low for q, value in pairs)

    @property
    def freedom(self) -> Array:
        """Which values each number that is free in a fit changes (values, numbers), by 1 each."""
        names = [q.name for q in self.quantities]
        free = np.eye(len(names))
        if self.plain and self.effect.whole:
            return np.delete(free, names.index("depth"), axis=1)
        if self.plain and self._ending:
            return np.delete(free, [names.index(q.name) for q in self._ending], axis=1)
        if self.plain and self.effect.equal_numbers is not None:
            one, other = (names.index(name) for name in self.effect.equal_numbers)
            free[other, one] = 1.0
            return np.delete(free, other, axis=1)
        return free

    def as_textbook(self) -> Placed | None:
        """Return it held to the law as textbooks have it; None if its law has no such form here.

        An actuator that is earlier than declared has a negative lag, and no duration is negative.
        """
        names, values = [q.name for q in self.quantities], list(self.values)
        if self.effect.whole:
            reshape = self.effect.shape_of_unit_amplitude
            shape = self.shape if reshape is None else reshape(self.amplitudes, self.shape)
            bounds = zip(self.effect.shape, shape, strict=True)
            values[len(self.amplitudes) :] = [min(max(v, q.low), q.high) for q, v in bounds]
            values[names.index("depth")] = 1.0
        elif self.effect.equal_numbers is not None:
            one, other = (names.index(name) for name in self.effect.equal_numbers)
            values[other] = values[one]
        else:
            return None
        if not all(q.low <= v <= q.high for q, v in zip(self.quantities, values, strict=True)):
            return None
        count = len(self.amplitudes)
        return replace(self.with_values(values[count:], values[:count]), plain=True)

    def at_its_end(self) -> Placed | None:
        """Return it held where its law ends, as a saturation with a hard corner; None if it does
        not end."""
        if not self._ending:
            return None
        shape = [
            q.high if q.ends else value
            for q, value in zip(self.effect.shape, self.shape, strict=True)
        ]
        return replace(self.with_values(shape, self.amplitudes), plain=True)

    @property
    def _ending(self) -> list[Quantity]:
        """Numbers of its shape that have a last value."""
        return [q for q in self.effect.shape if q.ends]

    def term(self, signals: Signals) -> Term:
        """Return the total contribution of the effect."""
        if self.effect.along_motion is not None and not signals.around_rows:
            return self.effect.along_motion(signals, self.shape, self.amplitudes)
        terms = self.effect.build(signals, self.shape)
        return total([t.times(a) for t, a in zip(terms, self.amplitudes, strict=True)])

    def with_values(self, shape: Sequence[float], amplitudes: Sequence[float]) -> Placed:
        """Return a copy with other values."""
        return replace(
            self, shape=tuple(map(float, shape)), amplitudes=tuple(map(float, amplitudes))
        )


def in_words(where: Sequence[str]) -> str:
    """Return locations in words: 'coil 6'; more than two consecutive ones as 'coils 0 to 8'."""
    words: list[str] = []
    for _, row in groupby(enumerate(where), key=_in_row):
        names = [name.replace(":", " ") for _, name in row]
        kind, _, first = names[0].rpartition(" ")
        last = names[-1].rpartition(" ")[2]
        words += [f"{kind}s {first} to {last}"] if len(names) > 2 else names
    return ", ".join(words)


def _in_row(numbered: tuple[int, str]) -> tuple[str, int | str]:
    """Return a key that is equal for consecutive locations in a list."""
    at, name = numbered
    kind, _, number = name.partition(":")
    return (kind, int(number) - at) if number.isdecimal() else (kind, name)


def located(where: str, places: Places) -> str:
    """Return a location as this plant names it; older files have coil:N for any actuator."""
    number = where.removeprefix(_COIL)
    index = int(number) if where != number and number.isdecimal() else places.coils
    return places.actuator(index) if index < places.coils else where


def total(terms: Sequence[Term]) -> Term:
    """Return the sum of terms."""
    sums: list[Array | None] = [None, None, None, None]
    for term in terms:
        for i, part in enumerate(term.parts):
            if part is not None:
                before = sums[i]
                sums[i] = part if before is None else before + part
    return Term(*sums)


def resolved(effects: Sequence[Effect], fastest_hz: float) -> list[Effect]:
    """Return the effects with resonance frequencies bounded by `fastest_hz`; drop higher ones.

    A resonance above about half the sampling rate is aliased.
    """
    return [limited for effect in effects if (limited := _resolved(effect, fastest_hz)) is not None]


def _resolved(effect: Effect, fastest_hz: float) -> Effect | None:
    resonance = [q.unit == "Hz" and q.log and not q.corner for q in effect.shape]
    at = next((i for i, is_one in enumerate(resonance) if is_one), None)
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
    """Return a term of one sensor's reading error (N,)."""
    gap = np.zeros((signals.rows, signals.places.sensors))
    gap[:, sensor] = values
    return Term(gap=gap)
