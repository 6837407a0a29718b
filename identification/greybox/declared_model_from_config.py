"""Build the declared model from MODEL.yaml."""

from __future__ import annotations

from ...config.model import ModelConfig
from ...model.declared_model import DeclaredModel


def declared_model(config: ModelConfig) -> DeclaredModel:
    """Return the model that `config` describes; raises ModelError for contradictions in it."""
    matrices = {name: getattr(config, name) for name in ("M", "D", "K", "B")}
    return DeclaredModel.build(
        [axis.name for axis in config.dof],
        [axis.name for axis in config.inputs],
        {name: parameter.value for name, parameter in config.parameters.items()},
        {name: variable.value for name, variable in config.scheduling.items()},
        {name: rows for name, rows in matrices.items() if rows is not None},
        config.force,
        config.lag_s,
        config.delay_s,
    )
