"""Locate the configuration files that levid ships."""

from __future__ import annotations

from pathlib import Path

_FOLDER = Path(__file__).resolve().parent


def shipped(name: str) -> Path:
    """Return the path of a shipped file such as `rigs/loopback.yaml`; raises FileNotFoundError."""
    path = _FOLDER / name
    if not path.is_file():
        raise FileNotFoundError(f"levid ships no config/{name}")
    return path
