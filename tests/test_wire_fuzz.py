"""Noise into the decoders, in short; benchmarks/fuzz.py does the same a million times."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from from_benchmarks import script

N = 20_000


@pytest.fixture(scope="module")
def fuzz() -> ModuleType:
    return script("fuzz")


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
