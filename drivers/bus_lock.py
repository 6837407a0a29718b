"""Lock a bus for one loop on this machine: two loops would reset each other's devices."""

from __future__ import annotations

import errno
import hashlib
import socket

from .base import LinkError


class BusLock:
    """A named lock that one process of this machine can hold; it is freed when the process ends."""

    def __init__(self, name: str) -> None:
        # An abstract socket address: a killed process leaves no file, and it is local to a network
        # namespace, as CAN interfaces are. The name is hashed because an address has 107 bytes.
        self._address = f"\0levid-{hashlib.sha256(name.encode()).hexdigest()}"
        self._held: socket.socket | None = None

    def acquire(self) -> bool:
        """Acquire the lock, or keep it; returns False if another process holds it.

        Raises:
            OSError: the lock cannot be acquired for another reason.
        """
        if self._held is not None:
            return True
        held = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            held.bind(self._address)
        except OSError as error:
            held.close()
            if error.errno != errno.EADDRINUSE:
                raise
            return False
        self._held = held
        return True

    def require(self, what: str) -> None:
        """Acquire the lock, or keep it; raises LinkError, which names the bus `what`."""
        try:
            acquired = self.acquire()
        except OSError as error:
            raise LinkError(f"{what}: cannot be locked: {error}") from None
        if not acquired:
            raise LinkError(f"{what}: another loop on this machine uses it; stop that one first")

    def release(self) -> None:
        """Release the lock; safe to call twice."""
        held, self._held = self._held, None
        if held is not None:
            held.close()
