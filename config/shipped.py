"""The files that levid brings along, found wherever it is installed."""

from __future__ import annotations

from pathlib import Path

_FOLDER = Path(__file__).resolve().parent


def shipped(name: str) -> Path:
    """Return the path of a shipped file such as `rigs/loopback.yaml`."""
    path = _FOLDER / name
    if not path.is_file():
        raise FileNotFoundError(f"levid ships no config/{name}")
    return path
