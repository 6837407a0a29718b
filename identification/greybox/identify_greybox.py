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
from ..records.record import IdentificationError
from .experiment_from_log import Experiment
from .fit import Fit, fit_model
from .validation import Validation, validate

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class GreyBox:
    """The declared model, the fitted model, and the validation on held-out rows.

    `fitted` is a model file with fitted values and standard errors. `validations` has one entry for
    each record. `remarks` list contradictions between model and records.
    """

    declared: ModelConfig
    fitted: ModelConfig
    fit: Fit
    validations: tuple[Validation, ...]
    Ts_s: float
    delay_cycles: int
    remarks: tuple[str, ...] = ()

    def response(self, schedule: Mapping[str, float], freq_hz: Array) -> Complex:
        """Return the response (F, n, p) from command to output at freq_hz (F,) in Hz, with delay.

        It includes the hold of the model's `input`; for a band-limited input it is the continuous
        response.
        """
        model, delay_s = self.state_space(schedule)
        late = np.exp(-2j * np.pi * np.asarray(freq_hz) * delay_s)
        return np.asarray(model.response(freq_hz) * late[:, None, None])

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
) -> GreyBox:
    """Fit `config` to the first 1 - holdout of every record and validate it on the rest.

    Raises IdentificationError for a closed-loop record if the model's input is not zoh, and as
    fit_model does.
    """
    units = dict.fromkeys(text for e in experiments for text in e.contradictions)
    remarks = (*units, *_compare_holds(config, experiments))
    stops = [len(e.y) - round(holdout * len(e.y)) for e in experiments]
    fit = fit_model(
        config, [e.rows(0, stop) for e, stop in zip(experiments, stops, strict=True)], progress
    )
    checks = tuple(
        validate(fit.model, e.rows(stop if holdout else 0, len(e.y)), config.input, fit.noise)
        for e, stop in zip(experiments, stops, strict=True)
    )
    first = experiments[0]
    return GreyBox(
        config,
        fitted_model(config, fit),
        fit,
        checks,
        first.Ts_s,
        first.delay_cycles,
        remarks,
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
