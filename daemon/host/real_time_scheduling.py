"""What the loop's process asks of the kernel so that it wakes up on time; each part is optional."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import struct
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path

from ...config.service import Realtime

_PR_SET_PDEATHSIG = 1
_PR_SET_NAME = 15
_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_DMA_LATENCY = Path("/dev/cpu_dma_latency")
_CPUINFO = Path("/proc/cpuinfo")
_DEVICE_TREE, _OF_HOSTS = Path("/proc/device-tree"), ("hypervisor", "fw-cfg@*")
_LIBC = ctypes.CDLL(None, use_errno=True)


def be_punctual(wanted: Realtime) -> list[str]:
    """Ask for all that `wanted` names; return a warning for each part that is not permitted.

    What is asked for holds until the process ends, /dev/cpu_dma_latency among it.
    """
    parts: list[tuple[str, str, Callable[[], None]]] = [
        (
            f"realtime.timer_slack_ns {wanted.timer_slack_ns}",
            "the kernel wakes the loop some 50 us late",
            lambda: _prctl(_PR_SET_TIMERSLACK, wanted.timer_slack_ns),
        )
    ]
    if wanted.cpus:
        parts.append(
            (
                f"realtime.cpus {list(wanted.cpus)}",
                "the loop moves between processors",
                lambda: os.sched_setaffinity(0, wanted.cpus),
            )
        )
    if wanted.lock_memory:
        parts.append(
            ("realtime.lock_memory", "a page that was swapped out stalls the loop", _lock_memory)
        )
    latency_us = cpu_latency_us(wanted)
    if latency_us is not None:
        parts.append(
            (
                f"realtime.cpu_latency_us {latency_us}",
                "the processor's sleep states delay the loop",
                partial(_hold_latency, latency_us),
            )
        )
    if wanted.priority:
        parts.append(
            (
                f"realtime.priority {wanted.priority}",
                "any other process may delay the loop",
                lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(wanted.priority)),
            )
        )
    warnings = []
    for name, so, ask in parts:
        try:
            ask()
        except OSError as error:
            warnings.append(f"{name}: {error.strerror}: {so}")
    return warnings


def leave_to_loop(cpus: Collection[int]) -> None:
    """Keep this process, and those that it starts, off the loop's processors if there are others.

    What a recorder does within the kernel is not interrupted for whoever has priority: not by a
    kernel that preempts nothing, and not everywhere by others.
    """
    others = os.sched_getaffinity(0).difference(cpus)
    if cpus and others:
        _bind(others)


def share_with_others(cpus: Collection[int]) -> None:
    """Undo that in the loop's process: its helpers run where the others do, and where it does."""
    if cpus:
        _bind(os.sched_getaffinity(0).union(cpus))


def _bind(cpus: Collection[int]) -> None:
    """Let all threads of this process run on these alone; those of them that there are count."""
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):  # it has ended, or none of them is there
            os.sched_setaffinity(int(thread.name), cpus)


def cpu_latency_us(wanted: Realtime) -> int | None:
    """Return how soon, in us, processors that sleep must be awake; None where it is left alone.

    Kept from all sleep, a processor polls while it has nothing to do. In a virtual machine ("auto")
    its host counts that as use, and one that grants shares of its processors takes them away for
    ms at a time: at 1 kHz beside a bus in Python, one period in thirty was skipped.
    """
    if wanted.cpu_latency_us == "auto":
        return None if virtual_machine() else 0
    return wanted.cpu_latency_us


def virtual_machine() -> bool:
    """Return whether the kernel knows of a hypervisor below it; ARM's tells where it has a tree."""
    try:
        if any(True for name in _OF_HOSTS for _ in _DEVICE_TREE.glob(name)):
            return True
        told = _CPUINFO.read_text()
    except OSError:
        return False
    flags = (line.split() for line in told.splitlines() if line.startswith("flags"))
    return any("hypervisor" in words for words in flags)


def call_me(name: str) -> None:
    """Give this process a name for `ps` and `top`."""
    with contextlib.suppress(OSError):
        _prctl(_PR_SET_NAME, ctypes.create_string_buffer(name.encode()[:15]))


def die_with(parent: int, number: signal.Signals) -> None:
    """Let the kernel send this signal when the parent process is gone; exit if it is already."""
    with contextlib.suppress(OSError):
        _prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:
        raise SystemExit(1)


@contextlib.contextmanager
def no_collections() -> Iterator[None]:
    """Keep the garbage collector out: a walk over all that was imported stalls many periods."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


def _lock_memory() -> None:
    if _LIBC.mlockall(_MCL_CURRENT | _MCL_FUTURE):
        _raise()


_held: list[int] = []


def _hold_latency(latency_us: int) -> None:
    # It holds for as long as the file is open: the descriptor is kept on purpose.
    fd = os.open(_DMA_LATENCY, os.O_WRONLY | os.O_CLOEXEC)
    os.write(fd, struct.pack("=i", latency_us))
    _held.append(fd)


def _prctl(option: int, value: object) -> None:
    if _LIBC.prctl(option, value, 0, 0, 0):
        _raise()


def _raise() -> None:
    number = ctypes.get_errno()
    raise OSError(number, os.strerror(number))
