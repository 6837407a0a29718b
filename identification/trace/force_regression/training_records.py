"""The missing force of the training records, weighed by frequency, and how numbers change it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ....model.declared_model import ModelError
from ....model.effects.base import Effect, Placed
from ...rounding import DIFFERENCE, ROUNDING, TINY
from ..force_balance.force_record import GROUPS, ForceModel, ForceRecord, Part, group_of
from ..force_balance.free_numbers import Shape, numbers_of, shapes_beside
from ..search_options import SearchOptions
from .held_out_gain import Blocks, Columns
from .residual_whitening import Whitening

Array = NDArray[np.float64]

_POINTS = 2
"""Points of which the forces are kept."""


@dataclass(frozen=True)
class Evaluated:
    """A model at its present numbers.

    missing: weighed missing force of each record (rows, n), times `share`. groups: weighed forces
    of inputs, inertia and all else (3, rows, n); bare: the same without effects; setting: what of
    them sets the scale. power (n,): sum of squares of the latter. share (n,): root of the power
    without effects over that with them, at least 1; relative to Training.reference where that is
    given.
    """

    point: ForceModel
    missing: list[Array]
    groups: list[Array]
    bare: list[Array]
    setting: list[Array]
    power: Array
    share: Array

    @property
    def squares(self) -> Array:
        """Sum of squares of the missing force of each DOF (n,)."""
        return np.asarray(np.sum([np.sum(m * m, axis=0) for m in self.missing], axis=0))


@dataclass(frozen=True)
class _ForcesOfEffect:
    """Signals of an effect that is a force alone, of each record, and its weighed forces
    (amplitudes, rows, n), which no number of the model changes."""

    parts: list[list[Part]]
    forces: list[Array]


@dataclass(frozen=True)
class Training:
    """The training records with their weights and blocks; columns are free of each record's mean.

    A constant force of each record is unknown, so it is free in every fit. An equation of motion
    holds times any factor, and some declared number sets its scale. An effect that cancels what
    sets the scale would lower the error by lowering all forces: so errors count more where effects
    lower the force that sets the scale. If all terms of an equation are free, and only parameters
    that it shares with another one tie its scale, errors count relative to its inputs' force, and
    without an input to its largest force.

    scale (3, n): whether the force of inputs, of inertia or of all else sets it, 1 or 0. Of such a
    force it is the part that no parameter changes, as that of the one of two actuators that has
    a known gain. unset (n,): equations without such a part. scaled_at: the model that told so.
    reference (n,): power of that force at the begin, nan where a declared number sets the scale.
    all_free (n,): equations of which every term is free, so that a free form explains them whatever
    they are; an input with a declared gain is a term that is not.
    """

    records: tuple[ForceRecord, ...]
    whitening: Whitening
    blocks: Blocks
    scale: Array
    reference: Array
    all_free: NDArray[np.bool_]
    unset: NDArray[np.bool_]
    scaled_at: ForceModel | None = None
    _forces_kept: dict[tuple[str, Shape], _ForcesOfEffect] = field(
        init=False, repr=False, default_factory=dict
    )
    _evaluated: list[Evaluated] = field(init=False, repr=False, default_factory=list)
    """The last ones: a step begins where the cost was asked, and two ends of fits are compared."""

    @classmethod
    def unscaled(
        cls, records: tuple[ForceRecord, ...], whitening: Whitening, blocks: Blocks
    ) -> Training:
        """Return training records before `scale_of_equations.with_scale` has found what sets it."""
        n = records[0].kept[0].shape[1]
        none = np.full(n, np.nan), np.zeros(n, bool), np.ones(n, bool)
        return cls(records, whitening, blocks, np.zeros((len(GROUPS), n)), *none)

    def at(self, point: ForceModel) -> Evaluated:
        """Return the missing force of a model, and the forces that it consists of."""
        known = next((e for e in self._evaluated if e.point is point), None)
        if known is None:
            known = self._at(point)
            self._evaluated[:] = [known, *self._evaluated[: _POINTS - 1]]
        return known

    def _at(self, point: ForceModel) -> Evaluated:
        bare, groups = self._bare_and_whole(point)
        setting = self._setting(bare, groups)
        power = self._power(setting)
        share = np.ones(len(power))
        if point.placed:
            plain = self._power(self._setting(bare, bare))
            ratio = np.divide(plain, power, out=np.ones(len(power)), where=power > 0.0)
            share = np.sqrt(np.maximum(ratio, 1.0))
        free = np.isfinite(self.reference) & (power > 0.0)
        share[free] = np.sqrt(self.reference[free] / power[free])
        missing = [share * (g[1] + g[2] - g[0]) for g in groups]
        return Evaluated(point, missing, groups, bare, setting, power, share)

    def _bare_and_whole(self, point: ForceModel) -> tuple[list[Array], list[Array]]:
        both = self._weighed(np.stack(r.bare_and_whole(point)) for r in self.records)
        return [b for b, _ in both], [g for _, g in both]

    def _setting(self, bare: list[Array], groups: list[Array]) -> list[Array]:
        """Return what sets the scale of each equation, of each record (3, rows, n).

        It is what effects make of the part that no parameter changes. Where there is none, it is
        all.
        """
        if self.scaled_at is None or self.unset.all():
            return groups
        return [
            np.where(self.unset, g, fixed + (g - b))
            for fixed, b, g in zip(self.fixed, bare, groups, strict=True)
        ]

    @cached_property
    def fixed(self) -> list[Array]:
        """What no parameter changes of the groups without effects, of each record (3, rows, n).

        Forces are linear in the parameters, but for those of the timing, which stay.
        """
        assert self.scaled_at is not None
        point = replace(self.scaled_at, placed=())
        timing = point.model.lag.names | point.model.delay.names
        parts = point.values / point.parameters.scale
        parts[[name in timing for name in point.parameters.names]] = 0.0
        bare, _ = self._bare_and_whole(point)
        changes = self._parameter_changes(point)
        return [b - np.tensordot(parts, c, 1) for b, c in zip(bare, changes, strict=True)]

    def forces(
        self, at: Evaluated, effect: Effect, shape: Shape, keep: bool = False
    ) -> tuple[list[Array], Array]:
        """Return the weighed forces of an effect's amplitudes, and how they change the power.

        forces: of each record (amplitudes, rows, n). pull (amplitudes, n): relative change of the
        root of the power by each. keep: whether filtered signals are kept for the next call.
        """
        if not keep:
            return self._forces_of(at, self.group_changes(at.point, effect, shape))
        parts = [r.parts(at.point, effect, shape, keep) for r in self.records]
        known = self._forces_kept.get((effect.identity, shape))
        if known is None or any(a is not b for a, b in zip(known.parts, parts, strict=True)):
            changes = self._weighed(
                r.group_changes(at.point, effect, shape, keep) for r in self.records
            )
            own_parts = [part for of_record in parts for part in of_record]
            of_input = group_of(effect) == 0
            if of_input or any(
                held is not None or false is not None for _, held, false in own_parts
            ):
                return self._forces_of(at, changes)
            known = _ForcesOfEffect(parts, [-c[:, group_of(effect)] for c in changes])
            self._forces_kept[effect.identity, shape] = known
        scale = self.scale[group_of(effect)]
        along = sum(
            _along(f, g[group_of(effect)] * scale)
            for f, g in zip(known.forces, at.setting, strict=True)
        )
        return [at.share * f for f in known.forces], -along / np.maximum(at.power, TINY)

    def _forces_of(self, at: Evaluated, changes: Sequence[Array]) -> tuple[list[Array], Array]:
        n = len(at.power)
        weights = [(g * self.scale[:, None]).reshape(-1, n) for g in at.setting]
        forces = [at.share * (c[:, 0] - c[:, 1] - c[:, 2]) for c in changes]
        along = sum(
            _along(c.reshape(len(c), len(w), n), w) for c, w in zip(changes, weights, strict=True)
        )
        return forces, along / np.maximum(at.power, TINY)

    def effect_changes(self, at: Evaluated, placed: Placed) -> list[Array]:
        """Return the changes of the groups by an effect's free numbers (c, 3, rows, n)."""
        point, a, changes = at.point, np.array(placed.amplitudes), []
        free = placed.freedom.T
        for r in self.records:
            own = [r.group_changes(point, placed.effect, placed.shape)]
            for i, q in enumerate(placed.effect.shape):
                low, high, width = shapes_beside(q, placed.shape, i)
                lower, upper = (r.group_changes(point, placed.effect, s) for s in (low, high))
                own.append(np.tensordot(a, (upper - lower) / width, 1)[None])
            changes.append(np.tensordot(free, np.concatenate(own), 1))
        return self._weighed(changes)

    def effect_columns(
        self, at: Evaluated, changes: Sequence[Array], shrinks: bool = False
    ) -> list[Array]:
        """Return the columns of an effect's free numbers, each record (c, rows, n).

        changes: those of `effect_changes`. Columns are changes of its force. If it `shrinks`, they
        are those of the error where the model's effects lower the force that sets the scale. These
        hold for short ways only: far along them, two numbers of one force would cancel all error.
        """
        forces, pull = self._forces_of(at, changes)
        counts = np.isfinite(self.reference) | (shrinks & (at.share > 1.0))
        pull = np.where(counts, pull, 0.0)
        return [f + pull[:, None, :] * m for f, m in zip(forces, at.missing, strict=True)]

    def group_changes(self, point: ForceModel, effect: Effect, shape: Shape) -> list[Array]:
        """Return the changes of the groups by each amplitude of an effect (amplitudes, 3, rows, n)
        beside a model, each record."""
        return self._weighed(r.group_changes(point, effect, shape) for r in self.records)

    def group_columns(self, at: Evaluated) -> list[Array]:
        """Return the changes of the groups by all free numbers, in order (C, 3, rows, n)."""
        parts = [self.effect_changes(at, p) for p in at.point.placed]
        own = self.parameter_changes(at)
        return [np.concatenate([c, *(p[k] for p in parts)]) for k, c in enumerate(own)]

    def columns(self, at: Evaluated, groups: Sequence[Array], shrinks: bool = False) -> list[Array]:
        """Return the columns of all free numbers, each record (F + effects', rows, n).

        Parameters count in their scale. groups: those of `group_columns`. shrinks: as above.
        """
        begin = len(at.point.values)
        own, pull = self._forces_of(at, [g[:begin] for g in groups])
        pull = np.where(np.isfinite(self.reference), pull, 0.0)
        parts = [[f + pull[:, None, :] * m for f, m in zip(own, at.missing, strict=True)]]
        for p in at.point.placed:
            mine = slice(begin, begin + numbers_of(p))
            parts.append(self.effect_columns(at, [g[mine] for g in groups], shrinks))
            begin = mine.stop
        return [np.concatenate(of_record) for of_record in zip(*parts, strict=True)]

    def columns_at(self, point: ForceModel) -> list[Array]:
        """Return `columns` at the numbers of a model."""
        at = self.at(point)
        return self.columns(at, self.group_columns(at), shrinks=True)

    def noise(self, point: ForceModel) -> Array:
        """Return the squared missing force (n,) that the noise of the outputs alone gives.

        The force is weighed, but not times `share`.
        """
        power = np.zeros(len(self.all_free))
        for r in self.records:
            freq_hz, density = r.noise_density(point)
            weighed = density * self.whitening.squared_at(freq_hz)
            power += 2.0 * r.rows * r.band.row_s * np.trapezoid(weighed, freq_hz, axis=0)
        return power

    @cached_property
    def plain(self) -> Training:
        """The same records without weights."""
        n, limit_hz = self.records[0].kept[0].shape[1], self.whitening.cutoff_hz
        flat = Whitening(np.array([0.0, limit_hz]), np.ones((2, n)), limit_hz)
        return replace(self, whitening=flat, reference=np.full(n, np.nan))

    def parameter_changes(self, at: Evaluated) -> list[Array]:
        """Return the changes of the groups by each free parameter in its scale (F, 3, rows, n)."""
        return self._parameter_changes(at.point)

    def _parameter_changes(self, point: ForceModel) -> list[Array]:
        steps = DIFFERENCE * np.diag(point.parameters.scale)
        pairs = [
            (point.with_values(point.values - step), point.with_values(point.values + step))
            for step in steps
        ]
        found = []
        for r in self.records:
            changes = np.zeros((len(pairs), len(GROUPS), *r.kept[0].shape))
            for i, (low, high) in enumerate(pairs):
                changes[i] = r.change(low, high) / (2 * DIFFERENCE)
            found.append(changes)
        return self._weighed(found)

    def prior(self, point: ForceModel) -> Array:
        """Return the Gram matrix of the parameters' priors, for [columns, missing]."""
        rows = point.parameters.prior_rows(point.values)
        count = len(point.values) + sum(numbers_of(p) for p in point.placed)
        whole = np.zeros((len(rows), count + 1))
        whole[:, : len(point.values)] = rows[:, :-1]
        whole[:, -1] = -rows[:, -1]
        return np.asarray(whole.T @ whole)

    def judged(
        self, at: Evaluated, columns: Sequence[Array], groups: Sequence[Array], more: int = 0
    ) -> Columns:
        """Return the Gram matrices of a model by its columns and group columns.

        more: columns, the last ones, of an effect that the model does not have yet.
        """
        prior = self.prior(at.point)
        base = len(prior) - 1
        wide = np.zeros((base + more + 1, base + more + 1))
        pick = [*range(base), base + more]
        wide[np.ix_(pick, pick)] = prior
        power = np.zeros((len(at.power), len(wide), len(wide)))
        parameters = len(at.point.values)
        for changes, now in zip(groups, at.setting, strict=True):
            whole = np.concatenate([changes, now[None]]) * self.scale[:, None]
            whole[:parameters] *= self.unset
            whole = np.moveaxis(whole, -1, 0).reshape(len(at.power), len(wide), -1)
            power += whole @ np.swapaxes(whole, 1, 2)
        return Columns(self.blocks.grams(columns, at.missing), power, wide)

    def counts(self, at: Evaluated, amplitudes: Array, pull: Array) -> NDArray[np.bool_]:
        """Return whether an effect's change of the power counts for each DOF (n,)."""
        shrinks = (at.share > 1.0) | (amplitudes @ pull < 0.0)
        return np.asarray(shrinks | np.isfinite(self.reference))

    def _power(self, groups: Sequence[Array]) -> Array:
        """Return the sum of squares (n,) of the forces that set the scale."""
        return np.asarray(
            np.sum([np.sum(g * g * self.scale[:, None], axis=(0, 1)) for g in groups], axis=0)
        )

    @property
    def independent(self) -> float:
        """Number of independent values of the missing force, by time and limit of the band."""
        rows = sum(2.0 * r.rows * r.band.row_s for r in self.records)
        return float(rows * self.whitening.cutoff_hz * self.records[0].kept[0].shape[1])

    @property
    def expected(self) -> float:
        """Sum of squares of a model that leaves what the weights are made of: the number of
        independent values; nan for weights that are flat, and of no unit."""
        return float("nan") if self.whitening.flat else self.independent

    def weighs_what_is_left(self, point: ForceModel, options: SearchOptions) -> bool:
        """Return whether the weights of each DOF follow what a model leaves of it.

        They do not if they are flat, or if most of what they were made of has been explained since:
        what that hid hardly counts with them.
        """
        if self.whitening.flat:
            return False
        squares = self.at(point).squares
        return bool(np.all(squares * len(squares) * options.much_left**2 > self.expected))

    def cost(self, point: ForceModel) -> float:
        """Return the sum of squares of the missing force, and of the parameters' priors.

        It is infinite for parameters whose mass matrix has no inverse: a bound may be 0 kg. So it
        is where effects leave nothing of what sets the scale of an equation, as a dead zone that is
        wider than all commands does: then nothing is missing with all parameters at zero.
        """
        rows = point.parameters.prior_rows(point.values)
        try:
            at = self.at(point)
        except ModelError:
            return float("inf")
        if point.placed and np.any(
            at.power < ROUNDING**2 * self._power(self._setting(at.bare, at.bare))
        ):
            return float("inf")
        squares = float(at.squares.sum())
        return squares + float(np.sum(rows[:, -1] ** 2))

    def _weighed(self, values: Iterable[Array]) -> list[Array]:
        """Return forces of each record (..., rows, n) with weights, free of what is constant.

        Most effects change one of the groups only, so most of the columns are zero.
        """
        found = []
        for record, own, constant in zip(self.records, values, self._constants, strict=True):
            columns = own.reshape(-1, *own.shape[-2:])
            acts = columns.any(axis=(1, 2))
            white = self.whitening.apply(columns[acts], record.band.row_s)
            share = _along(white, constant)[:, None]
            weighed = np.zeros_like(columns)
            weighed[acts] = white - share * constant
            found.append(weighed.reshape(own.shape))
        return found

    @cached_property
    def _constants(self) -> list[Array]:
        """A constant force where DOF move, with weights, of unit size, of each record (rows, n)."""
        weighed = [self.whitening.apply(r.moves, r.band.row_s) for r in self.records]
        return [w / np.maximum(np.linalg.norm(w, axis=0), TINY) for w in weighed]


def _along(values: Array, one: Array) -> Array:
    """Return the products (c, n) of columns (c, rows, n) with another one (rows, n), over rows."""
    products = np.moveaxis(values, -1, 0) @ one.T[:, :, None]
    return np.asarray(products[:, :, 0].T)


def missing_share(at: Evaluated) -> Array:
    """Return the missing force over the acting force (n,)."""
    return np.asarray(np.sqrt(at.squares) / at.share / np.maximum(acting_force(at), TINY))


def acting_force(at: Evaluated) -> Array:
    """Return the size (n,) of the inputs' force, of the largest other force where there is none."""
    sizes = np.sum([np.sum(g * g, axis=1) for g in at.groups], axis=0)
    return np.asarray(np.sqrt(np.where(sizes[0] > 0.0, sizes[0], sizes.max(axis=0))))
