"""Read files that decide what code runs: only what no other user can change.

A file is judged by its open descriptor, so that it cannot be replaced between check and use. The
folders above it then do not matter: whatever another user puts in its place belongs to that user.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

_FLAGS = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK  # a pipe in its place would block
_ACL = "system.posix_acl_access"


class ForeignFileError(PermissionError):
    """Report that another user owns or can change a file that would be executed."""


def read_code(path: Path | str, most_bytes: int = -2) -> bytes:
    """Return the content of a file with code; one byte more than `most_bytes` of a longer one.

    It may belong to this user or root, and be writable by its owner's private group: the default
    of many systems (umask 002).

    Raises:
        ForeignFileError: another user owns the file or can change it.
        OSError: the file cannot be read.
    """
    return _read(path, _FLAGS, _foreign_code, most_bytes + 1)


def read_private(path: Path | str) -> bytes:
    """Return the content of a file that this user alone owns and can change; links are refused.

    Raises:
        ForeignFileError: another user, root or not, owns the file or can change it.
        OSError: the file cannot be read.
    """
    return _read(path, _FLAGS | os.O_NOFOLLOW, _not_private)


def make_private_folder(folder: Path) -> bool:
    """Make a folder that only this user can enter, with its parents; return whether it is one.

    The rights of a folder of this user are corrected. Another user's folder or a link is left
    alone.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.lstat()
        if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid():
            return False
        if found.st_mode & 0o077:
            folder.chmod(0o700)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


def is_private_folder(folder: Path) -> bool:
    """Return whether this user owns a folder and no other can enter it, writable or not."""
    try:
        found = folder.lstat()
    except OSError:
        return False
    private = found.st_uid == os.geteuid() and not found.st_mode & 0o077
    return private and stat.S_ISDIR(found.st_mode)


def _read(
    path: Path | str,
    flags: int,
    problem: Callable[[os.stat_result, int], str],
    most_bytes: int = -1,
) -> bytes:
    with os.fdopen(os.open(path, flags), "rb") as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise ForeignFileError(0, "expected a file", str(path))
        if what := problem(found, file.fileno()):
            raise ForeignFileError(0, what, str(path))
        return file.read(most_bytes)


def _not_private(found: os.stat_result, _: int) -> str:
    if found.st_uid != os.geteuid():
        return f"expected a file of this user, found one of {user_name(found.st_uid)}"
    return "expected a file that only this user can change" if found.st_mode & 0o022 else ""


def _foreign_code(found: os.stat_result, fd: int) -> str:
    if found.st_uid not in (os.geteuid(), 0):
        return (
            f"its code is not executed: it belongs to {user_name(found.st_uid)}, who can change it "
            "at any time; copy the file if you trust it"
        )
    if found.st_mode & 0o002:
        return "its code is not executed: all users may change it (chmod o-w)"
    if found.st_mode & 0o020 and (_has_acl(fd) or not _is_private_group(found.st_gid)):
        group = _group_name(found.st_gid)
        return f"its code is not executed: group {group} may change it (chmod g-w)"
    return ""


def _has_acl(fd: int) -> bool:
    """Return whether the group bits of the mode are those of an access control list."""
    with suppress(OSError):
        return bool(os.getxattr(fd, _ACL))
    return False


def _is_private_group(gid: int) -> bool:
    """Return whether a group has this user as its only member, as the group of its own name has."""
    import grp
    import pwd

    try:
        user, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(gid)
    except KeyError:
        return False
    alone = not set(group.gr_mem) - {user.pw_name}
    return gid == user.pw_gid and group.gr_name == user.pw_name and alone


def user_name(uid: int) -> str:
    """Return how messages name a user."""
    import pwd

    try:
        return f"user {pwd.getpwuid(uid).pw_name}"
    except KeyError:
        return f"user {uid}"


def _group_name(gid: int) -> str:
    import grp

    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)
