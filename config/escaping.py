"""Escape text of files and devices for the language that it is written into, one function each.

Terminal and log: `one_line` and `visible`; shell: `shell_word`; HTML: `html_text`; text elements
of SVG: `svg_texts`; systemd: `systemd_text`, `systemd_word`, `systemd_name`; udev: `udev_name`.
JSON, YAML and XML are written by their libraries, which escape what they write.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable
from pathlib import PurePath
from typing import Any, TextIO, cast

MOST_NAME = 100
"""Longest name in characters: a name becomes part of a file name, which has at most 255 bytes."""
_STEERING = re.compile(
    "[\x00-\x1f\x7f-\x9f"  # control characters: cursor, colours, title of a terminal
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # direction of writing: reorders a line
    "\u2028\u2029"  # line breaks
    "\ufff9-\ufffb\U000e0000-\U000e007f"  # invisible annotations and tags
    "\ud800-\udfff]"  # half a surrogate pair: no encoding
)
_KEPT = " \n\t"
_SAFE_IN_SHELL = re.compile(r"[A-Za-z0-9_@%+:,./][A-Za-z0-9_@%+=:,./-]*")
_SAFE_IN_UNIT = re.compile(r"[A-Za-z0-9_@+=:,./%-]+")
_SAFE_IN_UNIT_NAME = re.compile(r"[A-Za-z0-9:_.]")
_DEVICE_NAME = re.compile(r"[A-Za-z0-9_.:=@#+-]+")
_ENTITIES = {ord('"'): "&quot;", ord("#"): "&#35;"}


class EscapingError(ValueError):
    """A text cannot be written in a language, however it is escaped."""


def steering_character(text: str) -> str | None:
    """Return the first character that steers a terminal, breaks or reorders a line; else None."""
    found = _STEERING.search(text)
    return found[0] if found else None


def one_line(text: str) -> str:
    """Return text with every character that does not print as its escape, such as \\n or \\x1b."""
    return text if text.isprintable() else "".join(map(_printable, text))


def visible(text: str) -> str:
    """Return text as `one_line` does, but keep its line breaks, tabs and spaces of all widths."""
    if text.isprintable():
        return text
    return "".join(
        c if c in _KEPT or (c.isspace() and not _STEERING.match(c)) else _printable(c) for c in text
    )


def _printable(character: str) -> str:
    return character if character.isprintable() else repr(character)[1:-1]


class VisibleOutput:
    """A text stream that writes `visible` text only to another one, such as stdout of a command."""

    def __init__(self, raw: TextIO) -> None:
        self.raw = raw
        """The stream that takes control characters as they are, which move a cursor."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self.raw, name)

    def write(self, text: str) -> int:
        """Write a text; return the number of its characters."""
        self.raw.write(visible(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write several texts."""
        for line in lines:
            self.write(line)


def visible_output(stream: TextIO) -> TextIO:
    """Return a stream that writes `visible` text to this one, in an encoding or as escapes."""
    if isinstance(stream, VisibleOutput):
        return stream
    if isinstance(stream, io.TextIOWrapper):  # a file name may be invalid in its encoding
        stream.reconfigure(errors="backslashreplace")
    return cast(TextIO, VisibleOutput(stream))


def raw_output(stream: TextIO) -> TextIO:
    """Return the stream below a VisibleOutput, and any other stream as it is."""
    return stream.raw if isinstance(stream, VisibleOutput) else stream


def shell_word(text: str | PurePath) -> str:
    """Return a text or path as one argument of a command line of bash or zsh.

    A relative path that begins with `-` gets `./` before it, so that no option is taken for it.
    """
    word = str(text)
    if isinstance(text, PurePath) and word.startswith("-"):
        word = f"./{word}"
    if _SAFE_IN_SHELL.fullmatch(word):
        return word
    if not _STEERING.search(word):
        return "'{}'".format(word.replace("'", "'\"'\"'"))
    # A terminal would not pass on such characters when the command is pasted.
    return "$'{}'".format("".join(map(_ansi_c, word)))


def _ansi_c(character: str) -> str:
    if character in "\\'":
        return f"\\{character}"
    if not _STEERING.match(character):
        return character
    data = character.encode(errors="surrogateescape")
    return "".join(f"\\{byte:03o}" for byte in data)


def html_text(text: str) -> str:
    """Return text for an element or a quoted attribute of HTML, with its line breaks."""
    from html import escape

    return escape(visible(text), quote=True)


def svg_texts(svg: str) -> str:
    """Return an SVG whose text elements hold no quotes and no #.

    Then a pattern such as `style="([^"]*)"` finds attributes only.
    """
    return re.sub(r">([^<>]+)<", lambda found: f">{found[1].translate(_ENTITIES)}<", svg)


def systemd_text(path: str | PurePath) -> str:
    """Escape a path for use between quotes in a systemd unit.

    Raises:
        EscapingError: the path has a line break or another control character.
    """
    text = _without_steering(str(path), "unit")
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")


def systemd_word(path: str | PurePath) -> str:
    """Quote a path as one argument of a command line in a systemd unit; raises EscapingError."""
    text = systemd_text(path).replace("$", "$$")
    return text if _SAFE_IN_UNIT.fullmatch(text.replace("$$", "")) else f'"{text}"'


def systemd_name(text: str) -> str:
    """Return a path or name as part of the name of a systemd unit, as systemd-escape does."""
    data = text.strip("/").encode(errors="surrogateescape")
    escaped = "".join(map(_in_unit_name, data))
    return f"\\x2e{escaped[1:]}" if escaped.startswith(".") else escaped


def _in_unit_name(byte: int) -> str:
    character = chr(byte)
    if character == "/":
        return "-"
    return character if _SAFE_IN_UNIT_NAME.fullmatch(character) else f"\\x{byte:02x}"


def udev_name(name: str) -> str:
    """Return the kernel's name of a device for a udev rule.

    Raises:
        EscapingError: no device has such a name.
    """
    if not _DEVICE_NAME.fullmatch(name):
        raise EscapingError(
            "expected the name of a device (letters, digits and . _ : = @ # + -), found "
            f"{_quoted(name)}"
        )
    return name


def _without_steering(text: str, language: str) -> str:
    if _STEERING.search(text):
        raise EscapingError(
            f"expected a path without line breaks and control characters, which no {language} can "
            f"hold, found {_quoted(text)}"
        )
    return text


def _quoted(text: str) -> str:
    return f"'{one_line(text)[:60]}'"
