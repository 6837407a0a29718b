"""Who may ask the daemon: users and groups, by what the kernel says of the peer of a socket."""

from __future__ import annotations

import grp
import os
import pwd
import socket
import struct
from dataclasses import dataclass

from ...config.base import ConfigError
from ...config.service import Service

_SO_PEERGROUPS = 59
_MOST_BYTES = 1024
"""What Python's getsockopt takes at most: 256 groups."""


@dataclass(frozen=True)
class Peer:
    """The process at the other end of a socket, with all of its groups."""

    pid: int
    uid: int
    gids: frozenset[int]


def peer_of(connection: socket.socket) -> Peer:
    """Return who connected; raises OSError."""
    size = struct.calcsize("3i")
    raw = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size)
    pid, uid, gid = struct.unpack("3i", raw)
    gids = {gid}
    try:
        groups = connection.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, _MOST_BYTES)
        gids |= set(struct.unpack(f"{len(groups) // 4}i", groups))
    except OSError:
        pass  # an old kernel, or hundreds of groups: the first one has to do
    return Peer(pid, uid, frozenset(gids))


class Access:
    """Root, the daemon's own user and group, and whom service.allow_users and _groups name.

    Raises:
        ConfigError: there is no such user or group.
    """

    def __init__(self, config: Service) -> None:
        self._uids = {0, os.geteuid(), *map(_uid, config.allow_users)}
        self._gids = {os.getegid(), *map(_gid, config.allow_groups)}
        self.others = bool(config.allow_users or config.allow_groups)

    @property
    def mode(self) -> int:
        """Mode of the socket: with others than user and group the kernel cannot tell them apart."""
        return 0o666 if self.others else 0o660

    def refuses(self, peer: Peer) -> str:
        """Return why this peer may not ask; empty where it may."""
        if peer.uid in self._uids or peer.gids & self._gids:
            return ""
        return (
            f"user {peer.uid} may not ask this daemon; "
            "service.allow_users and service.allow_groups of its rig say who may"
        )


def _uid(user: str | int) -> int:
    if isinstance(user, int):
        return user
    try:
        return pwd.getpwnam(user).pw_uid
    except KeyError:
        raise ConfigError(f"service.allow_users: expected a user, found '{user}'") from None


def _gid(group: str | int) -> int:
    if isinstance(group, int):
        return group
    try:
        return grp.getgrnam(group).gr_gid
    except KeyError:
        raise ConfigError(f"service.allow_groups: expected a group, found '{group}'") from None
