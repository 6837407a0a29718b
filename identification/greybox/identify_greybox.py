"""Fit the declared model (grey box) to the start of each record and validate it on the end."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from ...config.model import ModelConfig
from ...model.second_order import StateSpace, discretise, lagged
from ..record_threads import record_threads
from ..records.held_out_rows import HeldOut, held_out_rows
from ..records.record import IdentificationError
from ..records.value_check import check_values
from ..subspace.response_uncertainty import SURE_95
from .declared_model_from_config import declared_model
from .experiment.experiment_from_log import Experiment
from .experiment.intersample_input import Hold
from .fit import Fit, fit_model
from .fit_in_loop import FittedLoop, fit_in_loop, shows_loop
from .force_balance.instrumental_variables import ForceBalance, fit_force_balance
from .free_parameters import free_parameters
from .free_run.free_run_simulation import free_run, run_in_rows
from .prediction.multistep_prediction import predict_ahead
from .prediction.noise_model import Noise
from .validation import Validation, metric_of, validate

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

DECLARE_LOOP = "Declare the loop in the signals file"
"""Remedy of a remark on a model that drifts."""
_NEAR = 0.5
"""Error of a simulation over the output's standard deviation up to which it is an instrument."""


@dataclass(frozen=True)
class GreyBox:
    """The declared model, the fitted model, and the validation on held-out rows.

    `fitted` is a model file with fitted values and standard errors. `validations` has one entry for
    each record. `balance`: the fit of the force balance, None if the prediction errors are white;
    its parameters and intervals are those of `fitted`. `remarks` list contradictions between model
    and records. `columns`: what columns have to be for the model to explain the records, such as "x
    and y are exchanged"; empty if nothing suggests that they are wrong. `doubts`: why the records
    give no model, however well it fits.
    """

    declared: ModelConfig
    fitted: ModelConfig
    fit: Fit
    validations: tuple[Validation, ...]
    Ts_s: float
    delay_cycles: int
    remarks: tuple[str, ...] = ()
    balance: ForceBalance | None = None
    columns: str = ""
    doubts: tuple[str, ...] = ()
    loop: FittedLoop | None = None
    """The fit to spectra of records in a loop; None for the likelihood of prediction errors."""

    @property
    def explains_nothing(self) -> bool:
        """Whether the errors on held-out rows are as large as the outputs, up to chance, or no
        parameter fits.

        A noise that is estimated as large as the motion leaves white errors for any model.
        """
        tested = [v for v in self.validations if np.any(np.isfinite(v.error_percent))]
        nothing = bool(tested) and not any(v.explains_something for v in tested)
        return nothing or not self.fit.free

    def response(self, schedule: Mapping[str, float], freq_hz: Array) -> Complex:
        """Return the response (F, n, p) from command to output at freq_hz (F,) in Hz, with delay.

        It includes the hold of the model's `input`; for a band-limited input it is the continuous
        response.
        """
        model, delay_s = self.state_space(schedule)
        return model.response(freq_hz, delay_s)

    def state_space(self, schedule: Mapping[str, float]) -> tuple[StateSpace, float]:
        """Return the plant from command to output, and its separate input delay in s.

        For zoh and foh inputs the plant is discrete, with the delay as states and 0 s separate. For
        a band-limited input no discrete model is exact: the plant is continuous.
        """
        at = self.fit.model.at(schedule)
        delay_s = max(at.delay_s + self.delay_cycles * self.Ts_s, 0.0)
        hold = self.declared.input
        if hold == "band_limited":
            return lagged(at), delay_s
        return discretise(replace(at, delay_s=delay_s), self.Ts_s, hold), 0.0


def identify_grey_box(
    config: ModelConfig,
    experiments: Sequence[Experiment],
    holdout: float,
    progress: Callable[[str, float], None] | None = None,
    band_hz: tuple[float, float] | None = None,
) -> GreyBox:
    """Fit `config` to the first 1 - holdout of every record and validate it on the rest.

    The rest begins where motion is left behind it (`held_out_rows`).

    Records of the rig that excite a loop at rest are fitted by their spectra, in `band_hz` if
    given, with the modes that the declared model lacks (`modes`).

    Imported records with prediction errors that are not white have something that the model lacks.
    Their likelihood then weighs frequencies by a noise that they do not have, and its intervals are
    too narrow: parameters and intervals come from the force balance, and cover the likelihood's
    estimate, too.

    Raises IdentificationError for a closed-loop record if the model's input is not zoh, and as
    fit_model does.
    """
    check_values(experiments)
    units = dict.fromkeys(text for e in experiments for text in e.contradictions)
    remarks = (*units, *_compare_holds(config, experiments))
    imported = all(e.correlations is None for e in experiments)
    if imported:
        remarks += tuple(f"record '{e.name}': {text}" for e in experiments for text in e.remarks)
    held = [held_out_rows(e.y, e.u, holdout) for e in experiments]
    training = [e.rows(0, found.start) for e, found in zip(experiments, held, strict=True)]
    loop, balance = None, None
    if any(map(shows_loop, training)):
        kept = [e.rows(h.start, h.stop) for e, h in zip(experiments, held, strict=True)]
        fit, loop = fit_in_loop(config, training, kept if holdout else (), band_hz, progress)
        floor_noise: Noise | None = fit.noise
    else:
        fit = fit_model(config, training, progress)
        white = fit.white
        if imported and not white:
            fit, balance, notes = _with_force_balance(config, fit)
            remarks += notes
        floor_noise = fit.noise if white or not imported else stated_noise(experiments)
    held_out = [
        e.rows(_first_simulated(e, found), found.stop) if holdout else e
        for e, found in zip(experiments, held, strict=True)
    ]

    def check(e: Experiment) -> Validation:
        return validate(fit.model, e, config.input, fit.noise, floor_noise)

    with record_threads() as pool:
        checks = tuple(pool.map(check, held_out))
    first = experiments[0]
    return GreyBox(
        config,
        fitted_model(config, fit),
        fit,
        checks,
        first.Ts_s,
        first.delay_cycles,
        (*remarks, *_drifting(config, checks, held_out)),
        balance,
        loop=loop,
    )


def _first_simulated(e: Experiment, held: HeldOut) -> int:
    """Return the row from which the held-out rows of a record are simulated.

    The rows that estimate the state at the start do not count. Where a record holds out the end of
    one event, they are taken from the rows before: the event would be over.
    """
    if not held.event:
        return held.start
    return max(held.start - run_in_rows(held.stop - held.start, e.Ts_s), 0)


def stated_noise(experiments: Sequence[Experiment]) -> Noise | None:
    """Return the measurement noise that all records state, with quantisation; else None.

    There is no force noise in it: a floor is what the sensors alone leave.
    """
    found = []
    for e in experiments:
        if e.noise_sd is None or not np.all(np.isfinite(e.noise_sd)):
            return None
        step = np.zeros(len(e.noise_sd)) if e.resolution is None else np.nan_to_num(e.resolution)
        found.append(e.noise_sd**2 + step**2 / 12.0)
    variance = np.max(found, axis=0)
    return Noise.independent(np.full(len(variance), np.finfo(float).tiny), variance)


def _with_force_balance(
    config: ModelConfig, fit: Fit
) -> tuple[Fit, ForceBalance | None, tuple[str, ...]]:
    """Return the fit with the parameters and intervals of the force balance."""
    if not fit.free:
        return (
            fit,
            None,
            (
                "prediction errors are not white: the model lacks something. The records determine "
                "no parameter, so all keep their declared values. Excite the inputs more",
            ),
        )
    p = free_parameters(config)
    free = p.only([p.names.index(name) for name in fit.free])
    records = fit.records
    try:
        found = fit_force_balance(
            fit.model,
            records,
            config.input,
            free.names,
            (free.low, free.high, free.scale),
            [_instrument(fit, e, config.input) for e in records],
        )
    except IdentificationError as error:
        return (
            fit,
            None,
            (
                "prediction errors are not white: the model lacks something, and the intervals are "
                f"too narrow. There is no force balance: {error}",
            ),
        )
    apart = np.array([fit.values[name] for name in free.names]) - found.values
    half_width = np.maximum(found.half_width, np.abs(apart))
    found = replace(found, half_width=half_width)
    low, middle, high = found.band_hz
    note = (
        "prediction errors are not white: the model lacks something. The parameters are those of "
        f"the force balance up to {middle:.3g} Hz; the intervals cover limits of {low:.3g} to "
        f"{high:.3g} Hz, an equation of one order more, and the maximum-likelihood estimate"
    )
    moved = replace(
        fit,
        model=fit.model.with_values(found.as_values()),
        covariance=np.diag((half_width / SURE_95) ** 2),
        at_bound=free.at_bound(found.values),
    )
    return moved, found, (note,)


def _instrument(fit: Fit, e: Experiment, hold: Hold) -> Experiment:
    """Return the experiment with simulated outputs and inputs, or with predicted outputs.

    A simulation has no noise of the record; the prediction one row ahead has none of its own row. A
    simulation that is far from the record is a poor instrument.
    """
    if metric_of(fit.model, e) == "free_run":
        run = free_run(fit.model, e, hold, fit.noise)
        with np.errstate(over="ignore", invalid="ignore"):
            error = (run.y - e.y).std(axis=0)
        if np.all(error < _NEAR * e.y.std(axis=0)):
            return replace(e, y=run.y, u=run.u)
    ahead = predict_ahead(fit.model, e, hold, fit.noise, 1)
    return replace(e, y=np.where(np.isfinite(ahead), ahead, e.y))


def _drifting(
    config: ModelConfig, checks: Sequence[Validation], experiments: Sequence[Experiment]
) -> tuple[str, ...]:
    """Return remarks where the fitted model drifts; if the declared one did, it is known before."""
    start = declared_model(config)
    return tuple(
        f"record '{e.name}': the fitted model integrates or is unstable, unlike the declared one, "
        "and no loop is declared: a simulation would drift, so the error is that of predictions. "
        f"{DECLARE_LOOP}"
        for check, e in zip(checks, experiments, strict=True)
        if check.metric == "prediction" and not e.feedback and metric_of(start, e) == "free_run"
    )


def _compare_holds(config: ModelConfig, experiments: Sequence[Experiment]) -> tuple[str, ...]:
    """Return remarks on logs and model that state different inputs between samples."""
    looped = next((e for e in experiments if e.loop is not None), None)
    if looped is not None and config.input != "zoh":
        raise IdentificationError(
            f"model '{config.name}': input: expected zoh, found {config.input}: record "
            f"'{looped.name}' has a digital controller, which holds its output between samples"
        )
    return tuple(
        f"record '{e.name}': input_hold: {e.hold} in its signals file, but input: {config.input} "
        f"in model '{config.name}'; the fit uses the model's, and is biased if that is wrong"
        for e in experiments
        if e.hold not in (None, config.input)
    )


def fitted_model(config: ModelConfig, fit: Fit) -> ModelConfig:
    """Return the model file with fitted values and their standard errors."""
    errors = fit.standard_errors
    parameters = {
        name: parameter.model_copy(update={"value": fit.values[name], "se": errors.get(name)})
        for name, parameter in config.parameters.items()
    }
    return config.model_copy(update={"parameters": parameters})


def to_yaml(config: ModelConfig) -> str:
    """Return a model as the text of a model file."""
    plain = config.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    # `input` is always written, even the default: the parameters depend on it.
    kept = {key for key in plain if key != "levid"} | {"input"}
    whole = {key: plain.get(key, config.input) for key in type(config).model_fields if key in kept}
    return yaml.dump(
        {"levid": "model", **whole}, Dumper=_Flow, sort_keys=False, width=100, allow_unicode=True
    )


class _Flow(yaml.SafeDumper):
    """YAML in block style, with rows and parameters in flow style, as in the shipped files."""

    def represent_sequence(
        self, tag: str, sequence: Iterable[Any], flow_style: bool | None = None
    ) -> yaml.SequenceNode:
        """Write a list of scalars in one line."""
        sequence = list(sequence)
        flat = all(not isinstance(item, (list, dict)) for item in sequence)
        return super().represent_sequence(tag, sequence, flow_style=flat or flow_style)

    def represent_mapping(
        self, tag: str, mapping: Any, flow_style: bool | None = None
    ) -> yaml.MappingNode:
        """Write a mapping of scalars in one line, except the file itself."""
        flat = "levid" not in mapping and all(
            not isinstance(item, (list, dict)) for item in mapping.values()
        )
        return super().represent_mapping(tag, mapping, flow_style=flat or flow_style)
