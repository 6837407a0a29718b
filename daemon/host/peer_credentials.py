"""Control access to the daemon by the user and groups of a socket peer, as the kernel reports."""

from __future__ import annotations

import grp
import os
import pwd
import socket
import struct
from dataclasses import dataclass
from enum import IntEnum

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


class Role(IntEnum):
    """What a client may do; each role includes those below it."""

    NONE = 0
    WATCH = 1  # read the status
    STOP = 2  # stop and land
    FLY = 3  # all


_LEAST_ROLE = {"status": Role.WATCH, "watch": Role.WATCH, "stop": Role.STOP, "land": Role.STOP}
"""Operations that others than those who may fly may ask for."""
_KEYS = {Role.FLY: "allow", Role.STOP: "stop", Role.WATCH: "watch"}
"""Begin of the keys in the rig's `service` that name users and groups of a role."""


class Access:
    """Give root, the daemon's own user and group all rights, and others the role that a rig names.

    The keys are `allow_users` and `allow_groups` for those who may fly, `stop_users` and
    `stop_groups`, `watch_users` and `watch_groups`. Of several roles a client has the highest.

    Raises:
        ConfigError: a user or group does not exist.
    """

    def __init__(self, config: Service) -> None:
        self._uids = {0: Role.FLY, os.geteuid(): Role.FLY}
        self._gids = {os.getegid(): Role.FLY}
        self.others = False
        for role, key in _KEYS.items():
            for user in getattr(config, f"{key}_users"):
                self._uids.setdefault(_uid(user, f"{key}_users"), role)
                self.others = True
            for group in getattr(config, f"{key}_groups"):
                self._gids.setdefault(_gid(group, f"{key}_groups"), role)
                self.others = True

    @property
    def mode(self) -> int:
        """Mode of the socket file. It cannot list users: a key that names one opens it to all."""
        return 0o666 if self.others else 0o660

    def role_of(self, peer: Peer) -> Role:
        """Return the highest role of the peer's user and groups."""
        of_groups = (self._gids.get(gid, Role.NONE) for gid in peer.gids)
        return max(self._uids.get(peer.uid, Role.NONE), *of_groups, Role.NONE)

    def refuses(self, peer: Peer) -> str:
        """Return why this peer has no access; empty if it has."""
        if self.role_of(peer) is not Role.NONE:
            return ""
        return (
            f"user {peer.uid} has no access to this daemon; "
            "see service.allow_users and service.allow_groups in its RIG.yaml"
        )


def forbidden(role: Role, op: str) -> str:
    """Return why a client of a role may not ask for an operation; empty if it may."""
    least = _LEAST_ROLE.get(op, Role.FLY)
    if role >= least:
        return ""
    return (
        f"{op}: this user may only {'stop and land' if role is Role.STOP else 'watch'}; "
        f"see service.{_KEYS[least]}_users and {_KEYS[least]}_groups in RIG.yaml"
    )


def _uid(user: str | int, key: str) -> int:
    if isinstance(user, int):
        return user
    try:
        return pwd.getpwnam(user).pw_uid
    except KeyError:
        raise ConfigError(f"service.{key}: no such user '{user}'") from None


def _gid(group: str | int, key: str) -> int:
    if isinstance(group, int):
        return group
    try:
        return grp.getgrnam(group).gr_gid
    except KeyError:
        raise ConfigError(f"service.{key}: no such group '{group}'") from None
