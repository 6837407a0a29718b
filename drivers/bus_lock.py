"""Lock a bus for one loop on this machine: two loops would reset each other's devices.

A lock is a file in a folder that only users of the rig can enter, held by flock until its process
ends. With the service installed, that is the state folder of the service, for the group levid, so
that loops of different users exclude each other. Else it is a folder of this user, and a loop of
another user is not noticed. A name that any user can take, such as an abstract socket, would let
anybody on the machine keep the rig from flying.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import stat
from contextlib import suppress
from pathlib import Path

from ..config.runtime.private_files import make_private_folder, user_name
from ..config.runtime.user_folders import account_home, temporary_folder
from .base import LinkError

SERVICE_STATE = Path("/var/lib/levid")
RUN = Path("/run")
_FLAGS = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
_BOOT_ID, _NETWORK = Path("/proc/sys/kernel/random/boot_id"), Path("/proc/self/ns/net")


class BusLock:
    """A named lock that one process of this machine can hold; it is freed when the process ends.

    It holds in one network namespace, as CAN interfaces do.
    """

    def __init__(self, name: str) -> None:
        # A home folder may be shared by machines.
        with suppress(OSError):
            name += f"\0{_BOOT_ID.read_text().strip()}\0{_NETWORK.stat().st_ino}"
        self._file = f"{hashlib.sha256(name.encode()).hexdigest()[:32]}.lock"
        self._held: int | None = None

    def acquire(self) -> bool:
        """Acquire the lock, or keep it; returns False if another process holds it.

        Raises:
            OSError: the lock cannot be acquired for another reason.
        """
        if self._held is not None:
            return True
        handle = self._open()
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            return False
        except BaseException:
            os.close(handle)
            raise
        self._held = handle
        return True

    def require(self, what: str) -> None:
        """Acquire the lock, or keep it; raises LinkError, which names the bus `what`."""
        try:
            acquired = self.acquire()
        except OSError as error:
            raise LinkError(f"{what}: cannot be locked: {error}") from None
        if not acquired:
            by = self.holder()
            raise LinkError(
                f"{what}: another loop on this machine uses it{by and f': {by}'}; stop that one "
                "first"
            )

    def release(self) -> None:
        """Release the lock; safe to call twice."""
        held, self._held = self._held, None
        if held is not None:
            os.close(held)

    def holder(self) -> str:
        """Return the process that holds the lock, and its user; empty if the kernel hides it."""
        try:
            handle = self._open()
        except OSError:
            return ""
        try:
            found = os.fstat(handle)
            device = f"{os.major(found.st_dev):02x}:{os.minor(found.st_dev):02x}:{found.st_ino}"
            for line in Path("/proc/locks").read_text().splitlines():
                fields = line.split()
                if fields[1] == "FLOCK" and fields[5] == device and int(fields[4]) > 0:
                    return _process(int(fields[4]))
        except (OSError, IndexError, ValueError):
            pass
        finally:
            os.close(handle)
        return ""

    def _open(self) -> int:
        """Return a descriptor of the lock file; creates it. Raises OSError."""
        path = lock_folder() / self._file
        for _ in range(2):
            try:
                # Without O_CREAT: the kernel refuses that for files of other users in some folders.
                return os.open(path, _FLAGS)
            except FileNotFoundError:
                pass
            with suppress(FileExistsError):
                handle = os.open(path, _FLAGS | os.O_CREAT | os.O_EXCL, 0o640)
                os.fchmod(handle, 0o640)  # whatever the umask: others of the group open it
                return handle
        return os.open(path, _FLAGS)


def lock_folder() -> Path:
    """Return the folder of the locks; creates it. Raises OSError if this user can have none."""
    shared = SERVICE_STATE / "locks"
    with suppress(OSError):
        if not shared.is_dir():
            shared.mkdir()
            shared.chmod(0o2770)
    with suppress(OSError):
        found = shared.lstat()
        entered = os.access(shared, os.W_OK | os.X_OK)
        if stat.S_ISDIR(found.st_mode) and not found.st_mode & stat.S_IWOTH and entered:
            return shared
    # By the account, not by HOME: all loops of this user must find the same folder.
    home = account_home()
    if home is not None and make_private_folder(home / ".local" / "state" / "levid" / "locks"):
        return home / ".local" / "state" / "levid" / "locks"
    # Root has /run where all other file systems are read-only.
    own = temporary_folder()
    for folder in (RUN / own.name, own):
        if make_private_folder(folder) and make_private_folder(folder / "locks"):
            return folder / "locks"
    raise PermissionError(
        errno.EACCES, "expected a folder that this user owns, or none: remove it", str(own)
    )


def _process(pid: int) -> str:
    """Return how messages name a process: id, command, user."""
    name = user = ""
    with suppress(OSError, IndexError, ValueError):
        fields = dict(
            line.split(":\t", 1)
            for line in Path(f"/proc/{pid}/status").read_text().splitlines()
            if ":\t" in line
        )
        name = f" ({fields['Name']})"
        user = f" of {user_name(int(fields['Uid'].split()[1]))}"
    return f"process {pid}{name}{user}"
