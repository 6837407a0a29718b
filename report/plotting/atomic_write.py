"""A file that is replaced whole or not at all."""

from __future__ import annotations

from pathlib import Path


def replace_text(path: Path, text: str) -> None:
    """Write text as UTF-8 in place of what is there, which stays if it cannot be written.

    What is no text in any encoding, as names of files need not be, is escaped. Raises OSError.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_bytes(text.encode("utf-8", errors="backslashreplace"))
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
