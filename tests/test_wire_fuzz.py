"""Noise into the decoders, in short; benchmarks/fuzz.py does the same a million times."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
N = 20_000


@pytest.fixture(scope="module")
def fuzz() -> ModuleType:
    sys.path.insert(0, str(BENCHMARKS))  # where its `_table` is
    try:
        spec = importlib.util.spec_from_file_location("levid_fuzz", BENCHMARKS / "fuzz.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(BENCHMARKS))
    return module


@pytest.mark.parametrize("right_counter", [False, True])
def test_share_of_random_frames_is_what_counter_and_checksum_predict(fuzz, right_counter) -> None:
    found = fuzz.can_random(N, np.random.default_rng(1), right_counter=right_counter)
    assert found.wrong == 0
    # 5 and 78 are to be expected: within four standard deviations of a fair draw
    assert abs(found.z) < 4.0


@pytest.mark.parametrize("kind", ["can_mutated", "serial_blocks"])
def test_nothing_mutated_passes_that_is_not_right(fuzz, kind: str) -> None:
    found = getattr(fuzz, kind)(N, np.random.default_rng(2))
    assert found.wrong == 0
    # A CRC-8 lets one in 256 through, a CRC-32 none of so few.
    assert found.accepted < (N / 100 if kind == "can_mutated" else 1)


def test_stream_is_in_step_again_after_any_noise(fuzz) -> None:
    found = fuzz.stream_of_noise(10 * N, np.random.default_rng(3))
    assert found.wrong == 0
    assert found.tried > 300
