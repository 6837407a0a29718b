"""Read YAML configuration files strictly, with limits on size and errors that name file and key."""

from __future__ import annotations

import os
import re
import select
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from .error_messages import dotted, mistakes, quoted, shortened
from .escaping import steering_character
from .files.reading import kind_of
from .shipped import KINDS, not_found

M = TypeVar("M", bound="Strict")
_Path: TypeAlias = "tuple[_Path, Any] | None"

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


MOST_BYTES = 1 << 18
"""Largest file in bytes, and most characters of text in it; the largest shipped file has 6 KiB."""
PIPE_WAIT_S = 10.0
"""Longest wait for the end of a pipe."""
MOST_NODES = 30_000
"""Most keys, values, lists and mappings in a file. A file of MOST_BYTES in the style of the shipped
files has about as many; PyYAML takes about 1 s to read them."""
MOST_DEPTH = 32
"""Most levels of lists and mappings; shipped files have 6."""
MOST_DIGITS = 64
"""Longest number in characters. Longer text stays text: its conversion takes quadratic time."""
MOST_KEY = 200
"""Longest key in characters. Every message about a value below a key contains the key."""
MOST_TEXT = 4096
"""Longest text of one line in characters: a path is no longer."""
SEVERAL_LINES = ("about", "column")
"""Keys whose text may have line breaks and any characters: a description, a header in a file."""
_MOST_PROBLEM = 300
"""Longest text of a YAML error in characters; it may quote the file."""
_YAML_PROBLEMS = {
    "found character '\\t' that cannot start any token": "expected spaces, found a tab",
    "that cannot start any token": "at the start of a value: put the value in quotes",
    "mapping values are not allowed here": "': ' is not allowed here: check the indentation, or "
    "put text that contains ': ' in quotes",
    "could not find expected ':'": "expected ':' after a key",
    "found unexpected end of stream": "expected a closing quotation mark, found the file's end",
    "but got": "found",
    "but found": "found",
    "'<stream end>'": "the end of the file",
    "<document start>": "the start of the file",
    "<block end>": "the indentation of the lines above",
    "'<block sequence start>'": "a list entry",
    "'<block mapping start>'": "a mapping",
    "'<scalar>'": "text",
    "the node content": "a value",
    "in the stream": "in the file",
}
"""Replacements for terms of the YAML parser in its messages, in this order."""


class ConfigError(Exception):
    """A configuration file is wrong; the message has one line per mistake."""


class Strict(BaseModel):
    """Base of every configuration schema: unknown keys are errors, instances are frozen.

    A number may not be given as text or as true and false.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)

    @field_validator("*", mode="before")
    @classmethod
    def _only_numbers_for_a_number(cls, value: object, info: ValidationInfo) -> object:
        field = cls.model_fields[str(info.field_name)]
        types = set(_types(field.annotation))
        if types & {int, float}:
            words = any(isinstance(kind, str) for kind in types)  # of a Literal
            kinds = tuple({bool, str} - types - ({str} if words else set()))
            # Digits that are too many for a number in YAML get an error that says so.
            others = [x for x in _instances(value, kinds) if len(str(x)) <= MOST_DIGITS]
            if others:
                raise ValueError(f"expected a number, found {quoted(others[0])}")
        return value


def load_yaml(path: Path | str, model: type[M]) -> M:
    """Read one YAML file into `model`.

    Raises:
        ConfigError: the file is missing, is not YAML, or does not fit the schema; each line names
            the file, the key, what is expected and what is found.
    """
    return parse(read_mapping(path, *_kinds(model)), model, str(path))


def _kinds(model: type[Strict]) -> tuple[str, ...]:
    """Return the kind of shipped files that a schema reads; empty for a schema of another file."""
    field = model.model_fields.get("levid")
    named = () if field is None else _types(field.annotation)
    return tuple(kind for kind in KINDS if kind in named)


def parse(data: object, model: type[M], where: str) -> M:
    """Validate `data` (lists, mappings, scalars) as `model`; `where` names the source in errors.

    Raises:
        ConfigError: `data` exceeds a limit or does not fit the schema.
    """
    check_limits(data, where)
    try:
        found = model.model_validate(data)
    except ValidationError as error:
        raise ConfigError("\n".join(mistakes(error, data, model, where))) from None
    check_lines(data, None, where)
    return found


def check_lines(data: object, path: _Path, where: str) -> None:
    """Check that texts in `data` are lines that print, as a name, path or unit has to be.

    Raises:
        ConfigError: a text outside SEVERAL_LINES is longer than MOST_TEXT, or has a line break or
            another character that steers a terminal.
    """
    if isinstance(data, Mapping):
        for key, inner in data.items():
            check_lines(key, path, where)
            if key not in SEVERAL_LINES:
                check_lines(inner, (path, key), where)
    elif isinstance(data, (list, tuple)):
        for at, inner in enumerate(data):
            check_lines(inner, (path, at), where)
    elif isinstance(data, str):
        if len(data) > MOST_TEXT:
            expected = f"at most {MOST_TEXT} characters"
        elif steering_character(data):
            expected = "one line without control characters"
        else:
            return
        place = dotted(_parts(path))
        raise ConfigError(f"{where}: {place}: expected {expected}, found {quoted(data)}")


def check_limits(data: object, where: str) -> None:
    """Check that `data` is within the limits of a YAML file, in linear time.

    Raises:
        ConfigError: too many values, levels or characters, a key or a number that is too long, or
            text with half a surrogate pair.
    """
    nodes = characters = 0
    stack: list[tuple[object, int, _Path]] = [(data, 0, None)]
    while stack:
        value, depth, path = stack.pop()
        nodes += 1
        problem = None
        if isinstance(value, (Mapping, list, tuple, set, frozenset)):
            depth += 1
            problem = _excess(nodes + len(stack) + len(value), characters, depth)
            if not problem and isinstance(value, Mapping):
                problem = _long_key(value)
                stack += [(inner, depth, (path, key)) for key, inner in value.items()]
                stack += [(key, depth, path) for key in value]
            elif not problem:
                stack += [(inner, depth, (path, at)) for at, inner in enumerate(value)]
        elif isinstance(value, (str, bytes)):
            characters += len(value)
            problem = _excess(nodes, characters, depth)
            if not problem and isinstance(value, str) and not _is_unicode(value):
                problem = f"expected Unicode text, found {quoted(value)}"
            elif not problem and isinstance(value, str) and "\0" in value:
                # No path, name or address may hold one: it would fail when it is used.
                problem = f"expected text without zero characters, found {quoted(value)}"
        elif isinstance(value, int) and value.bit_length() > 4 * MOST_DIGITS:
            problem = f"expected an integer of at most {MOST_DIGITS} digits, found {quoted(value)}"
        if problem:
            raise ConfigError(f"{where}: {dotted(_parts(path))}: {problem}")


def parse_text(text: str | bytes, model: type[M], where: str) -> M:
    """Parse YAML `text`, such as an attachment of a log, as `model`; raises ConfigError."""
    return parse(mapping_of(text, where), model, where)


def read_mapping(path: Path | str, *kinds: str) -> dict[str, Any]:
    """Return the top-level mapping of a YAML file; raises ConfigError.

    The error of a missing file suggests shipped files of `kinds`; default: of every kind.

    A pipe such as /dev/stdin is read to its end, if that comes within PIPE_WAIT_S.
    """
    try:
        text = _text(Path(path))
    except TimeoutError:
        raise ConfigError(
            f"{path}: expected a file, or a pipe that ends within {PIPE_WAIT_S:g} s, found one "
            "without an end"
        ) from None
    except FileNotFoundError as error:
        hint = not_found(path, *kinds)
        raise ConfigError(f"{path}: cannot be read: {error.strerror}{hint}") from None
    except OSError as error:
        found = kind_of(path)
        if found in ("a folder", "a socket", "a device"):
            raise ConfigError(f"{path}: expected a file, found {found}") from None
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:  # an invalid file name
        raise ConfigError(f"{str(path)!r}: cannot be read: {error}") from None
    return mapping_of(text, str(path))


def _text(path: Path) -> bytes:
    """Return the first MOST_BYTES and one more; raises OSError, TimeoutError."""
    # A pipe that nobody writes to would wait to be opened.
    opened = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(opened, "rb", buffering=0) as file:
        text, until = b"", time.monotonic() + PIPE_WAIT_S
        while len(text) <= MOST_BYTES:
            ready, _, _ = select.select([file], [], [], max(until - time.monotonic(), 0.0))
            if not ready:
                raise TimeoutError
            part = file.read(MOST_BYTES + 1 - len(text))
            if not part:
                break
            text += part
    return text


def mapping_of(text: str | bytes, where: str) -> dict[str, Any]:
    """Return the top-level mapping of YAML `text`; raises ConfigError."""
    if len(text) > MOST_BYTES:
        raise ConfigError(f"{where}: expected a file of at most {MOST_BYTES >> 10} KiB, found more")
    try:
        data = yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f":{mark.line + 1}:{mark.column + 1}" if mark else ""
        problem = shortened(str(error.problem), _MOST_PROBLEM)
        if isinstance(error, yaml.composer.ComposerError) and error.context:
            problem = f"{shortened(error.context, _MOST_PROBLEM)}, {problem}"
        if not isinstance(error, _LimitError):
            for term, words in _YAML_PROBLEMS.items():
                problem = problem.replace(term, words)
            problem = f"not valid YAML: {problem}"
        raise ConfigError(f"{where}{line}: {problem}") from None
    except yaml.reader.ReaderError as error:
        raise ConfigError(
            f"{where}: not valid YAML: expected text in UTF-8 without control characters, found "
            f"#x{error.character:02x} at position {error.position + 1}"
        ) from None
    except Exception as error:  # noqa: BLE001 - any other error of PyYAML: the file is wrong too
        raise ConfigError(
            f"{where}: not valid YAML: {shortened(str(error), _MOST_PROBLEM)}"
        ) from None
    if not isinstance(data, dict):
        found = "an empty file" if data is None else quoted(data)
        raise ConfigError(f"{where}: expected 'key: value' lines at top level, found {found}")
    return data


class _LimitError(yaml.MarkedYAMLError):
    """The file is valid YAML but exceeds a limit or uses a feature that is not accepted."""

    def __init__(self, problem: str, mark: Any) -> None:
        super().__init__(None, None, problem, mark)


class _Loader(yaml.SafeLoader):
    """Read YAML as SafeLoader does, in time proportional to the size of the file.

    1e-4 is a number, yes and 2024-05-01 are text, as in YAML 1.2. What YAML 1.1, YAML 1.2 or Python
    takes for a number, but not all for the same one, is an error: 020, 0x20, 16:40, 1_000.
    Duplicate keys, keys that are lists or mappings, and tags other than those of YAML 1.2's core
    schema are errors. A scalar longer than MOST_DIGITS is text. Nodes, characters and levels are
    counted during reading; those of an alias count at each use.
    """

    def __init__(self, stream: str | bytes) -> None:
        super().__init__(stream)
        self._nodes = self._characters = self._depth = 0
        self._deepest = 0  # deepest level since the start of the current node
        self._sizes: dict[str, tuple[int, int, int]] = {}  # by anchor: nodes, characters, levels

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.AliasEvent):
            alias = super().compose_node(parent, index)
            if event.anchor not in self._sizes:
                raise _LimitError("an alias refers to the value that contains it", event.start_mark)
            self._count(*self._sizes[event.anchor], event.start_mark)
            return alias
        nodes, characters, deepest = self._nodes, self._characters, self._deepest
        self._deepest = self._depth
        if isinstance(event, yaml.ScalarEvent):
            self._check_tag(event.tag, _SCALAR_TAGS, event.start_mark)
            plain = event.implicit[0] or event.tag in (f"{_TAG}int", f"{_TAG}float")
            short = len(event.value) <= MOST_DIGITS
            if plain and short and _NUMBER_ELSEWHERE.fullmatch(event.value):
                raise _LimitError(
                    f"expected a decimal number such as 20, or text in quotes, found {event.value}",
                    event.start_mark,
                )
            self._count(1, len(event.value), 0, event.start_mark)
            node = super().compose_node(parent, index)
        else:
            self._check_tag(event.tag, _COLLECTION_TAGS[type(event)], event.start_mark)
            self._count(1, 0, 1, event.start_mark)
            self._depth += 1
            node = super().compose_node(parent, index)
            self._depth -= 1
        if event.anchor is not None:
            self._sizes[event.anchor] = (
                self._nodes - nodes,
                self._characters - characters,
                self._deepest - self._depth,
            )
        self._deepest = max(deepest, self._deepest)
        return node

    def _count(self, nodes: int, characters: int, levels: int, mark: Any) -> None:
        self._nodes += nodes
        self._characters += characters
        self._deepest = max(self._deepest, self._depth + levels)
        if problem := _excess(self._nodes, self._characters, self._depth + levels):
            raise _LimitError(problem, mark)

    def _check_tag(self, tag: str | None, known: set[str | None], mark: Any) -> None:
        if tag not in known:
            written = str(tag).replace(_TAG, "!!")
            raise _LimitError(f"expected no tag, found {quoted(written)}", mark)

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        # Check for duplicates before keys are merged: a mapping may override merged keys.
        node: yaml.MappingNode = super().compose_mapping_node(anchor)
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                kind = "list" if isinstance(key, yaml.SequenceNode) else "mapping"
                raise _LimitError(f"expected a key that is text, found a {kind}", key.start_mark)
            if key.value in seen and key.tag != f"{_TAG}merge":
                raise _LimitError(f"duplicate key {quoted(key.value)}", key.start_mark)
            seen.add(key.value)
        return node

    def fetch_more_tokens(self) -> None:
        try:
            super().fetch_more_tokens()
        except (ValueError, OverflowError):  # of chr() or int()
            raise _LimitError(
                "not valid YAML: expected a character code (after \\x, \\u or \\U) or a version "
                "(after %YAML) within its range, found a larger number",
                self.get_mark(),
            ) from None

    def resolve(self, kind: type[yaml.Node], value: Any, implicit: Any) -> str:
        if kind is yaml.ScalarNode and len(value) > MOST_DIGITS:
            return str(self.DEFAULT_SCALAR_TAG)
        return str(super().resolve(kind, value, implicit))  # type: ignore[no-untyped-call]

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        if node.tag == f"{_TAG}merge":  # << as a value is text
            node.tag = self.DEFAULT_SCALAR_TAG
        expected = _CONVERTED.get(node.tag)
        if not expected:
            return super().construct_object(node, deep=deep)
        try:
            if len(node.value) > MOST_DIGITS:
                raise ValueError
            return super().construct_object(node, deep=deep)
        except (ValueError, LookupError):
            raise _LimitError(
                f"expected {expected} of at most {MOST_DIGITS} characters, found "
                f"{quoted(node.value)}",
                node.start_mark,
            ) from None


_TAG = "tag:yaml.org,2002:"
_SCALAR_TAGS = {None, "!", *(f"{_TAG}{kind}" for kind in ("str", "int", "float", "bool", "null"))}
_COLLECTION_TAGS = {
    yaml.SequenceStartEvent: {None, "!", f"{_TAG}seq"},
    yaml.MappingStartEvent: {None, "!", f"{_TAG}map"},
}
_CONVERTED = {
    f"{_TAG}int": "an integer",
    f"{_TAG}float": "a number",
    f"{_TAG}bool": "true or false",
}
"""Tags of values that are converted from text, and the expected text."""
_NUMBER_ELSEWHERE = re.compile(
    r"[-+]?0[0-9_]+|[-+]?0[xX][0-9a-fA-F_]+|[-+]?0[oO][0-7_]+|[-+]?0[bB][01_]+"
    r"|[-+]?[0-9][0-9_]*(:[0-5]?[0-9])+(\.[0-9_]*)?"  # base 60
    r"|[-+]?(?=[0-9.]+_)[0-9][0-9_]*(\.[0-9_]*)?([eE][-+]?[0-9]+)?|[-+]?\.(?=[0-9]+_)[0-9_]+"
)
"""What YAML 1.1, YAML 1.2 or Python takes for a number, but not all of them for the same one."""
_RESOLVED = {f"{_TAG}{kind}" for kind in ("null", "merge")}
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag in _RESOLVED]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
# The rest as in the core schema of YAML 1.2.
_Loader.add_implicit_resolver(
    f"{_TAG}bool", re.compile(r"(true|True|TRUE|false|False|FALSE)$"), list("tTfF")
)
_Loader.add_implicit_resolver(
    f"{_TAG}int", re.compile(r"[-+]?(0|[1-9][0-9]*)$"), list("-+0123456789")
)
_Loader.add_implicit_resolver(
    f"{_TAG}float",
    re.compile(
        r"([-+]?([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?[0-9]+[eE][-+]?[0-9]+"
        r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN))$"
    ),
    list("-+0123456789."),
)


def _excess(nodes: int, characters: int, depth: int) -> str | None:
    """Return a message if a limit is exceeded, else None."""
    if depth > MOST_DEPTH:
        return f"expected at most {MOST_DEPTH} levels of lists and mappings, found more"
    if nodes > MOST_NODES:
        return (
            f"expected at most {MOST_NODES} keys and values, found more (an alias counts at each "
            "use)"
        )
    if characters > MOST_BYTES:
        return (
            f"expected at most {MOST_BYTES} characters of text, found more (an alias counts at "
            "each use)"
        )
    return None


def _long_key(mapping: Mapping[Any, Any]) -> str | None:
    """Return a message about the first key that is too long, None if there is none."""
    for key in mapping:
        if isinstance(key, (str, bytes)) and len(key) > MOST_KEY:
            return f"expected keys of at most {MOST_KEY} characters, found {quoted(key)}"
    return None


def _is_unicode(text: str) -> bool:
    """Return whether UTF-8 can encode the text; half a surrogate pair cannot be encoded."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _parts(path: _Path) -> list[Any]:
    """Return the keys and indices of a path, outermost first."""
    parts = []
    while path is not None:
        path, part = path
        parts.append(part)
    return parts[::-1]


def _types(annotation: Any) -> list[Any]:
    """Return the types in an annotation, those of nested annotations included."""
    parts = getattr(annotation, "__args__", ())
    return [kind for part in parts for kind in _types(part)] if parts else [annotation]


def _instances(value: object, kinds: tuple[type, ...]) -> list[object]:
    """Return what is of some types in a value, entries of nested lists and mappings included."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, (list, tuple)):
        return [inner for part in value for inner in _instances(part, kinds)]
    return [value] if isinstance(value, kinds) else []
