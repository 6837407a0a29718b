"""Load a result of identify or trace: model.yaml and, beside it, result.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...config.base import ConfigError
from ...config.files.reading import JsonError, read_json
from ...config.model import ModelConfig, ModelEffect, load_model
from ...log.catalogue.results import RESULT

Array = NDArray[np.float64]

MODEL = "model.yaml"
_SAME = 1e-9


@dataclass(frozen=True)
class SavedResult:
    """A fitted model with the covariance of its parameters.

    path: as given. free: the parameters with a standard error, covariance (F, F) theirs in SI
    units. correlated: whether the covariance has correlations; without result.json it is diagonal.
    command: identify or trace, empty if not known. logs: paths of the logs that it was fitted to.
    random_forces: found by trace, which are not in the model: name and parameters. names: of the
    model's effects, in the order of the file; if empty, they are named by key and location.
    """

    path: Path
    model: ModelConfig
    free: tuple[str, ...]
    covariance: Array
    correlated: bool
    command: str = ""
    logs: tuple[str, ...] = ()
    random_forces: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    names: tuple[str, ...] = ()

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors by parameter, in SI units."""
        return dict(zip(self.free, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def effects(self) -> dict[tuple[str, tuple[str, ...]], tuple[str, ModelEffect]]:
        """Name and entry of each effect of the model, by key and location."""
        names = self.names or tuple(map(_key_and_place, self.model.effects))
        effects = self.model.effects
        return {(e.effect, e.where): (name, e) for name, e in zip(names, effects, strict=True)}


def load_result(path: Path | str) -> SavedResult:
    """Load a folder that identify or trace wrote, its result.json, or a model file.

    The covariance is that of result.json beside the model if its parameters are the model's.

    Raises:
        ConfigError: there is no model file, or it is invalid.
    """
    path = Path(path)
    folder = path.parent if path.name == RESULT else path
    file = folder / MODEL if folder.is_dir() else folder
    if folder.is_dir() and not file.is_file():
        raise ConfigError(
            f"{path}: expected a result with {MODEL}, found none; levid identify writes it if "
            "there is a declared model (--model MODEL.yaml for imported data)"
        )
    model = load_model(file)
    beside = _beside(file.parent / RESULT) if file.name == MODEL else {}
    beside = beside if _same_model(beside, model) else {}
    errors = {name: p.se for name, p in model.parameters.items() if p.se}
    free, covariance = tuple(errors), np.diag(np.square(list(errors.values())))
    found = _covariance(beside, model)
    correlated = found is not None
    if found is not None:
        free, covariance = found
    logs = beside.get("logs")
    return SavedResult(
        path,
        model,
        free,
        covariance.reshape(len(free), len(free)),
        correlated,
        str(beside.get("command", "")),
        tuple(map(str, logs)) if isinstance(logs, list) else (),
        _random_forces(beside),
        _effect_names(beside, model),
    )


def _beside(path: Path) -> dict[str, Any]:
    try:
        found = read_json(path)
    except (OSError, JsonError):
        return {}
    return found if isinstance(found, dict) else {}


def _same_model(found: Mapping[str, Any], model: ModelConfig) -> bool:
    """Return whether result.json is of this model, and not of a run before or after it."""
    grey = found.get("grey_box")
    if isinstance(grey, dict) and isinstance(grey.get("parameters"), dict):
        values = {name: p.get("value") for name, p in grey["parameters"].items()}
        return values.keys() == model.parameters.keys() and all(
            value is not None and np.isclose(value, model.parameters[name].value, _SAME, 0.0)
            for name, value in values.items()
        )
    named = {
        (name, value["value"])
        for effect in found.get("effects") or []
        for name, value in effect.get("parameters", {}).items()
        if effect.get("class") != "vibration"
    }
    own = {(name, p.value) for effect in model.effects for name, p in effect.parameters.items()}
    return found.get("command") == "trace" and named <= own


def _covariance(
    found: Mapping[str, Any], model: ModelConfig
) -> tuple[tuple[str, ...], Array] | None:
    """Return parameters and their covariance in result.json, None if it has none."""
    stated = found.get("covariance") or (found.get("grey_box") or {}).get("covariance")
    if not isinstance(stated, dict):
        return None
    try:
        free = tuple(map(str, stated["parameters"]))
        matrix = np.array(stated["matrix"], np.float64)
    except (KeyError, TypeError, ValueError):
        return None
    if matrix.shape != (len(free), len(free)) or not set(free) <= set(model.parameters):
        return None
    return (free, matrix) if np.isfinite(matrix).all() else None


def _effect_names(found: Mapping[str, Any], model: ModelConfig) -> tuple[str, ...]:
    """Return the names of the effects in result.json, else their keys and locations."""
    stated = {
        (tuple(effect.get("where", ())), _values(effect.get("parameters", {}))): effect["name"]
        for effect in found.get("effects") or []
        if effect.get("class") != "vibration"
    }
    return tuple(
        stated.get(
            (e.where, frozenset((n, p.value) for n, p in e.parameters.items())), _key_and_place(e)
        )
        for e in model.effects
    )


def _values(parameters: Mapping[str, Any]) -> frozenset[tuple[str, float]]:
    return frozenset((name, value["value"]) for name, value in parameters.items())


def _key_and_place(effect: ModelEffect) -> str:
    return " ".join((effect.effect, *effect.where))


def _random_forces(found: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    return {
        str(effect["name"]): effect["parameters"]
        for effect in found.get("effects") or []
        if effect.get("class") == "vibration"
    }
