"""Fit what records at rest do not determine to records with a moving schedule."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ...config.model import ModelConfig
from ...model.declared_model import DeclaredModel
from ..records.record import IdentificationError
from .experiment.experiment_from_log import Experiment
from .fit import Linearised, linearised
from .free_parameters import free_parameters
from .identifiability import Unidentifiable, find_unidentifiable
from .modes.identify_in_loop import LoopFit

Array = NDArray[np.float64]

_ROUNDS = 6
_SETTLED = 0.1
"""Change of a parameter in standard errors below which the rounds end."""
_STEP = 1e-4
_SURE = 5.0
"""Standard deviations of the mean square error beyond which it is more than noise."""
_PART_S = 2.0
"""Length of a part: about a move of the beam."""
_LEAST_PARTS, _CHANCE = 4, 1e-3
"""Least parts that are compared; probability of a larger disagreement by chance, below which the
model has an error."""


@dataclass(frozen=True)
class Determined:
    """The model with all parameters, those that are determined, and their covariance (F, F)."""

    model: DeclaredModel
    free: tuple[str, ...]
    covariance: Array
    unidentifiable: tuple[Unidentifiable, ...]


def determined(config: ModelConfig, found: LoopFit, moving: Sequence[Experiment]) -> Determined:
    """Return the parameters of a fit at rest, and of moving records what that does not determine.

    The moving records are predicted one step ahead, with the noise that was measured at rest; only
    these parameters change. While one does, the others keep the matrices at rest as they are: M and
    K contain z_b only together with other parameters. Where the errors are larger than the noise,
    the standard errors are, too; and where parts of the records disagree by more than chance, the
    standard error is at least their scatter, because an error of the model does not average out.
    """
    p = free_parameters(config)
    at_rest = _At(
        found,
        tuple(n for n in p.names if n not in {u.name for u in found.unidentifiable}),
        tuple(u.name for u in found.unidentifiable),
        dict(zip(p.names, p.scale.tolist(), strict=True)),
    )
    model = found.plant.model
    if not (at_rest.held and moving):
        return at_rest.alone(model, found.unidentifiable)
    worth = dict(zip(p.names, p.worth.tolist(), strict=True))
    for _ in range(_ROUNDS):
        try:
            of = linearised(_at_values(config, model), moving, found.noise)
        except IdentificationError:
            return at_rest.alone(found.plant.model, found.unidentifiable)  # too short
        new, left = at_rest.reached(of, worth)
        if not new:
            return at_rest.alone(found.plant.model, tuple(left))
        A, _ = at_rest.along(of, new)
        change = -np.linalg.lstsq(A, of.right, rcond=None)[0]
        errors = np.sqrt(np.diag(np.linalg.inv(A.T @ A)))
        values = {n: model.values[n] + x for n, x in zip(new, change.tolist(), strict=True)}
        model = at_rest.carried(model, values)
        if np.all(np.abs(change) < _SETTLED * errors):
            break
    extra = np.zeros(len(new))
    if of.squares / of.rows > 1.0 + _SURE * np.sqrt(2.0 / of.rows):
        parts = [part for e in moving for part in _parts(e)]
        extra = at_rest.scatter(_at_values(config, model), parts, new)
    covariance = at_rest.covariance(of, new, np.diag(extra))
    return Determined(model, (*at_rest.known, *new), covariance, tuple(left))


def _parts(experiment: Experiment) -> list[Experiment]:
    """Return consecutive parts of a record, about as long as a move."""
    rows = len(experiment.y)
    count = max(round(rows * experiment.Ts_s / _PART_S), 1)
    return [experiment.rows(rows * k // count, rows * (k + 1) // count) for k in range(count)]


def _at_values(config: ModelConfig, model: DeclaredModel) -> ModelConfig:
    parameters = {
        name: p.model_copy(update={"value": model.values[name]})
        for name, p in config.parameters.items()
    }
    return config.model_copy(update={"parameters": parameters})


@dataclass(frozen=True)
class _At:
    """The fit at rest: the parameters known from it, and those held, by name."""

    found: LoopFit
    known: tuple[str, ...]
    held: tuple[str, ...]
    scale: Mapping[str, float]

    def alone(self, model: DeclaredModel, unidentifiable: tuple[Unidentifiable, ...]) -> Determined:
        """Return what records at rest determine."""
        own = [self.found.names.index(name) for name in self.known]
        return Determined(
            model, self.known, self.found.covariance[np.ix_(own, own)], unidentifiable
        )

    def slopes(self, new: Sequence[str]) -> tuple[Array, Array]:
        """Return S and the covariance of e (K, K) in k = S h + e: known by new parameters."""
        k, h = ([self.found.names.index(n) for n in names] for names in (self.known, new))
        across = self.found.covariance[np.ix_(k, h)]
        S = np.linalg.solve(self.found.covariance[np.ix_(h, h)], across.T).T
        return np.asarray(S), self.found.covariance[np.ix_(k, k)] - S @ across.T

    def along(self, of: Linearised, new: Sequence[str]) -> tuple[Array, Array]:
        """Return the change of the errors by new parameters, known ones carried along, and by those
        alone."""
        R_new, R_known = (of.R[:, [of.names.index(n) for n in x]] for x in (new, self.known))
        return np.asarray(R_new + R_known @ self.slopes(new)[0]), R_known

    def reached(
        self, of: Linearised, worth: Mapping[str, float]
    ) -> tuple[tuple[str, ...], list[Unidentifiable]]:
        """Return the held parameters that the moving records determine, and the others."""
        A, _ = self.along(of, self.held)
        R = np.asarray(np.linalg.qr(A, mode="r"))
        scale = np.array([self.scale[n] for n in self.held])
        limits = np.array([worth[n] for n in self.held])
        left = find_unidentifiable(R * scale, self.held, limits, scale)
        names = {u.name for u in left}
        return tuple(n for n in self.held if n not in names), left

    def carried(self, model: DeclaredModel, values: Mapping[str, float]) -> DeclaredModel:
        """Return the model with new values, and the known parameters such that M, D and K stay."""
        target = self._matrices(model)
        size = np.abs(target).max(axis=0)
        size = np.where(size > 0.0, size, 1.0)
        model = model.with_values(values)
        for _ in range(3):  # the matrices are nearly linear in the parameters
            left = ((target - self._matrices(model)) / size).ravel()
            slopes = []
            for name in self.known:
                high = model.with_values({name: model.values[name] + _STEP * self.scale[name]})
                slopes.append(((self._matrices(high) - self._matrices(model)) / size).ravel())
            step = np.linalg.lstsq(np.array(slopes).T / _STEP, left, rcond=1e-6)[0]
            moved = zip(self.known, step.tolist(), strict=True)
            model = model.with_values({n: model.values[n] + x * self.scale[n] for n, x in moved})
        return model

    def _matrices(self, model: DeclaredModel) -> Array:
        """Return all entries (points, entries) of M, D and K at the points of the fit."""
        at = [model.at(point.schedule) for point in self.found.points]
        return np.array([np.concatenate([m.M.ravel(), m.D.ravel(), m.K.ravel()]) for m in at])

    def scatter(
        self, config: ModelConfig, parts: Sequence[Experiment], new: Sequence[str]
    ) -> Array:
        """Return the variance (K,) of new parameters between parts of records, beyond noise.

        By moments (DerSimonian and Laird 1986); zero if chance explains the scatter (Cochran's Q).
        """
        found = [linearised(config, [part], self.found.noise) for part in parts]
        variances = np.zeros(len(new))
        for k in range(len(new)):
            weights, estimates = [], []
            for of in found:
                A, _ = self.along(of, new)
                others = np.delete(A, k, axis=1)
                own = A[:, k] - others @ (np.linalg.pinv(others) @ A[:, k])
                if (weight := float(own @ own)) > 0.0:
                    weights.append(weight)
                    estimates.append(-float(own @ of.right) / weight)
            w, x = np.array(weights), np.array(estimates)
            if len(w) < _LEAST_PARTS:
                continue
            Q = float(w @ (x - w @ x / w.sum()) ** 2)
            if chi2.isf(_CHANCE, len(w) - 1) < Q:
                variances[k] = (Q - (len(w) - 1)) / (w.sum() - w @ w / w.sum())
        return variances

    def covariance(self, of: Linearised, new: Sequence[str], extra: Array) -> Array:
        """Return the covariance (F, F) of known and newly determined parameters.

        The moving records give A h = - R_known e + n with unit noise n, or larger where their
        errors are; at rest k = S h + e. extra (K, K): a covariance of h that does not average out.
        """
        S, own = self.slopes(new)
        A, R_known = self.along(of, new)
        inverse = np.linalg.pinv(A)
        size = max(of.squares / of.rows, 1.0)
        by_known = -inverse @ R_known @ own  # covariance of h and e
        of_new = size * inverse @ inverse.T - by_known @ (inverse @ R_known).T + extra
        joint = S @ of_new + by_known.T
        of_known = own + S @ of_new @ S.T + S @ by_known + (S @ by_known).T
        return np.block([[of_known, joint], [joint.T, of_new]])
