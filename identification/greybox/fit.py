"""Fit the declared model by maximum likelihood of one-step-ahead prediction errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ...config.model import ModelConfig
from ...model.declared_model import DeclaredModel, ModelError
from ..record_threads import record_threads
from ..records.record import IdentificationError
from ..records.varying_signals import varying
from .declared_model_from_config import declared_model
from .experiment.experiment_from_log import Experiment
from .free_parameters import free_parameters
from .identifiability import Unidentifiable, find_unidentifiable
from .prediction.discretisation import motion
from .prediction.noise_estimate import estimate_noise
from .prediction.noise_model import Filter, Noise
from .prediction.prediction_errors import Prediction, errors_of, predict, settled
from .validation import whiteness

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

_MAX_STEPS = 15
_MAX_TRIES = 12
_SINGULAR = 1e-8
_CONVERGED = 0.5
"""A step below this many standard errors ends the search. The next one would be below a hundredth,
since the errors are nearly linear in the parameters near the optimum."""
_HALF_STEP = 1e-4
"""Half step of the central differences, as a share of a parameter's scale."""
_NOISE_ROUNDS = 6
_NOISE_SETTLED = 0.1
"""Largest relative change of a noise variance at convergence."""
_FIRST_FORCE_SHARE = 0.3
"""Initial guess of unknown forces, as a share of the input."""
_NOISE_ROWS = 24_000
_NOISE_RECORDS = 3
_SHORTEST_ROWS = 50
_FIRST_ROWS = 8_000
_WHITE = 1e-3
"""Probability by chance above which prediction errors count as white."""


@dataclass(frozen=True)
class Fit:
    """A fitted model.

    `free`: the fitted parameters, with `covariance` (F, F) in SI units. `unidentifiable`:
    parameters that the records do not determine, held at their declared values. `at_bound`: fitted
    parameters at a bound of the model file, whose standard errors are unreliable. `records`: those
    that were fitted; `white`: whether what the model leaves of them is chance.
    """

    model: DeclaredModel
    free: tuple[str, ...]
    covariance: Array
    unidentifiable: tuple[Unidentifiable, ...]
    at_bound: tuple[str, ...]
    noise: Noise
    records: tuple[Experiment, ...]
    white: bool
    steps: int
    uncertain: tuple[tuple[str, ...], Array] | None = None
    """Parameters and covariance of the fit with those that are held, if these count as uncertain:
    what depends on both has smaller errors than either."""

    @property
    def errors_of(self) -> tuple[tuple[str, ...], Array]:
        """Parameters (F,) and covariance (F, F) from which errors of results follow."""
        return (self.free, self.covariance) if self.uncertain is None else self.uncertain

    @property
    def values(self) -> Mapping[str, float]:
        """Values of all parameters in SI units."""
        return self.model.values

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors of the fitted parameters in SI units."""
        return dict(zip(self.free, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def fit_model(
    config: ModelConfig, experiments: Sequence[Experiment], progress: Progress | None = None
) -> Fit:
    """Fit all free parameters of `config` to all experiments together.

    The prediction errors are those of the declared model's Kalman filter under white forces and
    white measurement noise, whose variances are estimated too. This is the exact likelihood also in
    closed loop, since the commanded input is known. A constant force and the initial state are
    fitted for each record. The solver is damped Gauss-Newton on QR factors, within the bounds of
    the model file; priors are additional rows. Standard errors are those of maximum likelihood.

    Raises IdentificationError without experiments, for a record that is too short, for an output
    that never moves, or for a model without values.
    """
    if not experiments:
        raise IdentificationError("expected at least one record to fit, found none")
    for e in experiments:
        if len(e.y) < _SHORTEST_ROWS:
            raise IdentificationError(
                f"record '{e.name}': expected at least {_SHORTEST_ROWS} rows, found {len(e.y)}"
            )
    try:
        with threadpool_limits(1):
            return _Search(config, experiments, progress or (lambda _what, _share: None)).run()
    except ModelError as error:
        raise IdentificationError(f"model '{config.name}': {error}") from None


def unidentifiable_at_start(
    config: ModelConfig, experiments: Sequence[Experiment], force_share: float
) -> tuple[Unidentifiable, ...]:
    """Return the parameters that the records do not determine, from sensitivities at the start.

    The start is the declared values; forces of `force_share` times the inputs (RMS) are unknown.
    Raises as fit_model does.
    """
    try:
        with threadpool_limits(1):
            search = _Search(config, experiments, lambda _what, _share: None)
            search.noise = first_noise(experiments, force_share)
            R = search.factor(search.predict_all(search.model))[:-1, :-1]
    except ModelError as error:
        raise IdentificationError(f"model '{config.name}': {error}") from None
    p = search.parameters
    return tuple(find_unidentifiable(R, p.names, p.worth, p.scale))


@dataclass(frozen=True)
class Linearised:
    """Whitened errors of records at a model, linear in the free parameters `names` (F,).

    R (F, F), in SI units, and right (F,): the errors are R change + right, and a rest of `squares`
    over `rows` that no change reaches. Priors are not in it.
    """

    names: tuple[str, ...]
    R: Array
    right: Array
    squares: float
    rows: int


def linearised(config: ModelConfig, experiments: Sequence[Experiment], noise: Noise) -> Linearised:
    """Return the prediction errors of records at the declared values of `config`."""
    with threadpool_limits(1):
        search = _Search(config, experiments, lambda _what, _share: None)
        search.noise = noise
        R = search.factor(search.predict_all(search.model))
    rows = sum(e.y.size for e in experiments)
    scale = search.parameters.scale
    return Linearised(
        search.parameters.names, R[:-1, :-1] / scale, R[:-1, -1], float(R[-1, -1] ** 2), rows
    )


class _Search:
    def __init__(
        self, config: ModelConfig, experiments: Sequence[Experiment], progress: Progress
    ) -> None:
        _require_motion(config, experiments)
        self.hold, self.experiments, self.progress = config.input, tuple(experiments), progress
        self.model = declared_model(config)
        self.parameters = free_parameters(config)
        self.noise = first_noise(experiments)
        self.held: list[Unidentifiable] = []
        self.steps, self.damping = 0, 0.0
        self.last = np.zeros((0, 0))
        self.near_declared = True

    def run(self) -> Fit:
        # With large force noise the filter follows the record for any parameters, and the errors
        # are nearly linear in them; with small force noise it is close to a simulation, whose error
        # has many local minima. So the noise is reduced in steps, and the parameters are refitted.
        # These steps use only a part of each record.
        whole, self.experiments = self.experiments, tuple(map(_shortened, self.experiments))
        predictions = self.fit_parameters(tolerance=0.1)
        for _ in range(_NOISE_ROUNDS):
            before, self.noise = self.noise, self.refined_noise(predictions)
            predictions = self.fit_parameters(tolerance=0.1)
            if self.noise.distance(before) < _NOISE_SETTLED:
                break
        self.experiments, self.near_declared = whole, False
        predictions = self.predict_all(self.model)
        if self.hold_unidentifiable(predictions):
            predictions = self.fit_parameters(tolerance=0.1)
        self.noise = self.refined_noise(predictions)
        predictions = self.fit_parameters(tolerance=_CONVERGED)
        inverse = np.linalg.inv(self.last[:-1, :-1])
        scale = self.parameters.scale
        return Fit(
            self.model,
            self.parameters.names,
            scale[:, None] * (inverse @ inverse.T) * scale,
            tuple(self.held),
            self.parameters.at_bound(self.values()),
            self.noise,
            self.experiments,
            _white(predictions),
            self.steps,
        )

    def fit_parameters(self, tolerance: float) -> list[Prediction]:
        """Take Gauss-Newton steps until one is below `tolerance` standard errors."""
        predictions = self.predict_all(self.model)
        for _ in range(_MAX_STEPS):
            self.progress(f"step {self.steps + 1}", self.share())
            self.last = self.factor(predictions)
            moved, predictions = self.step(self.last, predictions)
            self.steps += 1
            if moved < tolerance:
                break
        return predictions

    def hold_unidentifiable(self, predictions: list[Prediction]) -> bool:
        """Hold unidentifiable parameters at their declared values; return whether there are any."""
        p = self.parameters
        R = self.factor(predictions)[:-1, :-1]
        self.held = find_unidentifiable(R, p.names, p.worth, p.scale)
        held_names = {u.name for u in self.held}
        declared = dict(zip(p.names, p.prior_mean.tolist(), strict=True))
        self.model = self.model.with_values({name: declared[name] for name in held_names})
        self.parameters = p.only([i for i, name in enumerate(p.names) if name not in held_names])
        return bool(held_names)

    def step(self, R: Array, predictions: list[Prediction]) -> tuple[float, list[Prediction]]:
        """Take one step that reduces the squared errors; return its size in standard errors.

        The filters are constant during the step, in the Jacobian and in the errors compared: the
        effect of a parameter through the filter has zero mean. They are updated after the step.
        """
        p = self.parameters
        J, r = R[:-1, :-1], R[:-1, -1]
        if self.near_declared:
            # Until identifiability is checked, parameters stay near their declared values.
            J = np.vstack([J, np.diag(p.scale / p.worth)])
            r = np.append(r, (self.values() - p.prior_mean) / p.worth)
        start, before = self.model, self.squares(predictions)
        # Minimum-norm least squares: unidentifiable directions do not move.
        by_worth = p.worth / p.scale
        errors = np.linalg.norm(np.linalg.pinv(J * by_worth, rcond=_SINGULAR), axis=1) * by_worth
        for _ in range(_MAX_TRIES):
            damped = np.vstack([J, np.diag(np.sqrt(self.damping) * np.linalg.norm(J, axis=0))])
            right = np.append(r, np.zeros(J.shape[1]))
            move = -by_worth * np.linalg.lstsq(damped * by_worth, right, rcond=_SINGULAR)[0]
            values = np.clip(self.values(start) + p.scale * move, p.low, p.high)
            self.model = start.with_values(dict(zip(p.names, values.tolist(), strict=True)))
            try:
                after = self.predict_all(self.model, [q.filter for q in predictions])
                if self.squares(after) <= before * (1 + 1e-12):
                    self.damping = 0.0 if self.damping < 1e-3 else self.damping / 10
                    moved = np.abs(values - self.values(start)) / p.scale / errors
                    return float(np.max(moved[errors > 0], initial=0.0)), self.predict_all(
                        self.model
                    )
            except (ModelError, IdentificationError, np.linalg.LinAlgError):
                pass  # invalid values: try a shorter step
            self.damping = max(10 * self.damping, 1e-4)
        self.model = start
        return 0.0, predictions

    def predict_all(
        self, model: DeclaredModel, filters: Sequence[Filter] | None = None
    ) -> list[Prediction]:
        by: Sequence[Noise | Filter] = filters or [self.noise] * len(self.experiments)
        with record_threads() as pool:
            return list(
                pool.map(lambda e, b: predict(model, e, self.hold, b), self.experiments, by)
            )

    def factor(self, predictions: Sequence[Prediction]) -> Array:
        """Return R (F + 1, F + 1) of [scaled Jacobian, errors], with the unknowns eliminated."""
        perturbed = [self.perturbed(i) for i in range(len(self.parameters.names))]

        def factor_one(p: Prediction) -> Array:
            columns = [self.sensitivity(p, *models) for models in perturbed]
            parts = [p.unknowns, *(c[:, :, None] for c in columns), p.errors[:, :, None]]
            stacked = np.concatenate(parts, axis=2)
            unknowns = p.unknowns.shape[2]
            R = np.asarray(np.linalg.qr(stacked.reshape(-1, stacked.shape[2]), mode="r"))
            return R[unknowns:, unknowns:]

        with record_threads() as pool:
            rows = list(pool.map(factor_one, predictions))
        rows.append(self.parameters.prior_rows(self.values()))
        return np.asarray(np.linalg.qr(np.vstack(rows), mode="r"))

    def perturbed(self, index: int) -> tuple[DeclaredModel, DeclaredModel, float, bool]:
        """Return the model with one parameter lower and higher, their scaled distance, and whether
        the parameter is in lag or delay, so that the input moments change."""
        p, name = self.parameters, self.parameters.names[index]
        value, half_step = self.model.values[name], _HALF_STEP * self.parameters.scale[index]
        low, high = max(value - half_step, p.low[index]), min(value + half_step, p.high[index])
        return (
            self.model.with_values({name: low}),
            self.model.with_values({name: high}),
            (high - low) / p.scale[index],
            name in self.model.lag.names | self.model.delay.names,
        )

    def sensitivity(
        self,
        p: Prediction,
        low: DeclaredModel,
        high: DeclaredModel,
        distance: float,
        on_inputs: bool,
    ) -> Array:
        inputs, e = None if on_inputs else p.motion.inputs, p.experiment
        # Linearised at the current offset and start: the weight deflects the rods by millimetres.
        low_errors, high_errors = (
            errors_of(settled(motion(model, e, self.hold, inputs), p.offset), p.filter, e, p.start)
            for model in (low, high)
        )
        return np.asarray((high_errors - low_errors) / distance)

    def refined_noise(self, predictions: Sequence[Prediction]) -> Noise:
        self.progress("noise", self.share())
        chosen = [p.experiment for p in predictions if p.motion.fixed] or list(self.experiments)
        # A few records, evenly spread: the noise is common to all.
        places = np.linspace(0, len(chosen) - 1, min(_NOISE_RECORDS, len(chosen)))
        subset = [chosen[round(place)] for place in places.tolist()]
        short = [e.rows(0, max(_NOISE_ROWS // len(subset), _SHORTEST_ROWS)) for e in subset]
        return estimate_noise([motion(self.model, e, self.hold) for e in short], short, self.noise)

    def values(self, model: DeclaredModel | None = None) -> Array:
        model = model or self.model
        return np.array([model.values[name] for name in self.parameters.names])

    def squares(self, predictions: Sequence[Prediction]) -> float:
        prior = self.parameters.prior_rows(self.values())[:, -1]
        total = sum(p.squares for p in predictions) + float(prior @ prior)
        if self.near_declared:
            p = self.parameters
            total += float(np.sum(((self.values() - p.prior_mean) / p.worth) ** 2))
        return total

    def share(self) -> float:
        return 1.0 - 0.85**self.steps


def _white(predictions: Sequence[Prediction]) -> bool:
    """Return whether the errors of all records are white (Ljung-Box, Bonferroni)."""
    p_values = np.concatenate([whiteness(p.errors[p.motion.blind :]).p_value for p in predictions])
    return bool(p_values.min() * len(p_values) > _WHITE)


def _require_motion(config: ModelConfig, experiments: Sequence[Experiment]) -> None:
    """Check for outputs that never move: any model with enough noise explains them."""
    still = np.all([~varying(e.y) for e in experiments], axis=0)
    if np.any(still):
        names = ", ".join(d.name for d, rests in zip(config.dof, still, strict=True) if rests)
        raise IdentificationError(
            f"expected outputs that vary, found {names} constant in every row that the fit uses: "
            "check the sensors' connection, or leave these DOF out of the model"
        )


def _shortened(e: Experiment) -> Experiment:
    rows = 2 * _FIRST_ROWS if e.moving else _FIRST_ROWS
    return e.rows(0, max(len(e.y) // 8, min(len(e.y), rows)))


def first_noise(
    experiments: Sequence[Experiment], force_share: float = _FIRST_FORCE_SHARE
) -> Noise:
    """Guess the noise: measurement noise from the outputs' roughness, forces from the inputs.

    Its correlations are those of the first record: all records of a fit are of one rig.
    """
    # The third difference of white noise has 20 times its variance; that of smooth motion is small.
    variance = np.array([np.var(np.diff(e.y, 3, axis=0), axis=0) / 20.0 for e in experiments])
    # A constant output gives no information on noise.
    variance = np.min(np.where(variance > 0.0, variance, np.inf), axis=0)
    variance = np.where(np.isfinite(variance), variance, 0.0)
    force_psd = np.max([np.var(e.u, axis=0) * e.Ts_s for e in experiments], axis=0)
    n = len(variance)
    psd = force_share**2 * (force_psd if len(force_psd) == n else np.full(n, force_psd.mean()))
    unit = experiments[0].correlations or (np.eye(n), np.eye(n))
    return Noise(*unit).scaled(np.maximum(psd, 1e-300), np.maximum(variance, 1e-300))
