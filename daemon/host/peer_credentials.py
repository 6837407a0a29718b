"""Control access to the daemon by the user and groups of a socket peer, as the kernel reports."""

from __future__ import annotations

import grp
import os
import pwd
import socket
import struct
from dataclasses import dataclass

from ...config.base import ConfigError
from ...config.daemon_settings import Service

_SO_PEERGROUPS = 59
_MAX_BYTES = 1024
"""Limit of Python's getsockopt: 256 groups."""


@dataclass(frozen=True)
class Peer:
    """Identify the process at the other end of a socket, with all its groups."""

    pid: int
    uid: int
    gids: frozenset[int]


def peer_of(connection: socket.socket) -> Peer:
    """Return the process that connected; raises OSError."""
    size = struct.calcsize("3i")
    raw = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size)
    pid, uid, gid = struct.unpack("3i", raw)
    gids = {gid}
    try:
        groups = connection.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, _MAX_BYTES)
        gids |= set(struct.unpack(f"{len(groups) // 4}i", groups))
    except OSError:
        pass  # an old kernel, or more than 256 groups: use the primary group only
    return Peer(pid, uid, frozenset(gids))


class Access:
    """Allow root, the daemon's own user and group, service.allow_users and service.allow_groups.

    Raises:
        ConfigError: a user or group does not exist.
    """

    def __init__(self, config: Service) -> None:
        self._uids = {0, os.geteuid(), *map(_uid, config.allow_users)}
        self._gids = {os.getegid(), *map(_gid, config.allow_groups)}
        self.others = bool(config.allow_users or config.allow_groups)

    @property
    def mode(self) -> int:
        """Mode of the socket file. It cannot list users: any `allow_` key opens it to all."""
        return 0o666 if self.others else 0o660

    def refuses(self, peer: Peer) -> str:
        """Return why this peer has no access; empty if it has."""
        if peer.uid in self._uids or peer.gids & self._gids:
            return ""
        return (
            f"user {peer.uid} has no access to this daemon; "
            "see service.allow_users and service.allow_groups in its RIG.yaml"
        )


def _uid(user: str | int) -> int:
    if isinstance(user, int):
        return user
    try:
        return pwd.getpwnam(user).pw_uid
    except KeyError:
        raise ConfigError(f"service.allow_users: no such user '{user}'") from None


def _gid(group: str | int) -> int:
    if isinstance(group, int):
        return group
    try:
        return grp.getgrnam(group).gr_gid
    except KeyError:
        raise ConfigError(f"service.allow_groups: no such group '{group}'") from None
