"""Find the commands of levid in a text, and expand them as a shell does."""

from __future__ import annotations

import html
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

_PROMPT = re.compile(r"^(?:\$ |next: |then[^:]*: |to repeat it: )?(levid [a-z].*)$")
_COMMENT = re.compile(r"\s{2,}#.*| # .*")
_REDIRECTED = re.compile(r"\s*>>? \S+")
_VALUE = re.compile(r"(?<![\w.])[A-Z][A-Z_.a-z]*\b")
"""A value that the reader has to fill in, such as MODEL.yaml or FILE."""


def commands(text: str) -> list[str]:
    """Return the commands that stand on a line of their own, without comments, one an entry."""
    found = []
    for line in text.splitlines():
        if match := _PROMPT.match(line.strip()):
            plain = _REDIRECTED.sub("", _COMMENT.sub("", match[1]))
            found += [part.strip() for part in plain.split("&&")]
    return [line for line in found if line.startswith("levid ")]


def commands_of_page(page: Path) -> list[str]:
    """Return the commands of a report's next steps."""
    text = page.read_text(encoding="utf-8")
    shown = [html.unescape(code) for code in re.findall(r"<code>(levid [^<]*)</code>", text)]
    return commands("\n".join(dict.fromkeys(shown)))


def asks_for_a_value(line: str) -> bool:
    """Return whether the reader has to replace a word in capitals."""
    return any(word.isupper() or word.endswith(".yaml") for word in _VALUE.findall(line))


def expanded(line: str, folder: Path) -> list[str]:
    """Return the arguments that bash passes to levid for a line."""
    script = f'levid() {{ printf "%s\\0" "$@"; }}; {line}'
    done = subprocess.run(
        ["bash", "-c", script], cwd=folder, capture_output=True, text=True, check=True
    )
    return done.stdout.split("\0")[:-1]


def code_blocks(markdown: str) -> Iterator[str]:
    """Yield the lines of indented and fenced code without a language."""
    fenced = False
    for line in markdown.splitlines():
        if line.strip().startswith("```"):
            fenced = not fenced
        elif fenced or line.startswith("    "):
            yield line.strip()
