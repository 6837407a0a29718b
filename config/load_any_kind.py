"""Read a YAML file with the schema that its key `levid: KIND` names."""

from __future__ import annotations

from pathlib import Path

from .base import ConfigError, Strict, parse, read_mapping
from .error_messages import quoted
from .model import ModelConfig
from .rig import RigConfig
from .session import SessionConfig
from .sim import SimConfig

KINDS: dict[str, type[Strict]] = {
    "rig": RigConfig,
    "sim": SimConfig,
    "session": SessionConfig,
    "model": ModelConfig,
}


def load_any(path: Path | str, more: dict[str, type[Strict]] | None = None) -> Strict:
    """Read a YAML file of any kind in KINDS or in `more`, which adds kinds; raises ConfigError."""
    kinds = {**KINDS, **(more or {})}
    data = read_mapping(path)
    kind = data.get("levid")
    if not isinstance(kind, str) or kind not in kinds:
        found = "no key 'levid'" if kind is None else quoted(kind)
        raise ConfigError(
            f"{path}: levid: expected one of {', '.join(sorted(kinds))}, found {found}"
        )
    return parse(data, kinds[kind], str(path))
