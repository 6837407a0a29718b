"""The declared model: named matrices, parameters with units and bounds; MODEL.yaml in types."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from .base import Finite, NonNegative, Positive, Strict, load_yaml

Identifier = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
Entry = Finite | str
Matrix = tuple[tuple[Entry, ...], ...]


class Axis(Strict):
    """A named axis of the model with its unit."""

    name: Identifier
    unit: str


class ModelParameter(Strict):
    """A parameter in SI units; `fixed` ones are never fitted, `se` is a result of a fit."""

    value: Finite
    unit: str
    min: Finite | None = None
    max: Finite | None = None
    fixed: bool = False
    prior_sd: Positive | None = None
    """Standard deviation of what is known of the value before any record."""
    se: NonNegative | None = None
    about: str = ""

    @model_validator(mode="after")
    def _bounds(self) -> Self:
        low = self.value if self.min is None else self.min
        high = self.value if self.max is None else self.max
        if not low <= self.value <= high:
            raise ValueError(f"expected min <= value <= max, found {low}, {self.value}, {high}")
        return self

    @property
    def is_fixed(self) -> bool:
        """Whether no fit may change the value: `fixed`, or bounds that leave no other."""
        return self.fixed or (self.min is not None and self.min == self.max)


class Scheduling(Strict):
    """A variable of the matrices, measured by a field of the log or by its derivative."""

    unit: str
    signal: str
    derivative: bool = False
    value: Finite = 0.0
    min: Finite | None = None
    max: Finite | None = None


class EffectParameter(Strict):
    """A parameter of an effect in SI units; `se` is a result of a trace."""

    value: Finite
    unit: str
    se: NonNegative | None = None


class ModelEffect(Strict):
    """A physical effect beyond the matrices: an entry of the table of effects, with values."""

    effect: str
    where: tuple[str, ...] = ()
    parameters: dict[Identifier, EffectParameter] = Field(default_factory=dict)


class ModelConfig(Strict):
    """MODEL.yaml: M(p) q'' + D(p) q' + K(p) q = B(p) u + force(p) + effects, in formulas."""

    levid: Literal["model"]
    name: str
    about: str = ""
    dof: Annotated[tuple[Axis, ...], Field(min_length=1)]
    inputs: Annotated[tuple[Axis, ...], Field(min_length=1)]
    input: Literal["zoh", "foh", "band_limited"] = "zoh"
    """What the input does between samples."""
    parameters: dict[Identifier, ModelParameter] = Field(default_factory=dict)
    scheduling: dict[Identifier, Scheduling] = Field(default_factory=dict)
    M: Matrix
    D: Matrix
    K: Matrix
    B: Matrix | None = None
    force: tuple[Entry, ...] = ()
    lag_s: Entry = 0.0
    delay_s: Entry = 0.0
    effects: tuple[ModelEffect, ...] = ()


def load_model(path: Path | str) -> ModelConfig:
    """Read MODEL.yaml; raises ConfigError."""
    return load_yaml(path, ModelConfig)
