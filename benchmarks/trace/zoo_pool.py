"""Many tasks, some at once, each in a process of its own; all run the code there was at first.

What takes hours must not change under way because somebody edits a file: processes are forked from
a server that has imported levid once, and what of the benchmarks is loaded when it starts. One that
hangs, crashes or raises is that task's failure.
"""

from __future__ import annotations

import ctypes
import importlib
import multiprocessing
import os
import pkgutil
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Generic, TypeVar

Item = TypeVar("Item")
Answer = TypeVar("Answer")

_PACKAGES = (
    "levid.config",
    "levid.daemon",
    "levid.drivers",
    "levid.identification",
    "levid.log",
    "levid.model",
    "levid.sim",
)
_HERE = Path(__file__).parent
_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Done(Generic[Item, Answer]):
    """A task's answer, or why there is none; `seconds` of wall time."""

    item: Item
    answer: Answer | None
    failed: str
    seconds: float


@dataclass(frozen=True)
class _Running(Generic[Item]):
    item: Item
    process: ForkServerProcess
    begin: float


def run_apart(
    task: Callable[[Item], Answer], items: Iterable[Item], at_once: int, longest_s: float
) -> Iterator[Done[Item, Answer]]:
    """Yield what comes of task(item) for all items, as they end; `at_once` processes work.

    Task and items must pickle. A task that takes more than `longest_s` is ended.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_modules())
    _found_by_the_server()
    waiting = deque(items)
    running: dict[Connection, _Running[Item]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < at_once:
                ours, theirs = context.Pipe(duplex=False)
                item = waiting.popleft()
                process = context.Process(target=_answer, args=(theirs, task, item), daemon=True)
                process.start()
                theirs.close()
                running[ours] = _Running(item, process, time.monotonic())
            first = min(r.begin for r in running.values()) + longest_s
            ready = wait(list(running), timeout=max(first - time.monotonic(), 0.0))
            now = time.monotonic()
            late = [c for c, r in running.items() if now - r.begin >= longest_s]
            for pipe in {*ready, *late}:
                assert isinstance(pipe, Connection)
                one = running.pop(pipe)
                answer, failed = _received(pipe, one.process, longest_s)
                yield Done(one.item, answer, failed, now - one.begin)
    finally:
        for one in running.values():
            one.process.kill()
            one.process.join()


def _modules() -> list[str]:
    """Return all modules of the packages, those too that are loaded by name late.

    With them those beside this one that are loaded by now, but for the one that was started.
    """
    names = [
        name
        for name, module in sys.modules.items()
        if name not in {"__main__", "__mp_main__"}
        and Path(getattr(module, "__file__", None) or "/").parent == _HERE
    ]
    for name in _PACKAGES:
        package = importlib.import_module(name)
        found = pkgutil.walk_packages(package.__path__, f"{name}.")
        names += [name, *(module.name for module in found)]
    return names


def _found_by_the_server() -> None:
    """Let the server find what lies here: of where its parent looks, it knows the environment."""
    path = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    if str(_HERE) not in path:
        os.environ["PYTHONPATH"] = os.pathsep.join([str(_HERE), *filter(None, path)])


def _received(
    pipe: Connection, process: ForkServerProcess, longest_s: float
) -> tuple[Answer | None, str]:
    try:
        if not pipe.poll():
            return None, f"not done after {longest_s:g} s"
        answer, failed = pipe.recv()
    except EOFError:
        process.join()
        return None, f"its process ended with code {process.exitcode}"
    else:
        return answer, failed
    finally:
        process.kill()
        process.join()
        pipe.close()


def _answer(pipe: Connection, task: Callable[[Item], Answer], item: Item) -> None:
    _die_with_the_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is told as well, and ends us
    try:
        answer: Answer | None = task(item)
    except Exception as error:  # noqa: BLE001 - whatever is raised is this task's entry in the table
        pipe.send((None, f"{type(error).__name__}: {error}"[:300]))
    else:
        pipe.send((answer, ""))
    pipe.close()


def _die_with_the_parent() -> None:
    """A benchmark that is killed leaves nothing behind: its server ends with it, and so do we."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
