"""Configure real-time scheduling of the loop process: priority, affinity, memory lock, timers."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import gc
import os
import signal
import struct
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path

from ...config.daemon_settings import Realtime

_PR_SET_PDEATHSIG = 1
_PR_SET_NAME = 15
_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_DMA_LATENCY = Path("/dev/cpu_dma_latency")
_OF_HOSTS = ("hypervisor", "fw-cfg@*")
_REFUSED = {
    errno.EPERM: "not permitted",
    errno.EACCES: "not permitted",
    errno.ENOMEM: "more than this user may lock",
    errno.EINVAL: "no such processor",
}
_LIMITS = {"priority": "* - rtprio 95", "lock_memory": "* - memlock unlimited"}
"""Lines of /etc/security/limits.conf that permit a setting to every user."""
_LIBC = ctypes.CDLL(None, use_errno=True)


def apply_realtime(settings: Realtime) -> list[str]:
    """Apply real-time settings; return a warning for each that is not permitted.

    The settings last until the process ends, /dev/cpu_dma_latency included.
    """
    parts: list[tuple[str, str, Callable[[], None]]] = [
        (
            f"realtime.timer_slack_ns {settings.timer_slack_ns}",
            "the kernel wakes the loop about 50 us late",
            lambda: _prctl(_PR_SET_TIMERSLACK, settings.timer_slack_ns),
        )
    ]
    if settings.cpus:
        parts.append(
            (
                f"realtime.cpus {list(settings.cpus)}",
                "the loop moves between processors",
                lambda: os.sched_setaffinity(0, settings.cpus),
            )
        )
    if settings.lock_memory:
        parts.append(
            ("realtime.lock_memory", "a swapped-out page may stall the loop", _lock_memory)
        )
    latency_us = cpu_latency_us(settings)
    if latency_us is not None:
        parts.append(
            (
                f"realtime.cpu_latency_us {latency_us}",
                "processor sleep states delay the loop",
                partial(_hold_latency, latency_us),
            )
        )
    if settings.priority:
        parts.append(
            (
                f"realtime.priority {settings.priority}",
                "any other process may delay the loop",
                lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(settings.priority)),
            )
        )
    warnings = []
    for name, consequence, apply in parts:
        try:
            apply()
        except OSError as error:
            why = _REFUSED.get(error.errno or 0, str(error.strerror))
            warnings.append(f"{name}: {why}: {consequence}; {_remedy(name)}")
    return warnings


def _remedy(name: str) -> str:
    """Return how this user may apply a setting of RIG.yaml, named as in the warnings."""
    key = name.removeprefix("realtime.").partition(" ")[0]
    if key == "cpus":
        return f"choose from the processors {_ranges(os.sched_getaffinity(0))}"
    limit = _LIMITS.get(key)
    allow = f"add '{limit}' to /etc/security/limits.conf and log in again, or " if limit else ""
    return f"{allow}run levid as the service (levid install-service)"


def _ranges(cpus: Collection[int]) -> str:
    ordered = sorted(cpus)
    whole = ordered == list(range(ordered[0], ordered[-1] + 1)) and len(ordered) > 1
    return f"{ordered[0]} to {ordered[-1]}" if whole else ", ".join(map(str, ordered))


def avoid_cpus(cpus: Collection[int]) -> None:
    """Keep this process and its children off the loop's processors, if there are other processors.

    A system call of the recorder may delay the loop despite its priority: kernels without
    preemption do not interrupt it, others not everywhere.
    """
    remaining = os.sched_getaffinity(0).difference(cpus)
    if cpus and remaining:
        _bind(remaining)


def allow_cpus(cpus: Collection[int]) -> None:
    """Undo `avoid_cpus` in the loop process: its helper threads may run on all processors."""
    if cpus:
        _bind(os.sched_getaffinity(0).union(cpus))


def _bind(cpus: Collection[int]) -> None:
    """Bind all threads of this process to those of `cpus` that exist."""
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):  # the thread has ended, or none of the cpus exists
            os.sched_setaffinity(int(thread.name), cpus)


def cpu_latency_us(settings: Realtime) -> int | None:
    """Return the longest permitted wake-up latency of processors, in us; None: do not set it.

    With 0, an idle processor polls instead of sleeping. The host of a virtual machine counts that
    as use, and a host with processor quotas then takes processors away for ms: at 1 kHz beside a
    bus in Python, one period in thirty was skipped. "auto" therefore sets none there.
    """
    if settings.cpu_latency_us == "auto":
        return None if virtual_machine() else 0
    return settings.cpu_latency_us


def virtual_machine(
    cpuinfo: Path = Path("/proc/cpuinfo"), device_tree: Path = Path("/proc/device-tree")
) -> bool:
    """Return whether the kernel reports a hypervisor; on ARM only through a device tree."""
    try:
        if any(True for name in _OF_HOSTS for _ in device_tree.glob(name)):
            return True
        text = cpuinfo.read_text()
    except OSError:
        return False
    flags = (line.split() for line in text.splitlines() if line.startswith("flags"))
    return any("hypervisor" in words for words in flags)


def set_process_name(name: str) -> None:
    """Set the name of this process in `ps` and `top`."""
    with contextlib.suppress(OSError):
        _prctl(_PR_SET_NAME, ctypes.create_string_buffer(name.encode()[:15]))


def signal_at_parent_death(parent: int, number: signal.Signals) -> None:
    """Have the kernel send this signal when the parent process ends; exit if it has ended."""
    with contextlib.suppress(OSError):
        _prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:
        raise SystemExit(1)


@contextlib.contextmanager
def no_collections() -> Iterator[None]:
    """Disable the garbage collector: a full collection stalls the loop for many periods."""
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


_open_fds: list[int] = []


def _hold_latency(latency_us: int) -> None:
    # The setting lasts while the file is open: keep the descriptor.
    fd = os.open(_DMA_LATENCY, os.O_WRONLY | os.O_CLOEXEC)
    os.write(fd, struct.pack("=i", latency_us))
    _open_fds.append(fd)


def _prctl(option: int, value: object) -> None:
    if _LIBC.prctl(option, value, 0, 0, 0):
        _raise()


def _raise() -> None:
    number = ctypes.get_errno()
    raise OSError(number, os.strerror(number))
