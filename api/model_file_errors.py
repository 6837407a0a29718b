"""Name the model file in errors that only its use with records shows."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def naming_the_file(model: Path | None) -> Iterator[None]:
    """Raise ConfigError with the file for a ModelError; without a file, change no error."""
    from ..config.base import ConfigError
    from ..model.declared_model import ModelError

    try:
        yield
    except ModelError as error:
        if model is None:
            raise
        raise ConfigError(f"{model}: {error}") from None
