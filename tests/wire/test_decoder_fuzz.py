"""Noise into the decoders, in short; benchmarks/bus/fuzz.py does the same a million times."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from levid.benchmarks.bus import fuzz, fuzz_can
from levid.drivers.serial.transaction import TransactionPort
from levid.wire.can.can_frames import ValueFrames
from levid.wire.can.cia402 import ENABLE_OPERATION
from levid.wire.frame_rejection import Rejected
from levid.wire.serial.serial_frames import SerialFrames

N = 20_000


@pytest.mark.parametrize("right_counter", [False, True])
def test_share_of_random_frames_is_what_counter_and_checksum_predict(right_counter) -> None:
    found = fuzz.can_random(N, np.random.default_rng(1), right_counter=right_counter)
    assert found.wrong == 0
    # 5 and 78 are to be expected: within four standard deviations of a fair draw
    assert abs(found.z) < 4.0


@pytest.mark.parametrize("kind", ["can_mutated", "serial_blocks"])
def test_nothing_mutated_passes_that_is_not_right(kind: str) -> None:
    found = getattr(fuzz, kind)(N, np.random.default_rng(2))
    assert found.wrong == 0
    # A CRC-8 lets one in 256 through, a CRC-32 none of so few.
    assert found.accepted < (N / 100 if kind == "can_mutated" else 1)


@pytest.mark.parametrize(
    ("kind", "options"), [("can_mutated", {"resealed": True}), ("serial_resealed", {})]
)
def test_a_right_checksum_alone_is_not_enough(kind: str, options: dict[str, bool]) -> None:
    found = getattr(fuzz, kind)(N, np.random.default_rng(4), **options)
    assert found.wrong == 0
    # What was changed is mostly a value; version, kind, length or counter often enough.
    assert 0.2 * N < found.accepted < 0.6 * N


def test_every_check_of_a_serial_frame_is_reached(monkeypatch) -> None:
    reached = set()
    accept = SerialFrames.accept

    def noted(self: SerialFrames, block: bytes) -> object:
        reached.add(found := accept(self, block))
        return found

    monkeypatch.setattr(SerialFrames, "accept", noted)
    fuzz.serial_resealed(500, np.random.default_rng(5))
    assert reached >= {Rejected.VERSION, Rejected.KIND, Rejected.LENGTH, Rejected.CYCLE}
    fuzz.serial_blocks(500, np.random.default_rng(5))
    assert reached >= {Rejected.FRAMING, Rejected.CHECKSUM}


def test_drives_are_heard_as_they_speak() -> None:
    found = fuzz.drives_heard(N, np.random.default_rng(6))
    assert found.wrong == 0
    assert found.accepted > N / 10


def test_no_frame_ends_the_emulated_drives() -> None:
    found = fuzz.nodes_told(N // 10, np.random.default_rng(7))
    assert found.wrong == 0
    assert found.accepted > 0


@pytest.mark.parametrize(
    "kind",
    [
        "can_lengths", "frames_unpacked", "local_bus", "transactions", "drives_followed",
        "readings_taken", "setpoints_taken",
    ],
)  # fmt: skip
def test_noise_is_judged_as_it_should_be(kind: str) -> None:
    found = getattr(fuzz, kind)(N // 4, np.random.default_rng(8))
    assert found.wrong == 0
    assert found.accepted > 0


def test_checksum_of_serial_frames_lets_through_what_its_width_predicts() -> None:
    found = fuzz.serial_crc12(N, np.random.default_rng(9))
    assert found.wrong == 0
    assert abs(found.z) < 4.0
    # It is narrow for as long as that takes, and no longer.
    assert fuzz.serial_blocks(100, np.random.default_rng(9)).wrong == 0


def test_answers_by_sdo_are_numbers_or_errors() -> None:
    found = fuzz.sdo_answers(N // 10, np.random.default_rng(10))
    assert found.wrong == 0
    assert 0.3 * found.tried < found.accepted < 0.8 * found.tried


def test_readings_of_another_cycle_would_be_noticed(monkeypatch) -> None:
    """Whoever judges has to know better: a port that takes whatever comes is found out."""
    take = TransactionPort._handle_frame

    def take_all(self: TransactionPort, block: bytes) -> None:
        cycle = self._cycle
        header = SerialFrames(self.frames.contents).accept(block)
        if not isinstance(header, Rejected):
            self._cycle = header.sequence
        take(self, block)
        self._cycle = cycle

    monkeypatch.setattr(TransactionPort, "_handle_frame", take_all)
    assert fuzz.transactions(N // 20, np.random.default_rng(11)).wrong > 0


@pytest.mark.parametrize(
    ("kind", "broken", "instead"),
    [
        ("readings_taken", "begin", lambda _: None),  # frames of two cycles make a reading
        ("setpoints_taken", "tag", staticmethod(lambda _: 0)),  # frames of two sets make one
    ],
)
def test_frames_that_do_not_belong_together_would_be_noticed(
    monkeypatch, kind: str, broken: str, instead
) -> None:
    monkeypatch.setattr(ValueFrames, broken, instead)
    assert getattr(fuzz, kind)(N // 20, np.random.default_rng(13)).wrong > 0


def test_drive_that_is_told_to_go_on_beside_a_fault_would_be_noticed(monkeypatch) -> None:
    monkeypatch.setattr("levid.drivers.can.canopen_drives.QUICK_STOP", ENABLE_OPERATION)
    assert fuzz.drives_followed(N // 20, np.random.default_rng(12)).wrong > 0


@pytest.mark.parametrize("most", [0.0, math.inf])
@pytest.mark.parametrize("kind", ["drives_heard", "drives_followed"])
def test_speed_by_other_differences_would_be_noticed(monkeypatch, kind: str, most: float) -> None:
    monkeypatch.setattr("levid.drivers.can.canopen_drives.most_bend", lambda *_: most)
    assert getattr(fuzz, kind)(N // 20, np.random.default_rng(14)).wrong > 0


def test_every_run_is_kept_and_has_its_figures(tmp_path: Path, monkeypatch) -> None:
    asked: list[str] = []

    class Pool(ThreadPoolExecutor):
        def submit(self, call, key: str, n: int):  # type: ignore[no-untyped-def]
            asked.append(key)
            return super().submit(call, key, min(n, 20))

    monkeypatch.setattr(fuzz, "KEPT", tmp_path)
    monkeypatch.setattr(fuzz, "ProcessPoolExecutor", lambda _: Pool(1))
    fuzz.Parts(tmp_path / f"20000-{fuzz.version()}.jsonl").keep(
        "nodes", [{"tried": 8, "accepted": 2, "wrong": 0, "expected_share": 0.25}, 1.0]
    )
    found = {figure.key: figure.value for figure in fuzz.measure(True)}
    assert sorted([*asked, "nodes"]) == sorted(fuzz.RUNS)
    assert {f"{key}_wrong" for key in fuzz.RUNS} <= found.keys()
    assert {key for key in found if key.endswith("_z")} == {f"{k}_z" for k in fuzz.PREDICTED}
    assert (found["nodes_tried"], found["nodes_accepted"]) == (8, 0.25)
    (file,) = tmp_path.iterdir()
    assert "nodes" not in fuzz.Parts(file)  # a whole run is not carried on


def test_stream_is_in_step_again_after_any_noise() -> None:
    found = fuzz.stream_of_noise(N // 10, np.random.default_rng(3))
    assert found.wrong == 0
    assert found.tried == N // 10


def test_checksum_that_fuzz_checks_with_is_the_standards() -> None:
    # AUTOSAR's own check value (Specification of CRC Routines).
    assert fuzz_can.crc8(b"123456789") == 0xDF
