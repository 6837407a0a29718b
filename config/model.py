"""Schema of MODEL.yaml: matrices of a second-order model, parameters, effects."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from .base import Finite, NonNegative, Positive, Strict, load_yaml
from .escaping import MOST_NAME
from .units import si_slip

Identifier = Annotated[str, Field(max_length=MOST_NAME, pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
Entry = Finite | str
Matrix = tuple[tuple[Entry, ...], ...]


def _si(unit: str) -> str:
    if slip := si_slip(unit):
        raise ValueError(slip)
    return unit


SiUnit = Annotated[str, Field(max_length=MOST_NAME), AfterValidator(_si)]


class Axis(Strict):
    """A degree of freedom or an input of the model, with its unit."""

    name: Identifier
    unit: SiUnit


class ModelParameter(Strict):
    """A parameter in SI units; a `fixed` one is not fitted, `se` is the fit's standard error."""

    value: Finite
    unit: SiUnit
    min: Finite | None = None
    max: Finite | None = None
    fixed: bool = False
    prior_sd: Positive | None = None
    """Prior standard deviation of the value, before any record."""
    se: NonNegative | None = None
    about: str = ""

    @model_validator(mode="after")
    def _bounds(self) -> Self:
        low = self.value if self.min is None else self.min
        high = self.value if self.max is None else self.max
        if not low <= self.value <= high:
            raise ValueError(
                f"expected min <= value <= max, found min {low:g}, value {self.value:g} and max "
                f"{high:g}"
            )
        return self

    @property
    def is_fixed(self) -> bool:
        """Whether a fit keeps the value: `fixed` is set, or `min` equals `max`."""
        return self.fixed or (self.min is not None and self.min == self.max)


class Scheduling(Strict):
    """A scheduling variable of the matrices: a field of the log or its time derivative."""

    unit: SiUnit
    signal: str
    derivative: bool = False
    value: Finite = 0.0
    min: Finite | None = None
    max: Finite | None = None


class EffectParameter(Strict):
    """A parameter of an effect in SI units; `se` is the trace's standard error."""

    value: Finite
    unit: SiUnit
    se: NonNegative | None = None


class ModelEffect(Strict):
    """A physical effect in addition to the matrices: its name in the effects table, with values."""

    effect: str
    where: tuple[str, ...] = ()
    parameters: dict[Identifier, EffectParameter] = Field(default_factory=dict)


class ModelConfig(Strict):
    """MODEL.yaml: M(p) q'' + D(p) q' + K(p) q = B(p) u + force(p) + effects."""

    levid: Literal["model"]
    name: Annotated[str, Field(min_length=1, max_length=MOST_NAME)]
    about: str = ""
    dof: Annotated[tuple[Axis, ...], Field(min_length=1)]
    inputs: Annotated[tuple[Axis, ...], Field(min_length=1)]
    input: Literal["zoh", "foh", "band_limited"] = "zoh"
    """Input between samples: held (zoh), linear (foh), or without power above half the rate."""
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
    """Read a MODEL.yaml file; raises ConfigError."""
    return load_yaml(path, ModelConfig)
