"""Run tasks in processes that keep the records that they have read (cache affinity)."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from multiprocessing.context import BaseContext
from threading import Lock
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
Answer = TypeVar("Answer")
Size = Callable[[Any], tuple[Hashable, int] | None]


class RecordAffinityPool(Executor):
    """Processes of one worker each; a task about a record goes to the process that has read it.

    To read a record again, and prepare it, costs as much as many a task. The home of a record is
    the process with the least to keep when it is first asked about. A task goes elsewhere if
    another process would have done it before its home begins with it.

    `size` returns the key and the length of the record among a task's arguments, None for others.
    """

    def __init__(
        self, count: int, context: BaseContext, initializer: Callable[[], None], size: Size
    ) -> None:
        self._pools = [
            ProcessPoolExecutor(1, mp_context=context, initializer=initializer)
            for _ in range(count)
        ]
        self._size, self._lock = size, Lock()
        self._kept, self._waiting = [0] * count, [0] * count
        self._homes: dict[Hashable, int] = {}

    def submit(
        self, fn: Callable[P, Answer], /, *args: P.args, **kwargs: P.kwargs
    ) -> Future[Answer]:
        """Schedule a call, and return its future."""
        record = next((found for one in args if (found := self._size(one)) is not None), None)
        key, length = record or (None, 1)
        with self._lock:
            number = self._free() if record is None else self._place(key, length)
            self._waiting[number] += length
        try:
            future = self._pools[number].submit(fn, *args, **kwargs)
        except BaseException:
            self._done(number, length)
            raise
        future.add_done_callback(lambda _: self._done(number, length))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes, once their tasks are done or at once."""
        for pool in self._pools:
            pool.shutdown(wait=False, cancel_futures=cancel_futures)
        for pool in self._pools:
            pool.shutdown(wait=wait, cancel_futures=cancel_futures)

    def _place(self, key: Hashable, length: int) -> int:
        if key not in self._homes:
            home = self._kept.index(min(self._kept))
            self._homes[key] = home
            self._kept[home] += length
        home, free = self._homes[key], self._free()
        return free if self._waiting[home] - self._waiting[free] > length else home

    def _free(self) -> int:
        return self._waiting.index(min(self._waiting))

    def _done(self, number: int, length: int) -> None:
        with self._lock:
            self._waiting[number] -= length
