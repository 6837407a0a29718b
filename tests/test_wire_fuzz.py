"""Noise into the decoders, in short; benchmarks/fuzz.py does the same a million times."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from from_benchmarks import script

from levid.wire.rejected import Rejected
from levid.wire.serial_frames import SerialFrames

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


@pytest.mark.parametrize(
    ("kind", "options"), [("can_mutated", {"resealed": True}), ("serial_resealed", {})]
)
def test_a_right_checksum_alone_is_not_enough(fuzz, kind: str, options: dict[str, bool]) -> None:
    found = getattr(fuzz, kind)(N, np.random.default_rng(4), **options)
    assert found.wrong == 0
    # What was changed is mostly a value; version, kind, length or counter often enough.
    assert 0.2 * N < found.accepted < 0.6 * N


def test_every_check_of_a_serial_frame_is_reached(fuzz, monkeypatch) -> None:
    reached = set()
    accept = SerialFrames.accept

    def noted(self: SerialFrames, block: bytes) -> object:
        reached.add(found := accept(self, block))
        return found

    monkeypatch.setattr(SerialFrames, "accept", noted)
    fuzz.serial_resealed(500, np.random.default_rng(5))
    assert reached >= {Rejected.VERSION, Rejected.KIND, Rejected.LENGTH}
    fuzz.serial_blocks(500, np.random.default_rng(5))
    assert reached >= {Rejected.FRAMING, Rejected.CHECKSUM}


def test_drives_are_heard_as_they_speak(fuzz) -> None:
    found = fuzz.drives_heard(N, np.random.default_rng(6))
    assert found.wrong == 0
    assert found.accepted > N / 10


def test_no_frame_ends_the_emulated_drives(fuzz) -> None:
    found = fuzz.nodes_told(N // 10, np.random.default_rng(7))
    assert found.wrong == 0
    assert found.accepted > 0


def test_stream_is_in_step_again_after_any_noise(fuzz) -> None:
    found = fuzz.stream_of_noise(N // 10, np.random.default_rng(3))
    assert found.wrong == 0
    assert found.tried == N // 10
