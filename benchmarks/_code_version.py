"""A digest of code and settings: results that are kept on disk hold only for what made them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path

import levid
from levid.config.base import read_mapping

ROOT = Path(levid.__file__).parent
FLYING_CODE = ("config", "daemon", "drivers", "log", "model", "sim")
"""What decides how a plant moves: folders of the package."""


def code_version(
    rooms: Iterable[str], sources: Iterable[Path] = (), settings: Iterable[Path] = ()
) -> str:
    """Return a digest of all Python in rooms (folders of the package), of sources and of settings.

    Of settings, which are YAML files, comments and the order of keys do not count.
    """
    digest = hashlib.sha256()
    for room in rooms:
        for path in sorted((ROOT / room).rglob("*.py")):
            digest.update(path.read_bytes())
    for path in sources:
        digest.update(path.read_bytes())
    for path in settings:
        digest.update(canonical(read_mapping(path)).encode())
    return digest.hexdigest()[:12]


def canonical(value: object) -> str:
    """Return the text of plain data that does not depend on comments or on the order of keys."""
    return json.dumps(value, sort_keys=True)
