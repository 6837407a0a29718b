"""Give each new client a place: if all are taken, the client that is idle longest gives way.

A limit that refuses newcomers lets any local program lock out the user's STOP by connecting often
enough and sending nothing.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from enum import IntEnum

_ACCEPTED_AT_ONCE = 8
"""Fewer than there are places, so that a client that sends its request at once is heard before
later clients can displace it."""
_QUEUE = 128


class Rank(IntEnum):
    """What a client does; lower ranks give way first."""

    WAITS = 0  # it has sent no valid request yet
    READS = 1  # it reads a stream
    ASKS = 2  # its request is executed: it never gives way


class Place:
    """The place of one client; `close` disconnects it."""

    def __init__(self, places: ClientPlaces, close: Callable[[], None]) -> None:
        self._places, self.close = places, close
        self.rank = Rank.WAITS

    def set_rank(self, rank: Rank) -> None:
        """Set what the client does now."""
        self.rank = rank
        self._places.moved_last(self)

    def leave(self) -> None:
        """Free the place; safe to call twice."""
        self._places.remove(self)


class ClientPlaces:
    """Places for at most `most` clients."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._taken: dict[Place, None] = {}  # the client that did nothing for longest is first

    def enter(self, close: Callable[[], None]) -> Place | None:
        """Return a place for a new client, which `close` disconnects.

        If all are taken, the first client of the lowest rank is disconnected. None if all clients
        have requests in execution.
        """
        if len(self._taken) >= self._most:
            idle = min(self._taken, key=lambda place: place.rank)  # the first of equal ones
            if idle.rank is Rank.ASKS:
                return None
            del self._taken[idle]
            idle.close()
        place = Place(self, close)
        self._taken[place] = None
        return place

    def moved_last(self, place: Place) -> None:
        """Make a client the last one of its rank to give way."""
        if place in self._taken:
            del self._taken[place]
            self._taken[place] = None

    def remove(self, place: Place) -> None:
        """Free a place if it is taken."""
        self._taken.pop(place, None)

    def __len__(self) -> int:
        return len(self._taken)


async def listen(
    factory: Callable[[], asyncio.BaseProtocol], address: str, port: int
) -> asyncio.Server:
    """Serve a port with a protocol for each client; raises OSError."""
    loop = asyncio.get_running_loop()
    listener = socket.create_server((address, port))
    try:
        # asyncio accepts as many clients in a row as its backlog.
        server = await loop.create_server(factory, sock=listener, backlog=_ACCEPTED_AT_ONCE)
        listener.listen(_QUEUE)
    except BaseException:
        listener.close()
        raise
    return server
