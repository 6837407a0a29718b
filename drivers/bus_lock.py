"""What one loop has for itself: of two on one bus each would reset what the other flies with."""

from __future__ import annotations

import errno
import hashlib
import socket

from .base import LinkError


class Claim:
    """A name that one process of this machine can hold; it is free again when that is gone."""

    def __init__(self, name: str) -> None:
        # An abstract address: no file that a killed process would leave behind, and one for each
        # network namespace, as CAN interfaces are. It has 107 bytes; a name may be any path.
        self._address = f"\0levid-{hashlib.sha256(name.encode()).hexdigest()}"
        self._held: socket.socket | None = None

    def take(self) -> bool:
        """Take it, or keep it; returns False where somebody else has it.

        Raises:
            OSError: it cannot be taken for another reason.
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
        """Take it, or keep it; raises LinkError that names `what` it is for."""
        try:
            free = self.take()
        except OSError as error:
            raise LinkError(f"{what}: cannot be claimed: {error}") from None
        if not free:
            raise LinkError(f"{what}: another loop on this machine flies on it")

    def release(self) -> None:
        """Let others have it; safe to call twice."""
        held, self._held = self._held, None
        if held is not None:
            held.close()
