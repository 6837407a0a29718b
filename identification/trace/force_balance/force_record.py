"""Prepare one record: the force that a model lacks in it, and the forces of effects.

The missing force is M q'' + D q' + K q - B u of signals below a frequency limit, less the forces of
the effects in the model. It needs neither the controller nor an initial state, so a record may come
from an unknown loop, and its plant may be unstable.

Where a DOF rests, its equation does not count: dry friction holds it with any force up to its
level, so that what is missing there tells nothing of any effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ....model.declared_model import DeclaredModel, Matrices
from ....model.effects.actuator_chain import beside, passed_on, reaching
from ....model.effects.base import Effect, Placed, Places, Signals, Term
from ....model.second_order import SecondOrder
from ...greybox.experiment.intersample_input import Hold
from ...greybox.force_balance.band_limited_signals import (
    BandLimited,
    moves,
    position_limit,
    quiet_velocity_limit,
)
from ...greybox.free_parameters import FreeParameters
from ..records.record_from_log import TraceRecord
from ..search_options import SearchOptions
from .rests import away_from_turns, moving_rows

Array = NDArray[np.float64]

GROUPS = ("inputs", "inertia", "all else")
"""Forces that a model consists of, as each may set the scale of its equations."""
_MATRICES = {"K": "q", "D": "qd", "M": "qdd"}
"""Matrices of the linear part, and what each multiplies."""
_OVERSAMPLED = float(SearchOptions.resolved)
"""Rows per period of the limit. At twice the limit the low-pass leaves 1/257."""
_BENT = {"sensor_gain", "sensor_nonlinearity", "sensor_crosstalk"}
"""Classes of the effects by which a reading is another function of the positions."""
_INERTIA = {"inertia", "linear_inertia"}
"""Classes of the effects whose force is in proportion to accelerations."""
_INPUT = {"input_lever"}
"""Those whose force is in proportion to commands."""
_RECENT = 2 * SearchOptions.steps
"""Signals that are kept for the next call: of a model with some effects, each at its shape, at the
shapes of its differences, and with other delays."""
Key = TypeVar("Key")
Value = TypeVar("Value")
Part = tuple[Array | None, Array | None, tuple[Array, Array, Array] | None]
"""Filtered force, commands, and reading error with two derivatives of one term."""


@dataclass(frozen=True)
class ForceModel:
    """A declared model, its free parameters, and the effects found so far."""

    model: DeclaredModel
    parameters: FreeParameters
    placed: tuple[Placed, ...] = ()

    @property
    def values(self) -> Array:
        """Values of the free parameters (F,) in SI units."""
        return np.array([self.model.values[name] for name in self.parameters.names])

    def with_values(self, values: Array) -> ForceModel:
        """Return the model with other values of its free parameters (F,)."""
        named = dict(zip(self.parameters.names, values.tolist(), strict=True))
        return replace(self, model=self.model.with_values(named))

    def rubbed(self, places: Places) -> list[tuple[Array, Array]]:
        """Return the motion (n,) of each law of friction, and its force on the DOF (n,)."""
        laws = (p.effect for p in self.placed if p.effect.effect_class == "friction")
        return [places.motion_at(place) for law in laws for place in law.where]

    def freed(self) -> ForceModel:
        """Return the model with no effect held to its textbook form."""
        return replace(self, placed=tuple(replace(p, plain=False) for p in self.placed))


@dataclass(frozen=True)
class ForceRecord:
    """One record below a limit. `rows` of it count; `kept` are the signals at these rows.

    moves (rows, n): whether a DOF moves, 1 or 0; where it rests, all forces are 0. noise_sd (n,):
    of the outputs.

    signals: below limits of their own, from which the forces of effects are computed: positions,
    and velocities with accelerations, up to where each of the two is worth its noise. A law is not
    linear: of signals below the limit of the balance it would be a force that nothing has. What it
    gives passes the low-pass of the balance as all other forces do. So it is with matrices that
    move with a schedule: times a signal they are not linear either.

    schedule: scheduling variables (N,) by name if they move. multiplied: the record below the limit
    of the signals that matrices are multiplied with, at all rows if a schedule moves.
    """

    name: str
    band: BandLimited
    signals: Signals
    kept: tuple[Array, ...]
    moves: Array
    decoupling: Array
    noise_sd: Array
    multiplied: BandLimited
    schedule: Mapping[str, Array]
    _matrices: list[tuple[DeclaredModel, SecondOrder, Matrices | None]] = field(
        default_factory=list, repr=False
    )
    _inputs: dict[tuple[float, float], Array] = field(default_factory=dict, repr=False)
    _parts: dict[tuple[object, ...], list[Part]] = field(default_factory=dict, repr=False)
    _recent: dict[tuple[object, ...], list[Part]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(
        cls, record: TraceRecord, hold: Hold, cutoff_hz: float, law_hz: float, sd: Array
    ) -> ForceRecord:
        """Return a record below `cutoff_hz`, and its signals for laws below `law_hz`.

        sd (n,): noise of the outputs.
        """
        e = record.experiment
        band = BandLimited.of(e, hold, cutoff_hz, _OVERSAMPLED)
        law = BandLimited.of(e, hold, law_hz, _OVERSAMPLED)
        q, qd, qdd = law.derivatives[:-1]
        # Positions are above their noise farther up than velocities are.
        position_hz = position_limit(e, sd)
        if np.isinf(position_hz):
            q = e.y
        elif position_hz > law_hz:
            q = BandLimited.of(e, hold, position_hz, _OVERSAMPLED).derivatives[0]
        every_row = replace(law, kept=slice(0, len(q), 1))
        none = np.zeros(len(q))
        signals = Signals(
            e.Ts_s, record.time_s, q, qd, qdd, record.coil, none, none, none, none, none, none,
            e.delay_cycles, record.places, around_rows=True,
        )  # fmt: skip
        # A rest is told by a velocity without much noise.
        rest_hz = min(max(cutoff_hz, quiet_velocity_limit(e, sd)), law_hz)
        quiet = law if rest_hz == law_hz else BandLimited.of(e, hold, rest_hz, _OVERSAMPLED)
        moving = moving_rows(quiet.derivatives[1], sd, e.Ts_s, rest_hz, 1.0 / cutoff_hz) & moves(e)
        return cls(
            record.name, band, signals, band.kept_derivatives(), moving[band.kept].astype(float),
            record.places.decoupling,
            sd, every_row if e.moving else band, e.schedule if e.moving else {},
        )  # fmt: skip

    def counted_from(self, row: int) -> ForceRecord:
        """Return the record with only the rows that count behind a row and an edge as at its begin.

        What comes before it sets the state of laws that have a memory.
        """
        old = self.band.kept
        band = replace(self.band, kept=slice(row + old.start, old.stop, old.step))
        moves = self.moves[-len(range(*band.kept.indices(len(self.signals.q)))) :]
        multiplied = self.multiplied if self.schedule else band
        kept = band.kept_derivatives()
        return replace(self, band=band, kept=kept, moves=moves, multiplied=multiplied, **_empty())

    def counted_at_rest(self, still: NDArray[np.bool_]) -> ForceRecord:
        """Return the record with the rows of some DOF (n,) counted, whether these rest or not."""
        return replace(self, moves=np.where(still, 1.0, self.moves))

    def between_turns(self, rubbed: Sequence[tuple[Array, Array]]) -> ForceRecord:
        """Return the record without the turns of some motions (n,), as if the DOF on which the
        force there acts (n,) rested."""
        speeds = self.signals.qd @ np.stack([motion for motion, _ in rubbed], axis=1)
        away = away_from_turns(speeds, self.band.Ts_s, 1.0 / self.band.cutoff_hz)[self.band.kept]
        moves = self.moves.copy()
        for one, (_, force) in zip(away.T, rubbed, strict=True):
            moves[~one] *= force == 0.0
        return replace(self, moves=moves)

    @property
    def rows(self) -> int:
        """Number of rows that count."""
        return len(self.kept[0])

    @property
    def time_s(self) -> Array:
        """Time of the rows that count (rows,), from the record's begin."""
        return np.asarray(np.arange(len(self.signals.q))[self.band.kept] * self.band.Ts_s)

    def input_force(self, model: DeclaredModel) -> Array:
        """Return the force of the input (rows, n)."""
        timing = self._timing(model)
        force = self._inputs.get(timing)
        if force is None:
            force = self.multiplied.input(*timing)
            _remember(self._inputs, timing, force)
        return self._products(model, B=force)

    def noise_density(self, point: ForceModel) -> tuple[Array, Array]:
        """Return frequencies in Hz (F,), and the power density (F, n) there of the missing force
        that the noise of the outputs alone gives, in the linear part of a model."""
        at, freq_hz = self._at(point.model)[0], self.band.freq_hz
        own = np.stack([getattr(at, name) for name in _MATRICES])
        K, D, M = own + sum(self._matrices_of(p, own) for p in point.placed)
        s = 2j * np.pi * freq_hz[:, None, None]
        density = 2.0 * self.band.Ts_s * np.abs(s**2 * M + s * D + K) ** 2 @ self.noise_sd**2
        return freq_hz, density * self.band.low_pass[:, None] ** 2

    def noise_force(self, point: ForceModel) -> Array:
        """Return the RMS (n,) of the missing force that the noise of the outputs gives, over all
        rows: where a DOF rests there is none."""
        freq_hz, density = self.noise_density(point)
        squares = np.trapezoid(density, freq_hz, axis=0) * self.moves.mean(axis=0)
        return np.asarray(np.sqrt(squares))

    def _matrices_of(self, placed: Placed, own: Array) -> Array:
        """Return what an effect adds to a model's own K, D and M (3, n, n): zero if not linear."""
        n = self.signals.q.shape[1]
        if not placed.effect.linear:
            return np.zeros((len(_MATRICES), n, n))
        found = []
        for moving in _MATRICES.values():
            force = placed.term(self._unit(moving)).force
            found.append(np.zeros((n, n)) if force is None else -force.T)
        errors = self._reading_errors(placed.effect, placed.shape)
        reads = (a * G for a, G in zip(placed.amplitudes, errors, strict=True) if G is not None)
        return np.array(found) - own @ sum(reads, start=np.zeros((n, n)))

    def _unit(self, moving: str) -> Signals:
        """Return signals of n rows, of each of which one DOF has a unit of q, qd or qdd."""
        n = self.signals.q.shape[1]
        q, qd, qdd = (np.eye(n) * (name == moving) for name in _MATRICES.values())
        no_coil = np.zeros((n, self.signals.coil.shape[1]))
        return replace(self.signals, time_s=np.zeros(n), coil=no_coil, q=q, qd=qd, qdd=qdd)

    def _reading_errors(self, effect: Effect, shape: tuple[float, ...]) -> list[Array | None]:
        """Return by how much positions are read too large per position (n, n), by each amplitude of
        a linear effect; None for those that act on no reading."""
        gaps = (t.gap for t in effect.build(self._unit("q"), shape))
        return [None if gap is None else (gap @ self.decoupling.T).T for gap in gaps]

    def missing_force(self, point: ForceModel) -> Array:
        """Return the force that the model with its effects lacks (rows, n)."""
        inputs, inertia, others = self.groups(point)
        return np.asarray(inertia + others - inputs)

    def effect_forces(self, point: ForceModel, effect: Effect, shape: tuple[float, ...]) -> Array:
        """Return the force of one unit of each amplitude of an effect (amplitudes, rows, n)."""
        changes = self.group_changes(point, effect, shape)
        return np.asarray(changes[:, 0] - changes[:, 1] - changes[:, 2])

    def groups(self, point: ForceModel) -> Array:
        """Return the force of the inputs, of inertia, and of all else (3, rows, n).

        Each includes the effects of its kind. The first less the others is what the model lacks.
        """
        return self.bare_and_whole(point)[1]

    def bare_and_whole(self, point: ForceModel) -> tuple[Array, Array]:
        """Return `groups` without the model's effects, and with them."""
        bare = whole = self._bare(point.model)
        for p in point.placed:
            more = self._changes(point, p.effect, p.shape)
            whole = whole + np.tensordot(np.array(p.amplitudes), more, 1)
        return bare, whole

    def _bare(self, model: DeclaredModel) -> Array:
        q, qd, qdd, _ = self.multiplied.kept_derivatives() if self.schedule else self.kept
        others = self._products(model, D=qd, K=q)
        if self.schedule:
            others = others - self.band.smoothed(model.moving_force(self.schedule))
        bare = np.stack([self.input_force(model), self._products(model, M=qdd), others])
        return np.asarray(bare * self.moves)

    def change(self, low: ForceModel, high: ForceModel) -> Array:
        """Return how `groups` change (3, rows, n) between two models with the same effects.

        An effect that is a force alone does not change unless delay or lag of the input do.
        """
        change = self._bare(high.model) - self._bare(low.model)
        later = self._timing(low.model) != self._timing(high.model)
        for p in low.placed:
            parts = self._parts_of(low, p.effect, p.shape, keep=False, passed=False)
            if later or any(held is not None or false is not None for _, held, false in parts):
                one, other = (self._changes(at, p.effect, p.shape) for at in (low, high))
                change = change + np.tensordot(np.array(p.amplitudes), other - one, 1)
        return np.asarray(change)

    def acting_force(self, point: ForceModel) -> Array:
        """Return the force of the inputs (rows, n) without its mean.

        Where an equation has no input, it is the force of inertia or of all else, the larger one.
        """
        groups = self.varying(self.groups(point))
        sizes = groups.std(axis=1)
        chosen = np.where(sizes[0] > 0.0, 0, np.argmax(sizes, axis=0))
        return np.stack([groups[k, :, i] for i, k in enumerate(chosen.tolist())], axis=1)

    def varying(self, values: Array) -> Array:
        """Return forces (..., rows, n) without the constant that fits them best where they move."""
        count = np.maximum(self.moves.sum(axis=0), 1.0)
        mean = np.sum(values * self.moves, axis=-2, keepdims=True) / count
        return np.asarray((values - mean) * self.moves)

    def group_changes(
        self, point: ForceModel, effect: Effect, shape: tuple[float, ...], keep: bool = False
    ) -> Array:
        """Return the change of `groups` by each amplitude (amplitudes, 3, rows, n).

        It is that beside the model's effects, behind those that a command passes later. keep:
        whether the filtered signals are kept for the next call.
        """
        return self._changes(point, effect, shape, keep, passed=True)

    def _changes(
        self,
        point: ForceModel,
        effect: Effect,
        shape: tuple[float, ...],
        keep: bool = False,
        passed: bool = False,
    ) -> Array:
        """Return what each amplitude adds to `groups` (amplitudes, 3, rows, n), or changes there.

        passed: whether with what the later parts of an actuator make of it.
        """
        model, kind = point.model, group_of(effect)
        parts = self._parts_of(point, effect, shape, keep, passed)
        changes = np.zeros((len(parts), len(GROUPS), *self.kept[0].shape))
        for i, (plain, held, false) in enumerate(parts):
            if held is not None:
                changes[i, 0] += self._products(model, B=held)
            if plain is not None:
                changes[i, kind] += plain if kind == 0 else -plain
            if false is not None:
                changes[i, 1] -= self._products(model, M=false[2])
                changes[i, 2] -= self._products(model, D=false[1], K=false[0])
        return np.asarray(changes * self.moves)

    def parts(
        self, point: ForceModel, effect: Effect, shape: tuple[float, ...], keep: bool = False
    ) -> list[Part]:
        """Return the filtered signals of each amplitude that `group_changes` consists of.

        Signals that are kept are the same list as before.
        """
        return self._parts_of(point, effect, shape, keep, passed=True)

    def force_of_command(self, model: DeclaredModel, held: Array) -> Array:
        """Return the force (rows, n) of additions to the inputs (N, p)."""
        return self._products(model, B=self.multiplied.input(*self._timing(model), held))

    def _products(self, model: DeclaredModel, **signals: Array) -> Array:
        """Return the sum (rows, n) of matrices times signals of `multiplied`, by the matrix."""
        mean, along = self._at(model)
        if along is None:
            return np.asarray(sum(x @ getattr(mean, name).T for name, x in signals.items()))
        products = (np.einsum("nij,nj->ni", getattr(along, name), x) for name, x in signals.items())
        return self.band.smoothed(np.asarray(sum(products)))

    def _at(self, model: DeclaredModel) -> tuple[SecondOrder, Matrices | None]:
        """Return the matrices of a model at the mean schedule, and along one that moves."""
        if not self._matrices or self._matrices[0][0] is not model:
            mean = model.at(self.band.schedule)
            along = model.over(self.schedule) if self.schedule else None
            self._matrices[:] = [(model, mean, along)]
        return self._matrices[0][1:]

    def _timing(self, model: DeclaredModel) -> tuple[float, float]:
        """Return delay and lag of the input in s; with the log's own, the delay is not negative."""
        at = self._at(model)[0]
        return max(at.delay_s, -self.band.own_delay_s), max(at.lag_s, 0.0)

    def _parts_of(
        self,
        point: ForceModel,
        effect: Effect,
        shape: tuple[float, ...],
        keep: bool,
        passed: bool,
    ) -> list[Part]:
        delay_s, lag_s = self._timing(point.model)
        chain = beside(effect, point.placed)
        if all(p.effect.identity == effect.identity for p in chain):
            chain = ()
        bending = self._bending(point, effect)
        numbers = tuple((p.effect.identity, p.shape, p.amplitudes) for p in (*chain, *bending))
        timing = (delay_s, lag_s)
        key = (timing, effect.identity, shape, passed and bool(chain), numbers)
        parts = self._parts.get(key) or self._recent.get(key)
        if parts is None:
            late = max(round((delay_s + self.band.own_delay_s) / self.band.Ts_s), 0)
            signals = replace(self._at_positions(bending), delay_cycles=late, lag_s=lag_s)
            terms = effect.build(reaching(effect, chain, signals), shape)
            if passed:
                terms = passed_on(effect, terms, chain, signals)
            parts = [self._part(t, delay_s, lag_s) for t in terms]
            if effect.linear and not self.schedule:
                once = self._once(signals, effect, shape)
                parts = [(force, p[1], gap) for (force, gap), p in zip(once, parts, strict=True)]
            if keep and not chain and not bending:
                # Signals of another delay or lag are of no use any more.
                if self._parts and next(iter(self._parts))[0] != timing:
                    self._parts.clear()
                self._parts[key] = parts
            else:
                _remember(self._recent, key, parts)
        return parts

    def _bending(self, point: ForceModel, effect: Effect) -> tuple[Placed, ...]:
        """Return the effects that bend a model's readings, if another effect acts at the positions.

        A linear effect acts as the matrices do, at what is read. A reading that is only late is
        taken as it is: the speed of its position needs the acceleration, and the noise of that
        moves the reversals of a friction.
        """
        if effect.linear or effect.effect_class in _BENT:
            return ()
        return tuple(p for p in point.placed if p.effect.effect_class in _BENT)

    def _at_positions(self, bending: tuple[Placed, ...]) -> Signals:
        """Return the signals of the positions (N, n), from readings that these effects bend."""
        if not bending:
            return self.signals
        q, qd, qdd = self.signals.q, self.signals.qd, self.signals.qdd
        for p in bending:
            gap = p.term(self.signals).gap
            if gap is not None:
                false = gap @ self.decoupling.T
                rate = np.gradient(false, self.signals.Ts_s, axis=0)
                q, qd = q - false, qd - rate
                qdd = qdd - np.gradient(rate, self.signals.Ts_s, axis=0)
        return replace(self.signals, q=q, qd=qd, qdd=qdd)

    def _once(
        self, signals: Signals, effect: Effect, shape: tuple[float, ...]
    ) -> list[tuple[Array, tuple[Array, Array, Array] | None]]:
        """Return the forces (rows, n) of a linear effect after the low-pass of the balance, once,
        and its errors of the positions with two derivatives, each (rows, n), None without.

        They are those of the motion below the limit, as of the model's own terms. Twice filtered,
        such a force beside a parameter of the same signal would be another filter.
        """
        q, qd, qdd, _ = self.band.derivatives
        none, no_coil = np.zeros_like(q), np.zeros_like(signals.coil)
        of_motion = effect.build(replace(signals, q=q, qd=qd, qdd=qdd, coil=no_coil), shape)
        of_coil = effect.build(replace(signals, q=none, qd=none, qdd=none), shape)
        errors = self._reading_errors(effect, shape)
        found = []
        for moved, driven, G in zip(of_motion, of_coil, errors, strict=True):
            force = np.zeros_like(self.kept[0])
            if moved.force is not None:
                force = force + moved.force[self.band.kept]
            if driven.force is not None and np.any(driven.force):
                force = force + self.band.smoothed(driven.force)
            rows = self.band.kept
            gap = None if G is None else (q[rows] @ G.T, qd[rows] @ G.T, qdd[rows] @ G.T)
            found.append((force, gap))
        return found

    def _part(self, term: Term, delay_s: float, lag_s: float) -> Part:
        band, many = self.band, self.multiplied
        return (
            None if term.force is None else band.smoothed(term.force),
            None if term.held is None else many.input(delay_s, lag_s, term.held),
            None if term.gap is None else many.smoothed_derivatives(term.gap @ self.decoupling.T),
        )


def force_records(
    records: Sequence[TraceRecord],
    hold: Hold,
    cutoff_hz: float,
    law_hz: Sequence[float],
    sd: Array,
) -> tuple[ForceRecord, ...]:
    """Return records below `cutoff_hz`, the signals for laws of each below its own `law_hz`."""
    return tuple(
        ForceRecord.of(r, hold, cutoff_hz, max(cutoff_hz, own_hz), sd)
        for r, own_hz in zip(records, law_hz, strict=True)
    )


def group_of(effect: Effect) -> int:
    """Return the index in `groups` of the force of an effect, if it acts by a force alone."""
    if effect.effect_class in _INPUT:
        return 0
    return 1 if effect.effect_class in _INERTIA else 2


def _empty() -> dict[str, Any]:
    """Return the fields that keep what was computed, empty."""
    return {"_matrices": [], "_inputs": {}, "_parts": {}, "_recent": {}}


def _remember(known: dict[Key, Value], key: Key, value: Value) -> None:
    """Keep a value, and forget the oldest one beyond what one set of derivatives needs."""
    known[key] = value
    if len(known) > _RECENT:
        del known[next(iter(known))]
