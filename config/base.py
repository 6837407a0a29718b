"""Strict YAML configuration: an error names file, key, what was expected and what came."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

M = TypeVar("M", bound="Strict")

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class ConfigError(Exception):
    """A configuration that cannot be used; the message is one line per problem."""


class Strict(BaseModel):
    """Base of every configuration model: unknown keys are errors, instances are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


def load_yaml(path: Path | str, model: type[M]) -> M:
    """Read one YAML file into `model`.

    Raises:
        ConfigError: the file is missing, is not YAML, or does not fit; each line names file, key,
            what was expected and what came.
    """
    return parse(read_mapping(path), model, str(path))


def parse(data: object, model: type[M], where: str) -> M:
    """Fit parsed YAML `data` into `model`; `where` names the source in errors (ConfigError)."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError("\n".join(_explain(error, model, where))) from None


def parse_text(text: str | bytes, model: type[M], where: str) -> M:
    """Parse YAML `text` (say, an attachment of a log) into `model`; raises ConfigError."""
    return parse(_mapping(text, where), model, where)


def read_mapping(path: Path | str) -> dict[str, Any]:
    """Return the top-level mapping of a YAML file; raises ConfigError."""
    try:
        text = Path(path).read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    return _mapping(text, str(path))


def _mapping(text: str | bytes, where: str) -> dict[str, Any]:
    try:
        data = yaml.load(text, Loader=_UniqueKeys)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f":{mark.line + 1}:{mark.column + 1}" if mark else ""
        raise ConfigError(f"{where}{line}: not valid YAML: {error.problem}") from None
    except Exception as error:  # noqa: BLE001 - PyYAML's constructors raise whatever they meet
        raise ConfigError(f"{where}: not valid YAML: {error}".replace("\n", " ")) from None
    if not isinstance(data, dict):
        found = "nothing" if data is None else type(data).__name__
        raise ConfigError(f"{where}: expected a mapping of keys at top level, found {found}")
    return data


class _UniqueKeys(yaml.SafeLoader):
    """SafeLoader that reads 1e-4 as a number and refuses a key that stands twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key_node, _ in node.value:
            key = str(getattr(key_node, "value", ""))
            if key in seen and key != "<<":
                raise yaml.constructor.ConstructorError(
                    None, None, f"key '{key}' stands twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


# PyYAML follows YAML 1.1, where 1e-4 is text; YAML 1.2 and every engineer read a number.
_UniqueKeys.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    __import__("re").compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
    list("-+0123456789."),
)


def _explain(error: ValidationError, model: type[BaseModel], where: str) -> list[str]:
    lines = []
    items = error.errors(include_url=False)
    # A file of another kind would be one error a key: that it is another kind says it all.
    of_kind = [item for item in items if item["loc"] == ("levid",)]
    for item in of_kind or items:
        key = _dotted(item["loc"])
        if item["type"] == "extra_forbidden":
            known = _keys_at(model, item["loc"][:-1])
            lines.append(f"{where}: {key}: unknown key{_suggest(str(item['loc'][-1]), known)}")
        elif item["type"] == "missing":
            lines.append(f"{where}: {key}: required key is missing")
        elif item["type"] == "value_error":
            lines.append(f"{where}: {key}: {item['ctx']['error']}")
        else:
            expected = item["msg"].removeprefix("Input should be ")
            lines.append(f"{where}: {key}: expected {expected}, found {_short(item['input'])}")
    return lines


def _dotted(loc: tuple[int | str, ...]) -> str:
    text = ""
    for part in loc:
        text += f"[{part}]" if isinstance(part, int) else f"{'.' if text else ''}{part}"
    return text or "file"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _suggest(key: str, known: list[str]) -> str:
    if not known:
        return ""
    # The same quantity in another unit (r_mm for r_m) is the likeliest slip: compare without units.
    stem = key.rsplit("_", 1)[0]
    same_quantity = [k for k in known if k.rsplit("_", 1)[0] == stem]
    if same_quantity:
        return f"; expected '{same_quantity[0]}' (the ending of a key is its unit)"
    close = difflib.get_close_matches(key, known, n=1)
    if close:
        return f"; expected '{close[0]}'"
    return f"; expected one of {', '.join(sorted(known))}"


def _keys_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys known at `loc`, following model fields; empty where that cannot be told."""
    current: Any = model
    for part in loc:
        if isinstance(part, int):
            continue
        field = getattr(current, "model_fields", {}).get(part)
        if field is None:
            continue
        current = _model_in(field.annotation) or current
    return [f.alias or name for name, f in getattr(current, "model_fields", {}).items()]


def _model_in(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        found = _model_in(argument)
        if found is not None:
            return found
    return None
