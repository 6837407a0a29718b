"""Open and create folders without following links that another user made.

A program of many rights that writes into a folder of a group must not be led elsewhere by a link
that a member of the group put there. The kernel holds this for /tmp (fs.protected_symlinks); here
it holds for every folder. A link of this user or of root is followed: somebody made it on purpose.
"""

from __future__ import annotations

import errno
import os
import pwd
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_MOST_LINKS = 40
"""Most links in a path, as in the kernel."""
_LOOK = os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC


class ForeignLinkError(OSError):
    """A link in a path belongs to another user, so it is not followed."""


@contextmanager
def opened_folder(path: Path | str, *, create: int | None = None) -> Iterator[int]:
    """Open a folder for the functions of `os` with `dir_fd`, as long as the `with` body runs.

    What happens to the path meanwhile, such as a folder exchanged for a link, has no effect.
    create: mode of missing folders, less the umask; default: they are errors.

    Raises:
        ForeignLinkError: the path leads through a link of another user.
        OSError: the folder does not exist, cannot be entered or made, or is not a folder.
    """
    folder = _open(Path(path), create)
    try:
        yield folder
    finally:
        os.close(folder)


def make_folder(path: Path | str, mode: int = 0o777) -> None:
    """Create a folder and those above it; an existing folder is no error. Raises OSError."""
    with opened_folder(path, create=mode):
        pass


def _open(path: Path, create: int | None) -> int:
    """Open a folder part by part, so that each link is checked before it is followed."""
    parts = list(reversed(path.parts))
    folder = os.open(".", _LOOK | os.O_DIRECTORY)
    links = 0
    try:
        while parts:
            name = parts.pop()
            inner = _look(folder, name, path, create)
            status = os.fstat(inner)
            if stat.S_ISLNK(status.st_mode):
                links += 1
                try:
                    target = _target(inner, status, path, links)
                finally:
                    os.close(inner)
                parts += reversed(Path(target).parts)  # of an absolute one, "/" comes first
                continue
            if not stat.S_ISDIR(status.st_mode):
                os.close(inner)
                raise _error(errno.ENOTDIR, path)
            os.close(folder)
            folder = inner
    except BaseException:
        os.close(folder)
        raise
    return folder


def _look(folder: int, name: str, path: Path, create: int | None) -> int:
    """Return a descriptor of a folder or link in a folder, which is created if it is missing."""
    try:
        return os.open(name, _LOOK, dir_fd=folder)
    except FileNotFoundError:
        if create is None:
            raise _error(errno.ENOENT, path) from None
    except OSError as error:
        raise _error(error.errno or 0, path) from None
    try:
        with suppress(FileExistsError):  # another process was quicker
            os.mkdir(name, create, dir_fd=folder)
        return os.open(name, _LOOK, dir_fd=folder)
    except OSError as error:
        raise _error(error.errno or 0, path) from None


def _target(link: int, status: os.stat_result, path: Path, links: int) -> str:
    if links > _MOST_LINKS:
        raise _error(errno.ELOOP, path)
    target = os.readlink("", dir_fd=link)
    if status.st_uid not in (0, os.geteuid()):
        raise ForeignLinkError(
            errno.EPERM,
            f"leads through a link to {target} that user {_user(status.st_uid)} made: links of "
            "other users are not followed; name the folder itself",
            str(path),
        )
    return target


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return str(number)


def _error(number: int, path: Path) -> OSError:
    return OSError(number, os.strerror(number), str(path))
