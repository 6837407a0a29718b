"""Every text of every YAML file is one line that prints, or free text that is shown escaped."""

from __future__ import annotations

from typing import Any

import pytest
from hostile_text import PRINTABLE, STEERING, check_printed
from schema_samples import SCHEMAS, Path, Sample, at, changed, paths

from levid.config.base import SEVERAL_LINES, ConfigError, Strict, check_lines, parse


def mistake(data: object, kind: type[Strict]) -> str:
    """Return the error of a file, empty if it is read."""
    try:
        parse(data, kind, "FILE")
    except ConfigError as error:
        return str(error)
    return ""


def new_mistake(data: object, kind: type[Strict], before: str) -> str:
    """Return the error that a sample has beside those of `before`, as keys exclude each other."""
    found = mistake(data, kind)
    if found != before:
        return found
    try:
        check_lines(data, None, "FILE")
    except ConfigError as error:
        return str(error)
    return ""


def with_key(data: Any, path: Path, name: str) -> Any:
    """Return the data in which the key at a path has another name."""
    inner = at(data, path[:-1])
    return changed(data, path[:-1], {name if k == path[-1] else k: v for k, v in inner.items()})


def hostile(value: object, texts: dict[str, str]) -> list[tuple[str, str]]:
    """Return the texts to try in place of a value: all for a text, one for what takes none."""
    return list(texts.items())[: None if isinstance(value, str) else 1]


def free(path: Path) -> bool:
    return bool(path) and path[-1] in SEVERAL_LINES


@pytest.mark.parametrize("name", SCHEMAS)
def test_text_that_steers_a_terminal_is_refused_in_words_that_do_not(name: str) -> None:
    sample = Sample(SCHEMAS[name]).data
    before = mistake(sample, SCHEMAS[name])
    for path in paths(sample):
        if not path:
            continue
        for what, text in hostile(at(sample, path), STEERING):
            texts = [with_key(sample, path, text)] if isinstance(path[-1], str) else []
            texts += [] if free(path) else [changed(sample, path, text)]
            for data in texts:
                found = new_mistake(data, SCHEMAS[name], before)
                assert found, (path, what)
                check_printed(found)
                assert all(line.startswith("FILE: ") for line in found.splitlines()), found


@pytest.mark.parametrize("name", SCHEMAS)
def test_text_that_means_something_elsewhere_is_text(name: str) -> None:
    sample = Sample(SCHEMAS[name]).data
    for path in paths(sample):
        for _, text in hostile(at(sample, path), PRINTABLE):
            if path:
                check_printed(mistake(changed(sample, path, text), SCHEMAS[name]))


@pytest.mark.parametrize("name", SCHEMAS)
def test_names_have_a_length_that_a_file_system_takes(name: str) -> None:
    sample = Sample(SCHEMAS[name]).data
    before = mistake(sample, SCHEMAS[name])
    for path in paths(sample):
        if path and isinstance(at(sample, path), str):
            found = new_mistake(changed(sample, path, "a" * 20_000), SCHEMAS[name], before)
            assert (found == "") == free(path), (path, found)
