"""Hold a model: its parameters with standard errors and 95 % intervals, and its effects."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from ..config.escaping import html_text
from ..config.files.atomic_write import write_file
from ..config.files.folders import make_folder
from ..identification.records.record import IdentificationError
from ..identification.value_with_interval import value_with_interval
from .html_table import Table

if TYPE_CHECKING:
    from ..config.model import ModelConfig
    from .identification import Identification
    from .trace import Trace

ModelSource: TypeAlias = "str | Path | Model | Identification | Trace"
"""What names a model: the path of a MODEL.yaml or the name of a shipped one, a model, or a result
that has one."""


class ArgumentError(IdentificationError):
    """A missing or wrong argument; `{}` in `text` stands for it, as it is written by the caller."""

    def __init__(self, text: str, name: str, value: str = "") -> None:
        self.text, self.name, self.value = text, name, value
        super().__init__(text.replace("{}", f"{name}={value}" if value else name))

    @property
    def of_option(self) -> str:
        """The message for users of the command line."""
        return self.text.replace("{}", f"--{self.name} {self.value}".rstrip())


@dataclass(frozen=True)
class Parameter:
    """A number with its standard error in the same unit; `se` is None if it is unknown.

    `declared`: the value before the fit, None without one.
    """

    name: str
    value: float
    se: float | None
    unit: str
    declared: float | None = None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval (low, high); None without a standard error."""
        if self.se is None:
            return None
        from ..identification.subspace.response_uncertainty import SURE_95

        half = SURE_95 * self.se
        return self.value - half, self.value + half

    def __float__(self) -> float:
        return self.value

    def __str__(self) -> str:
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        return f"{self.name} = {value_with_interval(self.value, self.se, '±')}{unit}"


class Parameters(Mapping[str, Parameter]):
    """Parameters by name; displays as a table."""

    def __init__(self, parameters: Mapping[str, Parameter]) -> None:
        self._parameters = dict(parameters)

    def __getitem__(self, name: str) -> Parameter:
        try:
            return self._parameters[name]
        except KeyError:
            known = ", ".join(self._parameters) or "none"
            raise KeyError(f"expected one of the parameters {known}; found {name!r}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._parameters)

    def __len__(self) -> int:
        return len(self._parameters)

    def __repr__(self) -> str:
        return "\n".join(map(str, self.values())) or "no parameters"

    def _repr_html_(self) -> str:
        return self.table().html()

    def table(self) -> Table:
        """Return name, value, 95 % interval, unit and declared value of each parameter."""
        declared = any(p.declared is not None for p in self.values())
        rows = [
            (
                p.name,
                value_with_interval(p.value, p.se, "±"),
                "" if p.unit == "1" else p.unit,
                *([] if not declared else [_declared(p.declared)]),
            )
            for p in self.values()
        ]
        head = ("parameter", "value, 95 % interval", "unit", *(["declared"] if declared else []))
        return Table(head, rows)


def _declared(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


@dataclass(frozen=True)
class Model:
    """A declared or fitted model: what a MODEL.yaml contains.

    `effects`: keys and places of its effects, such as "rod_stiffness.cubic at z".
    """

    name: str
    parameters: Parameters
    effects: tuple[str, ...]
    config: ModelConfig = field(repr=False)
    """The model file as parsed; not a part of the stable API."""

    def to_yaml(self) -> str:
        """Return the text of the MODEL.yaml."""
        from ..identification.greybox.identify_greybox import to_yaml

        return to_yaml(self.config)

    def save(self, path: str | Path) -> Path:
        """Write the MODEL.yaml to `path` and return the path.

        Commands and `levid.load(..., model=path)` read it.
        """
        path = Path(path)
        make_folder(path.parent)
        write_file(path, self.to_yaml())
        return path

    def __repr__(self) -> str:
        lines = [f"Model {self.name}", *(f"  {p}" for p in self.parameters.values())]
        return "\n".join([*lines, *(f"  effect: {effect}" for effect in self.effects)])

    def _repr_html_(self) -> str:
        effects = "".join(f"<p>effect: {html_text(e)}</p>" for e in self.effects)
        return (
            f"<p><b>Model {html_text(self.name)}</b></p>{self.parameters.table().html()}{effects}"
        )


def model_of_config(config: ModelConfig, declared: ModelConfig | None = None) -> Model:
    """Return the model of a parsed MODEL.yaml; `declared` gives the values before the fit."""
    before = {} if declared is None else declared.parameters
    parameters = {
        name: Parameter(
            name,
            p.value,
            p.se if p.se is None or math.isfinite(p.se) else None,
            p.unit,
            before[name].value if name in before else None,
        )
        for name, p in config.parameters.items()
    }
    effects = tuple(" at ".join([e.effect, ", ".join(e.where)]) for e in config.effects)
    return Model(config.name, Parameters(parameters), effects, config)


def model_config(source: ModelSource | None) -> tuple[ModelConfig | None, Path | None]:
    """Return the parsed model of a source, and its file if it is one; None without a source.

    Raises:
        ConfigError: the file is not a valid MODEL.yaml.
        IdentificationError: the result has no fitted model.
    """
    if source is None:
        return None, None
    if isinstance(source, str | Path):
        from ..config.model import load_model
        from ..config.shipped import find_file

        path = find_file(source, "model")
        return load_model(path), path
    model = source if isinstance(source, Model) else source.model
    return model.config, None
