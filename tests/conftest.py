"""Fixtures of more than one test file."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def rig() -> ModuleType:
    """The rig of tests/identification_plant.py; a truth that shares no code with the project."""
    path = Path(__file__).with_name("identification_plant.py")
    spec = importlib.util.spec_from_file_location("identification_plant", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where its dataclasses look for it
    spec.loader.exec_module(module)
    return module
