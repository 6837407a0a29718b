"""Filter many candidate columns at once through a record's innovations filter.

The prediction errors are linear in forces and in sensor errors: the column of a unit effect is the
filter's response to it. Many candidates are filtered in one pass.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ....model.declared_model import DeclaredModel
from ....model.effects.base import Term
from ...greybox.experiment.intersample_input import (
    Hold,
    held_step,
    lagged_input,
    moments,
    shifted,
)
from ...greybox.prediction.discretisation import Motion
from ...greybox.prediction.noise_model import Filter
from ...rounding import TINY
from ..records.record_from_log import TraceRecord
from ..search_options import SearchOptions
from .intersample_moments import around, force_moments, nonzero_columns, polynomial_weights

Array = NDArray[np.float64]

_BATCH = SearchOptions.at_a_time // SearchOptions.resolved**2
"""Columns filtered at once, limited by the processor's cache."""
_TINY_ROWS = SearchOptions.at_a_time
"""Rows after which states below TINY are set to zero: processors are slow with denormal numbers."""


@dataclass(frozen=True)
class FilterBank:
    """A record's innovations filter, prepared for many columns.

    Phi (R, 2n, 2n), correction (R, 2n, n), `whitener` (R, n, n). `smooth` (6, 2n, n): change of the
    state by a generalised force at the rows around a period; `powers` (J, 2n, n): by its moments;
    `relative` (R, n, n): mobility over its mean. Errors have unit variance; `every` rows are summed
    over the root of `every`, which keeps it.
    """

    Phi: Array
    correction: Array
    whitener: Array
    smooth: Array
    powers: Array
    relative: Array
    motion: Motion
    model: DeclaredModel
    record: TraceRecord
    hold: Hold
    every: int
    blind: int

    @classmethod
    def build(
        cls,
        model: DeclaredModel,
        record: TraceRecord,
        at: Motion,
        kalman: Filter,
        hold: Hold,
        every: int,
    ) -> FilterBank:
        """Return the bank of a record along its motion, with the filter `kalman`."""
        n = at.K.shape[1]
        Phi = transitions(at)
        correction = Phi @ kalman.gain
        mean = at.mobility.mean(axis=0)
        relative = at.mobility @ np.linalg.inv(mean)
        powers = _powers(at, mean)
        weights = polynomial_weights(at.Ts_s, len(powers))
        smooth = np.einsum("js,jip->sip", weights, powers)
        whitener = np.linalg.inv(np.linalg.cholesky(kalman.covariance))
        if len(whitener) == 1 and len(Phi) > 1:
            whitener = np.broadcast_to(whitener, (len(Phi), n, n))
        return cls(
            np.ascontiguousarray(Phi), np.ascontiguousarray(correction), whitener, smooth, powers,
            relative, at, model, record, hold, every, at.blind,
        )  # fmt: skip

    def columns(self, terms: Iterable[Term], count: int, out: Array | None = None) -> Array:
        """Return the errors (N // every, n, count) of one unit of each of `count` terms.

        Terms are consumed one by one. `out`: array for the result.
        """
        n, rows = self.motion.K.shape[1], self.record.rows
        out = np.empty((rows // self.every, n, count)) if out is None else out
        most = min(_BATCH, count)
        forcing, seen = np.empty((most, rows, 2 * n)), np.empty((most, rows, n))
        batch: list[int] = []
        false = False

        def flush() -> None:
            k, first = len(batch), batch[0]
            side_by_side = batch[-1] - first == k - 1  # mostly, and then it is quicker
            there = slice(first, first + k) if side_by_side else batch
            out[:, :, there] = self.errors(forcing[:k], seen[:k] if false else None)

        for j, term in enumerate(terms):
            held, force, gap = (_nonzero(part) for part in (term.held, term.force, term.gap))
            if held is None and force is None and gap is None:
                out[:, :, j] = 0.0
                continue
            k = len(batch)
            self._drive(held, force, forcing[k])
            # Sensor errors are subtracted from the measured readings.
            if gap is not None:
                if not false:
                    seen[:k] = 0.0
                seen[k] = -(gap @ self.record.places.decoupling.T)
                false = True
            elif false:
                seen[k] = 0.0
            batch.append(j)
            if len(batch) == most:
                flush()
                batch, false = [], False
        if batch:
            flush()
        return out

    def _drive(self, held: Array | None, force: Array | None, forcing: Array) -> None:
        """Fill `forcing` (N, 2n) with the effect of commands (N, p) and forces (N, n)."""
        if held is not None:
            forcing[:] = self.held_forcing(held)
            if force is not None:
                forcing += self.force_forcing(force)
        elif force is not None:
            forcing[:] = self.force_forcing(force)
        else:
            forcing[:] = 0.0

    def errors(
        self, forcing: Array, seen: Array | None = None, start: Array | None = None
    ) -> Array:
        """Return whitened errors (N // every, n, c) of forcing (c, N, 2n) and readings (c, N, n).

        Default readings and state at row 0, `start` (2n, c), are zero.
        """
        columns, rows, size = forcing.shape
        x = np.zeros((size, columns)) if start is None else np.array(start, float)
        out = np.zeros((rows // self.every, size // 2, columns))
        _compiled_for(size)(
            self.Phi, self.correction, self.whitener, np.ascontiguousarray(forcing),
            np.zeros((0, rows, size // 2)) if seen is None else np.ascontiguousarray(seen),
            x, self.blind, self.every, out,
        )  # fmt: skip
        return out

    def constants(self) -> Array:
        """Return the columns (N // every, n, n) of a constant force on each DOF."""
        n, rows = self.motion.K.shape[1], self.record.rows
        constant = [Term(force=np.broadcast_to(np.eye(n)[i], (rows, n))) for i in range(n)]
        return self.columns(constant, n)

    def held_forcing(
        self,
        held: Array,
        extra_lag_s: float = 0.0,
        extra_s: float = 0.0,
        by: Array | None = None,
    ) -> Array:
        """Return the change of the state (N, 2n) by commands (N, p) in each period.

        `by` (N or 1, n, p): replaces the model's B. Along a schedule each period has its own
        mobility, but within a period the stiffness and damping of the first one are used: at 1 kHz
        an error below 0.1 % in the columns of lag and delay.
        """
        e, values = self.record.experiment, {**self.model.values, **self.model.scheduling}
        delay_s = max(e.delay_cycles * e.Ts_s + self.model.delay(values) + extra_s, 0.0)
        lag_s = max(self.model.lag(values) + extra_lag_s, 0.0)
        acting = nonzero_columns(held)
        held = held[:, acting]
        powers = self._input_powers[:, :, acting] if by is None else self.powers
        order = len(powers)
        if by is not None:
            by = by[:, :, acting]

        def pushed(commands: Array) -> Array:
            return commands if by is None else np.einsum("...ip,...p->...i", by, commands)

        if self.hold == "zoh":
            step = held_step(e.Ts_s, order, delay_s, lag_s)
            old, new = shifted(held, step.whole + 1), shifted(held, step.whole)
            G_old, G_new, G_lag = (
                np.tensordot(weights, powers, 1)
                for weights in (step.from_old, step.from_new, step.from_lag)
            )
            forcing = pushed(old) @ G_old.T + pushed(new) @ G_new.T
            forcing = forcing + pushed(lagged_input(held, step)) @ G_lag.T
        else:
            m = moments(held, e.Ts_s, order, self.hold, delay_s, lag_s)
            if by is not None:
                m = np.einsum("nip,njp->nji", np.broadcast_to(by, (len(m), *by.shape[1:])), m)
            forcing = np.einsum("njp,jip->ni", m, powers, optimize=True)
        return self._along(forcing)

    @cached_property
    def _input_powers(self) -> Array:
        """A^j B (J, 2n, p): change of the state by the moments of a command."""
        A, _ = self.motion.continuous()
        powers = [np.vstack([np.zeros_like(self.motion.B[0]), self.motion.B.mean(axis=0)])]
        for _ in range(len(self.motion.scale) - 2):
            powers.append(A @ powers[-1])
        return np.array(powers)

    def force_forcing(self, force: Array) -> Array:
        """Return the change of the state (N, 2n) by generalised forces (N, n) in each period."""
        acting = nonzero_columns(force)
        force = force[:, acting]
        if self.hold == "band_limited":
            order = len(self.motion.scale) - 1
            m = force_moments(force, self.motion.Ts_s, order, self.hold)
            powers = self.powers[:, :, acting]
            return self._along(np.einsum("njp,jip->ni", m, powers, optimize=True))
        taps = self.smooth[:, :, acting].swapaxes(1, 2).reshape(-1, self.smooth.shape[1])
        return self._along(around(force) @ taps)

    def _along(self, forcing: Array) -> Array:
        """Return the forcing with each period's own mobility."""
        if len(self.relative) == 1:
            return forcing
        n = self.relative.shape[1]
        turned = np.empty_like(forcing)
        for part in (slice(0, n), slice(n, 2 * n)):
            turned[:, part] = np.einsum("nij,nj->ni", self.relative, forcing[:, part])
        return turned


def thinned(errors: Array, every: int) -> Array:
    """Sum `every` rows over its root, which keeps the unit variance of white errors."""
    if every == 1:
        return errors
    rows = len(errors) // every * every
    # Slice by slice: numpy's sum over a short axis takes ten times as long.
    total = errors[0:rows:every] + errors[1:rows:every]
    for k in range(2, every):
        total += errors[k:rows:every]
    return np.asarray(total / np.sqrt(every))


def transitions(at: Motion) -> Array:
    """Return the transition matrices (R, 2n, 2n) by the motion's Taylor series."""
    n, R = at.K.shape[1], len(at.K)
    A = np.zeros((R, 2 * n, 2 * n))
    A[:, :n, n:] = np.eye(n)
    A[:, n:, :n], A[:, n:, n:] = -at.K, -at.D
    Phi = np.broadcast_to(np.eye(2 * n), A.shape) * at.scale[-1]
    for scale in at.scale[-2::-1]:
        Phi = A @ Phi + scale * np.eye(2 * n)
    return np.asarray(Phi)


def _powers(at: Motion, mobility: Array) -> Array:
    """Return A^j [0, mobility] (J, 2n, n): change of the state by the moments of a force."""
    n = at.K.shape[1]
    A, _ = at.continuous()
    powers = [np.vstack([np.zeros((n, n)), mobility])]
    for _ in range(len(at.scale) - 2):
        powers.append(A @ powers[-1])
    return np.array(powers)


def _nonzero(values: Array | None) -> Array | None:
    return values if values is not None and values.any() else None


@cache
def _compiled_for(size: int):  # type: ignore[no-untyped-def]
    """Return the filter of models with a state of `size` numbers.

    As the size is a constant, the compiler keeps sums in registers, which takes half of the time.
    """
    n = size // 2

    @njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
    def filter_columns(  # type: ignore[no-untyped-def] # noqa: PLR0912 - one pass over the rows
        Phi, correction, whitener, forcing, seen, x, blind, every, out
    ):
        """Add to out (N // every, n, c) the errors of x(k+1) = Phi x + correction e + forcing.

        e = seen - C x, whitened, summed over `every` rows and divided by its root; zero before row
        `blind`. Inputs are stored column by column, outputs side by side.
        """
        columns, rows, _ = forcing.shape
        following, e = np.empty((size, columns)), np.zeros((n, columns))
        reads, fixed, root = len(seen) > 0, len(Phi) == 1, 1.0 / np.sqrt(every)
        for k in range(rows // every * every):
            at = 0 if fixed else k
            gain = at if len(correction) > 1 else 0
            white = at if len(whitener) > 1 else 0
            for i in range(n):
                for c in range(columns):
                    e[i, c] = -x[i, c]
            if reads:
                for c in range(columns):
                    for i in range(n):
                        e[i, c] += seen[c, k, i]
            for c in range(columns):
                for i in range(size):
                    following[i, c] = forcing[c, k, i]
            for i in range(size):
                for c in range(columns):
                    total = following[i, c]
                    for j in range(size):
                        total += Phi[at, i, j] * x[j, c]
                    for j in range(n):
                        total += correction[gain, i, j] * e[j, c]
                    following[i, c] = total
            if k >= blind:
                for i in range(n):
                    for c in range(columns):
                        total = 0.0
                        for j in range(n):
                            total += whitener[white, i, j] * e[j, c]
                        out[k // every, i, c] += root * total
            for i in range(size):
                for c in range(columns):
                    x[i, c] = following[i, c]
            if k % _TINY_ROWS == 0:
                for i in range(size):
                    for c in range(columns):
                        if abs(x[i, c]) < TINY:
                            x[i, c] = 0.0

    return filter_columns
