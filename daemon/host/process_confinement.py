"""Limit a process that handles client data: processor time, memory, file size, rights."""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

_PR_SET_NO_NEW_PRIVS = 38
_NOBODY = 65_534
_NICE = 10
_LIBC = ctypes.CDLL(None, use_errno=True)
_OOM = Path("/proc/self/oom_score_adj")


@dataclass(frozen=True)
class Confinement:
    """Set the limits of a confined process.

    cpu_s: processor time, s; None: no limit. memory_bytes: additional address space. file_bytes:
    size of a file that it writes, memory files included. keeps_user: whether root stays root.
    """

    cpu_s: int | None
    memory_bytes: int
    file_bytes: int
    keeps_user: bool = False


def at_most_half_memory(limit_bytes: int) -> int:
    """Return `limit_bytes` or half of this machine's memory, whichever is less."""
    pages, page = os.sysconf("SC_PHYS_PAGES"), os.sysconf("SC_PAGE_SIZE")
    return min(limit_bytes, pages * page // 2)


def confine(limits: Confinement, keep_fds: Collection[int]) -> None:
    """Confine this process permanently, and close all files except `keep_fds`.

    It gets a low priority, is killed first if memory runs out, cannot start processes, and changes
    from root to the user `nobody` if permitted. Raises OSError if a limit is refused.
    """
    _close_all_but(keep_fds)
    with contextlib.suppress(OSError):
        _OOM.write_text("1000")
    lower_priority(_NICE)
    if limits.cpu_s is not None:
        _limit(resource.RLIMIT_CPU, limits.cpu_s, limits.cpu_s + 1)
    _limit(resource.RLIMIT_AS, _address_space() + limits.memory_bytes)
    _limit(resource.RLIMIT_FSIZE, limits.file_bytes)
    _limit(resource.RLIMIT_NPROC, 0)
    _limit(resource.RLIMIT_CORE, 0)
    _limit(resource.RLIMIT_RTPRIO, 0)
    if os.geteuid() == 0 and not limits.keeps_user:
        with contextlib.suppress(OSError):  # root in a container without other users
            os.setgroups([])
            os.setresgid(_NOBODY, _NOBODY, _NOBODY)
            os.setresuid(_NOBODY, _NOBODY, _NOBODY)
    if _LIBC.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def lower_priority(nice: int) -> None:
    """Give this thread, and those that it starts later, a nice value higher by `nice`."""
    os.nice(nice)
    with contextlib.suppress(PermissionError):  # a user may not leave SCHED_IDLE, which is lower
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def _limit(what: int, soft: int, hard: int | None = None) -> None:
    """Set a resource limit, or keep the present hard limit if that is lower."""
    wanted = [soft, soft if hard is None else hard]
    before = resource.getrlimit(what)[1]
    if before != resource.RLIM_INFINITY:
        wanted = [min(value, before) for value in wanted]
    resource.setrlimit(what, (wanted[0], wanted[1]))


def _address_space() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * os.sysconf("SC_PAGE_SIZE")


def _close_all_but(keep: Collection[int]) -> None:
    first = 3  # standard input, output and error stay open
    for fd in sorted(keep):
        if fd >= first:
            os.closerange(first, fd)
            first = fd + 1
    os.closerange(first, os.sysconf("SC_OPEN_MAX"))
