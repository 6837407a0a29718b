"""Frames of a bus that cannot be waited for by a deadline, read by a thread of their own.

Some interfaces of python-can wait in whole milliseconds, or for as long as they like: here a thread
waits for them, and who asks for frames waits for the thread, never longer than asked.
"""

from __future__ import annotations

import contextlib
import os
import threading
from queue import Empty, SimpleQueue
from time import monotonic, time
from typing import Protocol

from .kernel_frame import ReceivedFrame

LOOK_S = 0.02
"""How long the thread waits at a time. canalystii sleeps for as long where it is asked to wait for
more than 0.05 s, instead of looking again."""
MOST_WAITING = 4096
"""Frames that nobody asks for are kept up to so many: 0.25 s of the fullest bus there is, and more
than come while a loop that stands still sends no Sync."""
_JOIN_S = 1.0
_PRIORITY_S = 0.1


class OverrunError(Exception):
    """Frames came that nobody asked for, more than are kept."""


class FrameSource(Protocol):
    """What is read: a bus that waits as it can."""

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame, while another thread reads."""

    def receive(self, wait_s: float) -> ReceivedFrame | None:
        """Return the next frame, None if none came; raises what the bus raises."""

    def shutdown(self) -> None:
        """Close the bus."""


class ReadAhead:
    """A bus whose `receive` ends by its time, whatever the interface behind it does.

    What the interface raises is raised by the `receive` that comes to it; frames before it come
    first. Reading goes on after that, since some errors are of one frame alone.
    """

    def __init__(self, source: FrameSource) -> None:
        self._source = source
        self._queue: SimpleQueue[ReceivedFrame | Exception] = SimpleQueue()
        self._lost = 0
        self._reader_for = threading.get_native_id()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="levid-can-reader", daemon=True)
        self._thread.start()

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame at once; raises what the bus raises."""
        self._source.send(can_id, data)

    def receive(self, wait_s: float) -> ReceivedFrame | None:
        """Return the next frame, None if none comes within `wait_s`.

        Raises:
            OverrunError: frames were lost, since nobody asked for those before them.
            Exception: whatever the bus raised.
        """
        self._reader_for = threading.get_native_id()
        if self._lost:
            lost, self._lost = self._lost, 0
            raise OverrunError(f"{lost} frames lost: nobody took the {MOST_WAITING} before them")
        try:
            came = self._queue.get(wait_s > 0.0, max(wait_s, 0.0))
        except Empty:
            return None
        if isinstance(came, Exception):
            raise came
        return came

    def shutdown(self) -> None:
        """End the thread and close the bus.

        A thread that the interface does not let go of within a second is left behind: closing the
        bus mostly ends it, and the process does.
        """
        self._ending.set()
        self._thread.join(_JOIN_S)
        self._source.shutdown()

    def _run(self) -> None:
        looked_s = -_PRIORITY_S
        while not self._ending.is_set():
            if monotonic() - looked_s > _PRIORITY_S:
                looked_s = monotonic()
                self._keep_up()
            try:
                came = self._source.receive(LOOK_S)
            except Exception as error:  # noqa: BLE001 - interfaces raise whatever they meet
                self._keep(error)
                self._ending.wait(LOOK_S)  # an adapter that is gone fails without waiting
                continue
            if came is not None:
                self._keep(came if came.stamp_s > 0.0 else came._replace(stamp_s=time()))

    def _keep(self, came: ReceivedFrame | Exception) -> None:
        if self._queue.qsize() < MOST_WAITING:
            self._queue.put(came)
        else:
            self._lost += 1

    def _keep_up(self) -> None:
        """Run at the priority of who asks, or next to it: it waits for the interpreter meanwhile.

        At ordinary priority any other process could prolong that; at the same one an interface that
        fails without waiting could keep the processor.
        """
        with contextlib.suppress(OSError):
            policy = os.sched_getscheduler(self._reader_for)
            least = os.sched_get_priority_min(policy)
            priority = max(os.sched_getparam(self._reader_for).sched_priority - 1, least)
            if (policy, priority) != (
                os.sched_getscheduler(0),
                os.sched_getparam(0).sched_priority,
            ):
                os.sched_setscheduler(0, policy, os.sched_param(priority))
