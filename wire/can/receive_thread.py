"""Read a CAN bus in a thread, so that `receive` keeps its deadline.

Some interfaces of python-can round timeouts to milliseconds or exceed them. The thread waits for
the interface; `receive` waits for the thread.
"""

from __future__ import annotations

import contextlib
import os
import threading
from queue import Empty, SimpleQueue
from time import monotonic, time
from typing import Protocol

from .kernel_frame import ReceivedFrame

POLL_S = 0.02
"""Timeout of the thread. canalystii sleeps for the whole timeout if it exceeds 0.05 s, without
polling."""
QUEUE_FRAMES = 4096
"""Size of the queue in frames: 0.25 s of the busiest bus, and more than arrive while a stalled loop
sends no Sync."""
_PRIORITY_S = 0.1


class OverrunError(Exception):
    """The queue was full, and frames were lost."""


class FrameSource(Protocol):
    """A bus with inaccurate timeouts."""

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame, while another thread reads."""

    def receive(self, wait_s: float) -> ReceivedFrame | None:
        """Return the next frame, None if none arrived; raises the error of the bus."""

    def shutdown(self) -> None:
        """Close the bus."""


class ReceiveThread:
    """A bus whose `receive` keeps its timeout.

    `receive` returns frames and raises errors in their order. Reading continues after an error,
    because some errors concern a single frame.
    """

    def __init__(self, source: FrameSource, join_s: float = 1.0) -> None:
        self._source, self._join_s = source, join_s
        self._queue: SimpleQueue[ReceivedFrame | Exception] = SimpleQueue()
        self._lost = 0
        self._reader = threading.get_native_id()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="levid-can-reader", daemon=True)
        self._thread.start()

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame at once; raises the error of the bus."""
        self._source.send(can_id, data)

    def receive(self, wait_s: float) -> ReceivedFrame | None:
        """Return the next frame, None if none arrives within `wait_s`.

        Raises:
            OverrunError: frames were lost, because the queue was full.
            Exception: the error of the bus.
        """
        self._reader = threading.get_native_id()
        if self._lost:
            lost, self._lost = self._lost, 0
            raise OverrunError(f"{lost} frames lost: the queue of {QUEUE_FRAMES} frames was full")
        try:
            item = self._queue.get(wait_s > 0.0, max(wait_s, 0.0))
        except Empty:
            return None
        if isinstance(item, Exception):
            raise item
        return item

    def shutdown(self) -> None:
        """End the thread and close the bus.

        A thread that does not end within `join_s` is abandoned: closing the bus mostly ends it, the
        end of the process always does.
        """
        self._ending.set()
        self._thread.join(self._join_s)
        self._source.shutdown()

    def _run(self) -> None:
        checked_s = -_PRIORITY_S
        while not self._ending.is_set():
            if monotonic() - checked_s > _PRIORITY_S:
                checked_s = monotonic()
                self._raise_priority()
            try:
                item = self._source.receive(POLL_S)
            except Exception as error:  # noqa: BLE001 - interfaces raise any exception
                self._enqueue(error)
                self._ending.wait(POLL_S)  # a lost adapter fails without waiting
                continue
            if item is not None:
                self._enqueue(item if item.stamp_s > 0.0 else item._replace(stamp_s=time()))

    def _enqueue(self, item: ReceivedFrame | Exception) -> None:
        if self._queue.qsize() < QUEUE_FRAMES:
            self._queue.put(item)
        else:
            self._lost += 1

    def _raise_priority(self) -> None:
        """Set the priority of this thread one below that of the reader, which waits for it.

        At ordinary priority any process could delay the reader; at equal priority an interface that
        fails without waiting could block it.
        """
        with contextlib.suppress(OSError):
            policy = os.sched_getscheduler(self._reader)
            least = os.sched_get_priority_min(policy)
            priority = max(os.sched_getparam(self._reader).sched_priority - 1, least)
            if (policy, priority) != (
                os.sched_getscheduler(0),
                os.sched_getparam(0).sched_priority,
            ):
                os.sched_setscheduler(0, policy, os.sched_param(priority))
