"""Strict YAML configuration: an error names file, key, what was expected and what came."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from .mistakes import mistakes

M = TypeVar("M", bound="Strict")

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


MOST_BYTES = 1 << 18
"""Of a file: the longest that are shipped have a fortieth of it, and YAML is slow to read."""
MOST_NODES = 50_000
"""Keys and values of a file, an alias counted as often as it is used."""
MOST_DIGITS = 40
"""Of an integer; converting takes time that grows with the square of them."""


class ConfigError(Exception):
    """A configuration that cannot be used; the message is one line per problem."""


class Strict(BaseModel):
    """Base of every configuration model: unknown keys are errors, instances are frozen.

    A number is a number: YAML's yes and on, which Python counts as 1, are refused for one.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)

    @field_validator("*", mode="before")
    @classmethod
    def _no_truth_for_a_number(cls, value: object, info: ValidationInfo) -> object:
        field = cls.model_fields[str(info.field_name)]
        kinds = set(_kinds(field.annotation))
        if kinds & {int, float} and bool not in kinds and (truths := _truths(value)):
            raise ValueError(
                f"expected a number, found {truths[0]}; yes, no, on and off are no numbers"
            )
        return value


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
        raise ConfigError("\n".join(mistakes(error, data, model, where))) from None


def parse_text(text: str | bytes, model: type[M], where: str) -> M:
    """Parse YAML `text` (say, an attachment of a log) into `model`; raises ConfigError."""
    return parse(_mapping(text, where), model, where)


def read_mapping(path: Path | str) -> dict[str, Any]:
    """Return the top-level mapping of a YAML file; raises ConfigError."""
    try:
        with Path(path).open("rb") as file:
            text = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:  # a name that no file can have
        raise ConfigError(f"{str(path)!r}: cannot be read: {error}") from None
    return _mapping(text, str(path))


def _mapping(text: str | bytes, where: str) -> dict[str, Any]:
    if len(text) > MOST_BYTES:
        raise ConfigError(f"{where}: expected a file of at most {MOST_BYTES >> 10} KiB, found more")
    try:
        data = yaml.load(text, Loader=_UniqueKeys)
    except RecursionError:
        raise ConfigError(f"{where}: not valid YAML: nested too deeply") from None
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
    """SafeLoader that reads 1e-4 as a number and refuses a key that stands twice.

    It refuses as well what would take time or memory out of all proportion to the file: aliases of
    aliases, and integers of thousands of digits.
    """

    def get_single_node(self) -> yaml.Node | None:
        node: yaml.Node | None = super().get_single_node()
        if node is not None:
            _expanded(node, {})
        return node

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        if len(node.value) > MOST_DIGITS:
            raise yaml.constructor.ConstructorError(
                None,
                None,
                f"expected an integer of at most {MOST_DIGITS} digits, found {len(node.value)}",
                node.start_mark,
            )
        return int(super().construct_yaml_int(node))

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


_UniqueKeys.add_constructor("tag:yaml.org,2002:int", _UniqueKeys.construct_yaml_int)
# PyYAML follows YAML 1.1, where 1e-4 is text; YAML 1.2 and every engineer read a number.
_UniqueKeys.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    __import__("re").compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
    list("-+0123456789."),
)


def _expanded(node: yaml.Node, known: dict[int, int]) -> int:
    """Return how many nodes a node stands for with all its aliases; too many are an error."""
    if id(node) in known:
        if not known[id(node)]:  # still being counted: it stands within itself
            raise yaml.composer.ComposerError(
                None, None, "an alias stands within what it names", node.start_mark
            )
        return known[id(node)]
    known[id(node)] = 0
    total = 1
    if isinstance(node, yaml.MappingNode):
        total += sum(_expanded(part, known) for pair in node.value for part in pair)
    elif isinstance(node, yaml.SequenceNode):
        total += sum(_expanded(part, known) for part in node.value)
    if total > MOST_NODES:
        raise yaml.composer.ComposerError(
            None,
            None,
            f"expected at most {MOST_NODES} keys and values, found more, aliases counted as often "
            "as they are used",
            node.start_mark,
        )
    known[id(node)] = total
    return total


def _kinds(annotation: Any) -> list[Any]:
    """Return the types that an annotation is made of."""
    parts = getattr(annotation, "__args__", ())
    return [kind for part in parts for kind in _kinds(part)] if parts else [annotation]


def _truths(value: object) -> list[bool]:
    """Return the bools in a value, its lists and its mappings."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, (list, tuple)):
        return [truth for part in value for truth in _truths(part)]
    return [value] if isinstance(value, bool) else []
