"""Replace a text file atomically."""

from __future__ import annotations

from pathlib import Path


def replace_text(path: Path, text: str) -> None:
    """Replace a file by `text` in UTF-8; on an error the old file remains.

    Characters without an encoding, which file names can contain, are escaped. Raises OSError.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_bytes(text.encode("utf-8", errors="backslashreplace"))
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
