"""Forbid system calls of this process with seccomp, so that it only uses descriptors it has open.

Limits of a user do not confine a process that runs as the same user as the rest of the daemon: it
could write other processes' memory, kill them, or connect to their sockets.
"""

from __future__ import annotations

import ctypes
import os
import platform
import socket
import struct

_SET_FILTER, _ALL_THREADS = 1, 1
_ALLOW, _ERRNO = 0x7FFF0000, 0x00050000
_EPERM, _ENOSYS = 1, 38
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_NUMBER, _ARCHITECTURE, _ARGUMENTS = 0, 4, 16
"""Offsets in struct seccomp_data."""
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
_CLONE_THREAD = 0x00010000
_X32 = 0x40000000

_ARCHITECTURES = {"x86_64": (0xC000003E, 0), "aarch64": (0xC00000B7, 1)}
_SECCOMP = (317, 277)
_OPENAT, _OPEN, _CLONE, _TGKILL = (257, 56), (2, None), (56, 220), (234, 131)
_SOCKET, _PRLIMIT = (41, 198), (302, 261)
_NOT_THERE = {"clone3": (435, 435), "openat2": (437, 437)}
"""Calls whose arguments a filter cannot read: libraries then use the older ones."""
_FORBIDDEN: dict[str, tuple[int | None, int | None]] = {
    # processes: start, watch, change, end
    "execve": (59, 221),
    "execveat": (322, 281),
    "fork": (57, None),
    "vfork": (58, None),
    "ptrace": (101, 117),
    "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271),
    "pidfd_open": (434, 434),
    "pidfd_getfd": (438, 438),
    "pidfd_send_signal": (424, 424),
    "kill": (62, 129),
    "tkill": (200, 130),
    "rt_sigqueueinfo": (129, 138),
    "rt_tgsigqueueinfo": (297, 240),
    # priorities and processors, also of other processes
    "setpriority": (141, 140),
    "sched_setparam": (142, 118),
    "sched_setscheduler": (144, 119),
    "sched_setaffinity": (203, 122),
    "sched_setattr": (314, 274),
    "ioprio_set": (251, 30),
    # waiting for clients at other sockets than those that are open
    "bind": (49, 200),
    # files
    "creat": (85, None),
    "truncate": (76, 45),
    "unlink": (87, None),
    "unlinkat": (263, 35),
    "rename": (82, None),
    "renameat": (264, 38),
    "renameat2": (316, 276),
    "link": (86, None),
    "linkat": (265, 37),
    "symlink": (88, None),
    "symlinkat": (266, 36),
    "mkdir": (83, None),
    "mkdirat": (258, 34),
    "rmdir": (84, None),
    "chmod": (90, None),
    "fchmod": (91, 52),
    "fchmodat": (268, 53),
    "fchmodat2": (452, 452),
    "chown": (92, None),
    "fchown": (93, 55),
    "lchown": (94, None),
    "fchownat": (260, 54),
    "open_by_handle_at": (304, 265),
    # ways around the filter
    "io_uring_setup": (425, 425),
    "unshare": (272, 97),
    "setns": (308, 268),
    "mount": (165, 40),
    "bpf": (321, 280),
}
_LIBC = ctypes.CDLL(None, use_errno=True)


def forbid_syscalls() -> str:
    """Forbid all threads of this process system calls that reach other processes or change files.

    The process can then no longer start, signal or trace processes. It opens files only to read,
    and connects only to Internet addresses, because the server of a local socket would see its
    user, who may have more rights. It keeps its open descriptors and may start threads. Requires
    "no new privileges" (`confine`). Returns a warning if this kernel or processor has no such
    filter, else "".
    """
    known = _ARCHITECTURES.get(platform.machine())
    if known is None:
        return f"no system calls are forbidden on {platform.machine()}"
    architecture, column = known
    program = _program(architecture, column, os.getpid())
    text = ctypes.create_string_buffer(b"".join(program))
    argument = ctypes.create_string_buffer(struct.pack("@HP", len(program), ctypes.addressof(text)))
    call = _SECCOMP[column]
    if _LIBC.syscall(call, _SET_FILTER, _ALL_THREADS, argument):
        return f"no system calls are forbidden: {os.strerror(ctypes.get_errno())}"
    return ""


def _program(architecture: int, column: int, pid: int) -> list[bytes]:
    """Return the instructions (BPF) of the filter."""
    refuse = _step(_RETURN, _ERRNO | _EPERM)
    program = [
        _step(_LOAD, _ARCHITECTURE),
        _step(_EQUAL, architecture, 1, 0),
        refuse,
        _step(_LOAD, _NUMBER),
        _step(_AT_LEAST, _X32, 0, 1),
        refuse,
    ]
    for numbers in _NOT_THERE.values():
        program += [
            _step(_EQUAL, numbers[column], 0, 1),
            _step(_RETURN, _ERRNO | _ENOSYS),
        ]
    for entry in _FORBIDDEN.values():
        number = entry[column]
        if number is not None:
            program += [_step(_EQUAL, number, 0, 1), refuse]
    for call, index, value, bits in (
        (_OPENAT, 2, _WRITES, True),
        (_OPEN, 1, _WRITES, True),
        (_CLONE, 0, _CLONE_THREAD, None),
        (_TGKILL, 0, pid, False),
        (_SOCKET, 0, socket.AF_INET, False),
        (_PRLIMIT, 0, 0, False),  # of this process
    ):
        number = call[column]
        if number is None:
            continue
        program += [
            _step(_EQUAL, number, 0, 4),
            _step(_LOAD, _ARGUMENTS + 8 * index),
            # Any of these bits is refused; or this bit, or this value, is required.
            _step(_EQUAL if bits is False else _ANY_BIT, value, *((0, 1) if bits else (1, 0))),
            refuse,
            _step(_RETURN, _ALLOW),
        ]
    return [*program, _step(_RETURN, _ALLOW)]


def _step(code: int, value: int, if_true: int = 0, if_false: int = 0) -> bytes:
    return struct.pack("=HBBI", code, if_true, if_false, value)
