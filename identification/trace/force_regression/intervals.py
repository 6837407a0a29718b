"""Compute standard errors of all numbers of a model: from blocks of time, band and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Placed
from ...rounding import DIFFERENCE, ROUNDING, TINY
from ...subspace.response_uncertainty import SURE_95
from ..force_balance.force_record import ForceModel, ForceRecord
from ..force_balance.free_numbers import numbers, numbers_of, silent_numbers
from .candidate_fit import flat
from .training_records import Training

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Uncertainty:
    """How well the numbers of a fitted model are known: parameters, then effects' numbers.

    covariance (K, K): by the scatter of blocks; what a model lacks is coloured, and correlates with
    its columns. moved (L, K): changes by fits to other records: in another band, or with more noise
    in the motion, and by effects that may be missing; none if L is 0. silent (K,): whether a number
    changes no force at all, such as a constant one.
    """

    covariance: Array
    moved: Array
    silent: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        point: ForceModel,
        training: Training,
        moved: Sequence[Array],
        instruments: Training | None = None,
    ) -> Uncertainty:
        """Return the uncertainty of a model that was fitted to `training`, with `instruments`.

        moved: changes of all its numbers (K,) by other fits.
        """
        influences = Influences.of(point, training, instruments)
        changes = np.array(moved).reshape(len(moved), len(influences.silent))
        return cls(influences.covariance(), changes, influences.silent)

    def with_more(self, moved: Sequence[Array]) -> Uncertainty:
        """Return the uncertainty with changes of all numbers (K,) by further fits."""
        return replace(self, moved=np.vstack([self.moved, *moved]))

    def standard_errors(self, gradients: Array | None = None) -> Array:
        """Return the standard error of each number (K,), or of what has the gradients (., K).

        It is infinite for a number that is silent.
        """
        g = np.eye(len(self.covariance)) if gradients is None else gradients
        variances = np.einsum("ij,jk,ik->i", g, self.covariance, g)
        spread = np.abs(self.moved @ g.T).max(axis=0, initial=0.0)
        errors = np.hypot(np.sqrt(np.maximum(variances, 0.0)), spread / SURE_95)
        return np.where(np.any(self.silent & (g != 0.0), axis=1), np.inf, errors)


@dataclass(frozen=True)
class Influences:
    """What each block of time changes in the fitted numbers: by_block (B, K), its mean is 0.

    of_prior (P, K): the same of the priors, of one standard deviation each. silent (K,): whether a
    number changes no force at all, such as a constant one.
    """

    by_block: Array
    of_prior: Array
    silent: NDArray[np.bool_]

    @classmethod
    def of(
        cls, point: ForceModel, training: Training, instruments: Training | None = None
    ) -> Influences:
        """Return the influences on a model that was fitted to `training`, with `instruments`."""
        at = training.at(point)
        columns = training.columns_at(point)
        size = np.linalg.norm(flat(columns), axis=0)
        silent = silent_numbers(point, size, float(at.power.sum()))
        size = np.where(silent, 1.0, size)
        own = columns if instruments is None else instruments.columns_at(point)
        products = training.blocks.products(own, columns, at.missing) / size[:, None]
        rows = point.parameters.prior_rows(point.values)[:, :-1]
        prior = np.hstack([rows, np.zeros((len(rows), len(size) - rows.shape[1]))]) / size
        inner = products[:, :, :-1].sum(axis=0) / size + prior.T @ prior
        inverse = np.linalg.pinv(inner, rcond=ROUNDING)
        scores = products[:, :, -1]
        scores = (scores - scores.mean(axis=0)) * np.sqrt(len(scores) / max(len(scores) - 1, 1))
        unit = np.concatenate([point.parameters.scale, np.ones(len(size) - len(point.values))])
        by_block, of_prior = ((part @ inverse.T) * (unit / size) for part in (scores, prior))
        return cls(by_block, of_prior, silent)

    def covariance(self) -> Array:
        """Return the covariance of all numbers (K, K): what a model lacks is coloured, and
        correlates with its columns."""
        return np.asarray(self.by_block.T @ self.by_block + self.of_prior.T @ self.of_prior)


def relative_force_errors(
    point: ForceModel, records: Sequence[ForceRecord], uncertainty: Uncertainty
) -> list[Array]:
    """Return the relative standard errors of the forces of each effect's amplitudes, by effect.

    That of an addition to a command is a product with the gain of the input: a propeller with a
    purely squared thrust has no other gain, so that neither is told from zero, but the product is.
    """
    count, found, first = len(numbers(point)), [], len(point.values)
    for p in point.placed:
        gradients = np.zeros((len(p.amplitudes), count))
        for i, name in enumerate(point.parameters.names):
            if name not in point.model.lag.names | point.model.delay.names:
                ends = []
                for sign in (1.0, -1.0):
                    values = point.values
                    values[i] += sign * DIFFERENCE * point.parameters.scale[i]
                    ends.append(np.log(_sizes(point.with_values(values), p, records)))
                step = 2.0 * DIFFERENCE * point.parameters.scale[i]
                gradients[:, i] = (ends[0] - ends[1]) / step
        amplitudes = np.array(p.amplitudes)
        gradients *= amplitudes[:, None]
        gradients[:, first : first + numbers_of(p)] += p.freedom[: len(amplitudes)]
        errors = uncertainty.standard_errors(gradients)
        with np.errstate(divide="ignore", invalid="ignore"):
            found.append(np.where(errors > 0.0, errors / np.abs(amplitudes), 0.0))
        first += numbers_of(p)
    return found


def _sizes(point: ForceModel, placed: Placed, records: Sequence[ForceRecord]) -> Array:
    """Return the size of the force of one unit of each amplitude of an effect."""
    forces = [r.effect_forces(point, placed.effect, placed.shape) for r in records]
    squares = np.sum([np.sum(f**2, axis=(1, 2)) for f in forces], axis=0)
    return np.asarray(np.sqrt(np.maximum(squares, TINY)))
