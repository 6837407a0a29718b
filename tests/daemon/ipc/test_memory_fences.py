"""Test the protocols of shared memory on a processor that reorders stores and loads.

All orders that such a processor may show are tried, for a ring of a few slots: stores of one
process become visible to the other in any order, except those to one place, and except across a
fence; loads likewise. Every fence is needed: without any one of them an order shows wrong content.
"""

from __future__ import annotations

import itertools
import multiprocessing
import platform
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from levid.daemon.ipc import flight_segment_stream, memory_fences, row_ring
from levid.daemon.ipc.flight_segment_stream import Announced, SegmentStream
from levid.daemon.ipc.row_ring import Ring
from levid.daemon.ipc.shared_status_words import ControlWords, Word

DTYPE = np.dtype([("a", "<u8"), ("b", "<u8")])
CAPACITY, ROWS = 3, 5


@dataclass(frozen=True)
class Access:
    """A store of `value`, or a load, at a place of the shared memory."""

    place: str
    value: int | None = None


FENCE = None
Program = Sequence[Access | None]


def outcomes(writer: Program, reader: Program) -> Iterator[tuple[int, ...]]:
    """Yield what the loads of the reader, in program order, may return together."""
    stores = [op for op in writer if op is not FENCE]
    loads = [op for op in reader if op is not FENCE]
    before_store, before_load = _before(writer), _before(reader)
    seen, stack = set(), [(0, (None,) * len(loads))]
    while stack:
        state = stack.pop()
        if state in seen:
            continue
        seen.add(state)
        visible, values = state
        if None not in values:
            yield values  # type: ignore[misc]
            continue
        for i, needed in enumerate(before_store):
            if not visible >> i & 1 and visible & needed == needed:
                stack.append((visible | 1 << i, values))
        done = sum(1 << i for i, value in enumerate(values) if value is not None)
        for i, needed in enumerate(before_load):
            if values[i] is None and done & needed == needed:
                found = _read(stores, visible, loads[i].place)
                stack.append((visible, (*values[:i], found, *values[i + 1 :])))


def _before(program: Program) -> list[int]:
    """Return for each access which accesses come before it in every order, as a bit mask."""
    found, fenced, place, since = [], 0, {}, 0
    number = 0
    for op in program:
        if op is FENCE:
            fenced = since
            continue
        found.append(fenced | place.get(op.place, 0))
        place[op.place] = place.get(op.place, 0) | 1 << number
        since |= 1 << number
        number += 1
    return found


def _read(stores: Sequence[Access], visible: int, place: str) -> int:
    """Return the last visible value of a place, 0 if there is none."""
    value = 0
    for i, op in enumerate(stores):
        if op.place == place and visible >> i & 1:
            value = op.value or 0
    return value


def written_by_a_ring(monkeypatch: pytest.MonkeyPatch) -> list[Access | None]:
    """Return the stores and fences of a real ring that gets ROWS rows, numbered from 1."""
    program: list[Access | None] = []

    class Words(list[int]):
        def __setitem__(self, index, value):  # type: ignore[no-untyped-def]
            program.append(Access("head", value))
            super().__setitem__(index, value)

    with monkeypatch.context() as patch:
        patch.setattr(row_ring, "release", lambda: program.append(FENCE))
        patch.setattr(row_ring, "acquire", lambda: None)
        ring = Ring(DTYPE, CAPACITY)
        ring.words = Words([0] * 5)  # type: ignore[assignment]
        for number in range(ROWS):
            slot = ring.head % CAPACITY
            program += [Access(f"a{slot}", number + 1), Access(f"b{slot}", number + 1)]
            ring.head += 1
    return program


def read_by_a_ring(monkeypatch: pytest.MonkeyPatch) -> list[Access | None]:
    """Return the loads and fences of `Ring.copy`."""
    program: list[Access | None] = []
    ring = Ring(DTYPE, CAPACITY)

    class Words(list[int]):
        def __getitem__(self, index):  # type: ignore[no-untyped-def]
            program.append(Access("head"))
            return super().__getitem__(index)

    class Rows:
        def __getitem__(self, places):  # type: ignore[no-untyped-def]
            program.extend(Access(f"{part}{slot}") for slot in range(CAPACITY) for part in "ab")
            return ring_rows[places]

    ring_rows = ring.rows
    with monkeypatch.context() as patch:
        patch.setattr(row_ring, "acquire", lambda: program.append(FENCE))
        ring.words = Words([CAPACITY, 0, 0, 0, 0])  # type: ignore[assignment]
        ring.rows = Rows()  # type: ignore[assignment]
        ring.copy(0, CAPACITY)
    return program


def wrong_rows(writer: Program, reader: Program) -> Iterator[tuple[int, ...]]:
    """Yield the outcomes in which a row that counts has other content than was written."""
    for found in outcomes(writer, reader):
        first_head, *words, last_head = found
        begin = max(first_head - CAPACITY + 1, last_head - CAPACITY + 1, 0)
        for row in range(begin, first_head):
            slot = row % CAPACITY
            if words[2 * slot : 2 * slot + 2] != [row + 1, row + 1]:
                yield found
                break


def test_ring_hands_on_no_wrong_row_in_any_order(monkeypatch: pytest.MonkeyPatch) -> None:
    writer, reader = written_by_a_ring(monkeypatch), read_by_a_ring(monkeypatch)
    assert [op for op in reader if op is not FENCE] == [
        Access("head"),
        *(Access(f"{part}{slot}") for slot in range(CAPACITY) for part in "ab"),
        Access("head"),
    ]
    assert not list(wrong_rows(writer, reader))
    # The model finds what each fence is for.
    kinds = {
        "before the head": [op for i, op in enumerate(writer) if not _fence_before_head(writer, i)],
        "behind the head": [op for i, op in enumerate(writer) if not _fence_behind_head(writer, i)],
    }
    for name, without in kinds.items():
        assert len(without) < len(writer)
        assert next(wrong_rows(without, reader), None) is not None, name
    for i, op in enumerate(reader):
        if op is FENCE and i < len(reader) - 1:  # the last one is for what follows
            without = [*reader[:i], *reader[i + 1 :]]
            if without.count(FENCE) < reader.count(FENCE) and reader[i + 1] is not FENCE:
                assert next(wrong_rows(writer, without), None) is not None, i


def _fence_before_head(program: Program, i: int) -> bool:
    return program[i] is FENCE and i + 1 < len(program) and program[i + 1] == _head(program, i + 1)


def _fence_behind_head(program: Program, i: int) -> bool:
    return program[i] is FENCE and i > 0 and program[i - 1] == _head(program, i - 1)


def _head(program: Program, i: int) -> Access | None:
    op = program[i]
    return op if op is not FENCE and op.place == "head" else Access("none")


def stream() -> tuple[SegmentStream, ControlWords]:
    words = ControlWords(memoryview(bytearray(ControlWords.SIZE)))
    memory = memoryview(bytearray(SegmentStream.size(9, 64)))
    return SegmentStream(9, 64, memory, words), words


def test_segment_that_is_not_there_as_announced_is_not_flown() -> None:
    segments, words = stream()
    announced = Announced(7, 1, 2, 100, 0, 1, 1, 0, 0, 1, 1)
    assert segments.announced(0) is None  # nothing was announced
    segments.announce(announced)
    found = segments.announced(0)
    assert found is not None
    assert found[:-2] == announced[:-2]
    assert segments.announced(64) is None  # an old one in the slot of another
    for field in range(len(Announced._fields)):
        segments._queue[0, field] += 1
        assert segments.announced(0) is None
        segments._queue[0, field] -= 1
    assert segments.announced(0) == found
    assert words[Word.QUEUE_HEAD] == 1


def test_segment_and_rows_are_written_before_they_are_announced(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each counter follows a fence, which follows what it counts."""
    segments, words = stream()
    events: list[str] = []

    class Words:
        def __getitem__(self, word):  # type: ignore[no-untyped-def]
            return words.words[word]

        def __setitem__(self, word, value):  # type: ignore[no-untyped-def]
            events.append(Word(word).name)
            words.words[word] = value

    segments._words = Words()  # type: ignore[assignment]
    monkeypatch.setattr(flight_segment_stream, "release", lambda: events.append("release"))
    segments.announce(Announced(1, 1, 2, 5, 0, 1, 1, 0, 0, 1, 1))
    from levid.daemon.control.flight_segment import idle_segment

    segments.write(idle_segment(5, 9, np.zeros(3), np.zeros(3)), 0, 5)
    assert events == ["release", "QUEUE_HEAD", "release", "ROWS_HEAD"]


def test_fences_can_be_compiled_for_this_processor() -> None:
    release, acquire = memory_fences.compiled_fences()
    for fence, ordering in ((release, "release"), (acquire, "acquire")):
        assert fence() is None  # type: ignore[func-returns-value]
        (code,) = fence.inspect_llvm().values()  # type: ignore[attr-defined]
        assert f"fence {ordering}" in code
    if platform.machine() in memory_fences.ORDERED:
        assert memory_fences.release is memory_fences.acquire is memory_fences._nothing


def write_rows(memory, seconds: float, fences: bool) -> None:  # type: ignore[no-untyped-def]
    if fences:
        row_ring.release, row_ring.acquire = memory_fences.compiled_fences()
    ring = Ring(DTYPE, 16, memoryview(memory).cast("B"))
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        for _ in range(1000):
            number = ring.head
            row = ring.rows[number % 16]
            row["a"] = row["b"] = number
            ring.head = number + 1


@pytest.mark.parametrize("fences", [False, True])
def test_rows_are_right_while_another_process_writes(
    fences: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if fences:
        compiled = memory_fences.compiled_fences()
        monkeypatch.setattr(row_ring, "release", compiled[0])
        monkeypatch.setattr(row_ring, "acquire", compiled[1])
    context = multiprocessing.get_context("spawn")
    memory = context.RawArray("q", Ring.size(DTYPE, 16) // 8 + 1)
    writer = context.Process(target=write_rows, args=(memory, 1.0, fences))
    ring = Ring(DTYPE, 16, memoryview(memory).cast("B"))
    writer.start()
    rows = 0
    try:
        while writer.is_alive():
            found = ring.copy(max(ring.head - 8, 0), 8)
            expected = np.arange(found.first, found.first + len(found.rows))
            np.testing.assert_array_equal(found.rows["a"], expected)
            np.testing.assert_array_equal(found.rows["b"], expected)
            rows += len(found.rows)
    finally:
        writer.kill()
        writer.join()
    assert rows > 1000


def test_the_model_knows_the_textbook_cases() -> None:
    """Message passing: without fences old content may be seen behind a new counter."""
    stores, loads = (Access("x", 1), Access("flag", 1)), (Access("flag"), Access("x"))
    fenced: dict[tuple[bool, bool], bool] = {}
    for left, right in itertools.product((False, True), repeat=2):
        writer: Program = [stores[0], *([FENCE] if left else []), stores[1]]
        reader: Program = [loads[0], *([FENCE] if right else []), loads[1]]
        fenced[left, right] = (1, 0) in set(outcomes(writer, reader))
    assert fenced == {
        (False, False): True,
        (True, False): True,
        (False, True): True,
        (True, True): False,
    }
