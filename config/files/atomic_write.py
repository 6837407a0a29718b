"""Write files so that they appear complete or not at all: the only code that opens files to write.

Data go to a file without a name, or with a random one where the file system needs a name. It takes
its place when it is complete and on the disk. Whatever ends the process earlier leaves nothing
that looks like a result. No link is written through: one in the file's place is replaced, and the
folder is opened as `folders` states.
"""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, cast

from .folders import opened_folder

_NEW = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_UNNAMED = os.O_RDWR | os.O_TMPFILE | os.O_CLOEXEC
_NEEDS_A_NAME = (errno.EOPNOTSUPP, errno.EISDIR, errno.EINVAL, errno.ENOENT)
"""Answers of file systems without O_TMPFILE, such as network shares."""
_NO_HARD_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)


@contextmanager
def atomic_file(
    path: Path | str, *, replace: bool = True, mode: int | None = None
) -> Iterator[BinaryIO]:
    """Open a new file, which becomes `path` after the `with` body; after an exception it is gone.

    An existing file is replaced, and `path` itself where it is a link. The new file has the
    permissions of a replaced file of this user, otherwise `mode`, by default those of the umask.
    replace: whether `path` may exist.

    Raises:
        FileExistsError: `path` exists, and `replace` is false.
        ForeignLinkError: the folder is reached through a link of another user.
        OSError: `path` is a folder or a device, or cannot be written.
    """
    path = Path(path)
    with opened_folder(path.parent) as folder:
        before = _existing(path, folder, replace)
        part = _Part(folder)
        try:
            with _naming(path):
                part.open(0o666 if mode is None else mode)
            with open(part.descriptor, "w+b", closefd=False) as file, _naming(path, body=True):
                yield cast("BinaryIO", file)
            with _naming(path):
                _take_permissions(part.descriptor, before)
                os.fsync(part.descriptor)
                part.become(path.name, replace)
        finally:
            part.discard()
        _sync(folder)


def write_file(
    path: Path | str, data: str | bytes, *, replace: bool = True, mode: int | None = None
) -> None:
    """Write a file of bytes, or of text in UTF-8, as `atomic_file` does.

    Characters without an encoding, which file names can contain, are escaped.
    """
    data = data.encode("utf-8", errors="backslashreplace") if isinstance(data, str) else data
    with atomic_file(path, replace=replace, mode=mode) as file:
        file.write(data)


def open_new(path: Path | str) -> int:
    """Return the descriptor of a new, empty file at `path`, for data that must be there at once.

    A log in flight is such a file: what is on the disk when the power fails is read later.

    Raises:
        FileExistsError: `path` exists, be it as a link.
        ForeignLinkError, OSError: as `atomic_file`.
    """
    path = Path(path)
    with opened_folder(path.parent) as folder, _naming(path):
        return os.open(path.name, _NEW, 0o666, dir_fd=folder)


def empty_file(path: Path | str) -> None:
    """Cut a file of this user to no bytes, in its place: this needs no room on a full disk.

    Raises OSError, also for a link and for a file that has a second name.
    """
    path = Path(path)
    with opened_folder(path.parent) as folder, _naming(path):
        flags = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        descriptor = os.open(path.name, flags, 0o666, dir_fd=folder)
        try:
            found = os.fstat(descriptor)
            if not stat.S_ISREG(found.st_mode) or found.st_nlink != 1:
                raise OSError(errno.EINVAL, "expected a file with one name")
            os.ftruncate(descriptor, 0)
        finally:
            os.close(descriptor)


def replace_link(path: Path | str, target: str) -> None:
    """Make `path` a link to `target`, and replace a file of that name; raises OSError."""
    path, new = Path(path), _random_name()
    with opened_folder(path.parent) as folder, _naming(path):
        os.symlink(target, new, dir_fd=folder)
        try:
            os.rename(new, path.name, src_dir_fd=folder, dst_dir_fd=folder)
        except BaseException:
            os.unlink(new, dir_fd=folder)
            raise


class _Part:
    """The file that is being written; it has a name only if the file system needs one."""

    def __init__(self, folder: int) -> None:
        self._folder = folder
        self._name: str | None = None
        self.descriptor = -1

    def open(self, mode: int) -> None:
        try:
            self.descriptor = os.open(".", _UNNAMED, mode, dir_fd=self._folder)
        except OSError as error:
            if error.errno not in _NEEDS_A_NAME:
                raise
        if self.descriptor >= 0 and Path(self._unnamed).exists():
            return
        if self.descriptor >= 0:  # no /proc, by which it would get its name
            os.close(self.descriptor)
            self.descriptor = -1
        self._name = _random_name()
        self.descriptor = os.open(self._name, _NEW, mode, dir_fd=self._folder)

    def become(self, name: str, replace: bool) -> None:
        """Give the file its name, at one instant."""
        if not replace and self._name is None:
            self._link(name)
            return
        if self._name is None:
            new = _random_name()
            self._name = new
            self._link(new)
        if not replace:
            self._link_of_part(name)
            return
        os.rename(self._name, name, src_dir_fd=self._folder, dst_dir_fd=self._folder)
        self._name = None

    def discard(self) -> None:
        """Close the file; remove it if it did not get its name."""
        if self._name is not None:
            with suppress(OSError):
                os.unlink(self._name, dir_fd=self._folder)
        if self.descriptor >= 0:
            os.close(self.descriptor)

    @property
    def _unnamed(self) -> str:
        return f"/proc/self/fd/{self.descriptor}"

    def _link(self, name: str) -> None:
        os.link(self._unnamed, name, dst_dir_fd=self._folder, follow_symlinks=True)

    def _link_of_part(self, name: str) -> None:
        """Link the named part to its final name, which no file is replaced by."""
        assert self._name is not None
        try:
            os.link(self._name, name, src_dir_fd=self._folder, dst_dir_fd=self._folder)
        except OSError as error:
            if error.errno not in _NO_HARD_LINKS:
                raise
            with suppress(FileNotFoundError):
                os.stat(name, dir_fd=self._folder, follow_symlinks=False)
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from None
            os.rename(self._name, name, src_dir_fd=self._folder, dst_dir_fd=self._folder)
            self._name = None


def _random_name() -> str:
    return f".levid-{secrets.token_hex(8)}.part"


def _existing(path: Path, folder: int, replace: bool) -> os.stat_result | None:
    """Return the status of the file that will be replaced, None if there is none."""
    try:
        found = os.stat(path.name, dir_fd=folder, follow_symlinks=False)
    except FileNotFoundError:
        return None
    except OSError as error:  # the name is too long
        error.filename = str(path)
        raise
    if not replace:
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not (stat.S_ISREG(found.st_mode) or stat.S_ISLNK(found.st_mode)):
        raise OSError(
            errno.EINVAL, "expected a file, found a device, pipe or socket of that name", str(path)
        )
    return found


def _take_permissions(descriptor: int, before: os.stat_result | None) -> None:
    """Keep permissions and group of a replaced file of this user; those of others do not count."""
    if before is None or not stat.S_ISREG(before.st_mode) or before.st_uid != os.geteuid():
        return
    mode = stat.S_IMODE(before.st_mode) & 0o777
    if before.st_gid != os.fstat(descriptor).st_gid:
        try:
            os.fchown(descriptor, -1, before.st_gid)
        except OSError:
            mode &= ~0o070  # the rights of one group are not those of another
    os.fchmod(descriptor, mode)


def _sync(folder: int) -> None:
    """Write the folder's entry to the disk, where the folder may be read."""
    with suppress(OSError):
        opened = os.open(".", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC, dir_fd=folder)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


@contextmanager
def _naming(path: Path, *, body: bool = False) -> Iterator[None]:
    """Name `path` in an error of the operating system; that of a body may name another file."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and not (body and error.filename):
            error.filename, error.filename2 = str(path), None
        raise
