"""Test the shared memory: ring with lost rows, stream of segments, landing."""

import mmap
import os
from dataclasses import replace

import numpy as np
import pytest

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.control.control_cycle import Controller
from levid.daemon.control.faults import FAULTS, Fault
from levid.daemon.control.flight_segment import idle_segment
from levid.daemon.control.landing import Landing
from levid.daemon.control.states import TRANSITIONS, State, may_become
from levid.daemon.ipc.flight_segment_stream import Logged, SegmentFeeder, SegmentStream
from levid.daemon.ipc.row_ring import Ring
from levid.daemon.ipc.shared_memory import SharedMemory
from levid.daemon.ipc.shared_status_words import ControlWords, Word
from levid.daemon.planning import point_to_point

DTYPE = np.dtype([("cycle", "<u8"), ("payload", "<f4", 3)])
RIG = load_rig(shipped("rigs/loopback.yaml"))


def write(ring: Ring, n: int, tag: int = 1) -> None:
    for _ in range(n):
        slot = ring.head % ring.capacity
        ring.rows["cycle"][slot], ring.tags[slot] = ring.head, tag
        ring.head += 1


def test_ring_hands_on_every_row_once_and_in_order() -> None:
    ring = Ring(DTYPE, 10)
    seen: list[int] = []
    for n in (3, 9, 0, 1, 8, 8):
        write(ring, n)
        seen += ring.take(100).rows["cycle"].tolist()
    assert seen == list(range(29))
    assert ring.lost == 0


def test_ring_writes_over_what_is_not_read_and_counts_it() -> None:
    ring = Ring(DTYPE, 10)
    write(ring, 25)
    taken = ring.take(100)
    # The slot of the oldest row may be being written: nine of ten are sure.
    assert taken.rows["cycle"].tolist() == list(range(16, 25))
    assert taken.first == 16
    assert ring.lost == 16


def test_row_that_is_written_over_while_it_is_read_does_not_count() -> None:
    class Racing(Ring):
        @property
        def head(self) -> int:
            value = super().head
            if self.racing and value == 10:  # the writer goes on while rows are copied
                self.racing = False
                self.words[0] = 14
            return value

        @head.setter
        def head(self, value: int) -> None:
            self.words[0] = value

        racing = False

    ring = Racing(DTYPE, 10)
    write(ring, 10)
    ring.racing = True
    assert ring.copy(0, 100).first == 5


def test_two_rings_on_one_memory_are_one() -> None:
    memory = memoryview(bytearray(Ring.size(DTYPE, 10)))
    writer, reader = Ring(DTYPE, 10, memory), Ring(DTYPE, 10, memory)
    write(writer, 4, tag=7)
    taken = reader.take(100)
    assert taken.tags.tolist() == [7] * 4
    assert writer.tail == 4


def test_last_rows_are_there_whether_taken_or_not() -> None:
    ring = Ring(DTYPE, 10)
    write(ring, 12)
    ring.take(100)
    assert ring.last(3).rows["cycle"].tolist() == [9, 10, 11]
    assert len(ring.last(100).rows) == 9


def test_feeder_streams_a_plan_longer_than_the_memory() -> None:
    control_words = ControlWords(memoryview(bytearray(ControlWords.SIZE)))
    capacity, coils = 64, 9
    segment_stream = SegmentStream(
        coils, capacity, memoryview(bytearray(SegmentStream.size(coils, capacity))), control_words
    )
    rng = np.random.default_rng(1)
    segments = []
    for cycles in (5, 300, 1, 100):
        v = rng.normal(size=(cycles, 3)) if cycles > 1 else np.ones((1, 3))
        segment = replace(idle_segment(cycles, coils, np.zeros(3), np.zeros(3)), v=v)
        segments.append(Logged(segment, cycles))
    feeder = SegmentFeeder(segment_stream, control_words, 1, segments)
    flown = []
    while control_words[Word.QUEUE_TAIL] < len(segments):
        feeder.feed()
        assert control_words[Word.QUEUE_TAIL] < control_words[Word.QUEUE_HEAD]
        announced = segment_stream.announced(control_words[Word.QUEUE_TAIL])
        control_words[Word.QUEUE_TAIL] += 1
        assert announced.log == announced.cycles
        for position in range(announced.first, announced.first + announced.cycles):
            if position >= control_words[Word.ROWS_HEAD]:
                feeder.feed()
            assert position < control_words[Word.ROWS_HEAD]
            flown.append(segment_stream.v[position % capacity].copy())
            control_words[Word.ROWS_TAIL] = position
    assert announced.last
    np.testing.assert_array_equal(flown, np.vstack([logged.segment.v for logged in segments]))


@pytest.mark.parametrize("flag", ["in_control", "airborne", "engages", "lands", "beam_feedforward"])
def test_the_loop_gets_every_flag_of_a_segment(flag: str) -> None:
    control_words = ControlWords(memoryview(bytearray(ControlWords.SIZE)))
    memory = memoryview(bytearray(SegmentStream.size(9, 64)))
    segment_stream = SegmentStream(9, 64, memory, control_words)
    segment = idle_segment(5, 9, np.zeros(3), np.zeros(3))
    changed = replace(segment, **{flag: not getattr(segment, flag)})
    SegmentFeeder(segment_stream, control_words, 1, [Logged(changed, 1)]).feed()
    announced = segment_stream.announced(0)
    assert announced is not None
    found = segment_stream.segment(announced)
    for name in ("in_control", "airborne", "engages", "lands", "beam_feedforward"):
        assert getattr(found, name) == getattr(changed, name), name


@pytest.mark.parametrize("speed", [0.0, 0.3, -0.5])
def test_landing_by_hand_is_the_planned_one(speed: float) -> None:
    control = Controller(RIG, 1e-3)
    control.beam_ref[:] = 0.02, speed, 0.0
    control.rotor_ref[:] = 1.0, 10 * speed, 0.0
    landing = Landing(control, RIG.limits, 1e-3)
    landing.begin(500, 200)
    rows = []
    while landing.set_row(len(rows)):
        segment = landing.segment
        rows.append(np.concatenate([segment.blend[0], segment.beam[0], segment.rotor[0]]))
    assert len(rows) == 700
    s = np.arange(500, 0, -1) / 500
    blend, beam = np.array(rows)[:, :3], np.array(rows)[:, 3:6]
    np.testing.assert_allclose(blend[:500, 0], s**3 * (10 - 15 * s + 6 * s**2), atol=1e-12)
    assert np.all(blend[:500, 1:] == 1.0)
    assert np.all(np.diff(blend[500:, 2]) < 0)
    brake = point_to_point.brake(0.02, speed, RIG.limits.beam_acceleration_m_s2, 1e-3)
    np.testing.assert_allclose(beam[: len(brake)], brake, atol=1e-12)
    np.testing.assert_allclose(beam[len(brake) :, 0], brake[-1, 0], atol=1e-12)
    assert not beam[len(brake) :, 1:].any()


def test_stop_is_there_at_once_and_twice_is_once() -> None:
    control_words = ControlWords(memoryview(bytearray(ControlWords.SIZE)))
    control_words.stop(Fault.STOPPED)
    control_words.stop(Fault.LOOP)
    assert control_words[Word.ZERO] == Fault.STOPPED


def test_a_stop_that_comes_after_a_clear_is_not_taken_back_by_it() -> None:
    control_words = ControlWords(memoryview(bytearray(ControlWords.SIZE)))
    control_words.stop()
    asked = control_words[Word.STOPS]
    control_words.stop()  # before the clear is acted upon
    control_words.clear(asked)
    control_words.cancel_stop()
    assert control_words[Word.ZERO] == Fault.STOPPED
    control_words.clear()
    control_words.cancel_stop()
    assert control_words[Word.ZERO] == 0


def test_detail_of_any_length_comes_back() -> None:
    control_words = ControlWords(memoryview(bytearray(ControlWords.SIZE)))
    for text in ("", "short", "ü" * 1000):
        control_words.detail = text
        assert text.startswith(control_words.detail.rstrip("\ufffd"))
    control_words.detail = "short"
    assert control_words.detail == "short"


def test_every_state_can_end_in_a_fault_and_come_back() -> None:
    assert set(TRANSITIONS) == set(State)
    for state in State:
        assert may_become(state, State.FAULT)
    # The only way out of a fault is through the self-test, the only way to fly through IDLE.
    assert TRANSITIONS[State.FAULT] == {State.SELF_TEST, State.OFF}
    assert [s for s in State if State.LEVITATING in TRANSITIONS[s] and s is not State.IDLE] == [
        State.EXCITING,
        State.MOVING,
    ]


def test_every_fault_says_cause_check_and_cure() -> None:
    assert set(FAULTS) == set(Fault)
    assert all(t.cause and t.check and t.cleared for f, t in FAULTS.items() if f)


def test_rows_lost_by_a_hung_recorder_are_counted_at_once() -> None:
    shared = SharedMemory(RIG)
    ring = shared.ring
    shared.control_words[Word.DROPPED] = 5
    for waiting, lost in ((0, 0), (ring.capacity - 1, 0), (ring.capacity + 9, 10)):
        ring.head = waiting
        assert shared.lost == 5 + lost
    ring.take(1)
    assert (shared.lost, ring.lost) == (15, 10)
    shared.close()


def test_read_only_memory_shows_what_is_written_and_refuses_every_write() -> None:
    shared = SharedMemory(RIG)
    fd = shared.read_only_fd()
    view = SharedMemory(RIG, fd, read_only=True)
    shared.control_words[Word.CYCLE] = 7
    write(shared.ring, 3)
    assert view.control_words[Word.CYCLE] == 7
    assert view.ring.last(10).rows["cycle"].tolist() == [0, 1, 2]
    with pytest.raises(TypeError, match="read-only"):
        view.control_words[Word.ZERO] = Fault.STOPPED
    with pytest.raises(TypeError, match="read-only"):
        view.ring.head = 9
    for array in (view.ring.rows, view.ring.tags, view.heat, view.timing.counts):
        assert not array.flags.writeable
        with pytest.raises(ValueError, match="WRITEABLE"):
            array.flags.writeable = True
    with pytest.raises(PermissionError):
        mmap.mmap(fd, 4096)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.pwrite(fd, b"x", 0)
    assert shared.control_words[Word.ZERO] == 0
    os.close(fd)
    shared.close()
