"""Define the error that log/ raises for wrong input and damaged files."""

from __future__ import annotations

import errno

from ..config.escaping import one_line

_REMEDIES = {
    errno.ENOSPC: "remove files, or write to another disk",
    errno.EDQUOT: "remove files of this user, or write to another disk",
    errno.EROFS: "write to another disk, or mount this one for writing",
    errno.EACCES: "`ls -l` shows whose it is; give this user access, or choose another place",
    errno.EMFILE: "give fewer files at once",
}


class LogError(Exception):
    """A log cannot be read, written or imported: where, what was expected and what was found.

    The message is one line, although names of files, topics and columns may have line breaks.
    """

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


def reason(error: OSError) -> str:
    """Return the cause of an error of the operating system, with a remedy if there is one."""
    text = error.strerror or str(error) or type(error).__name__
    remedy = _REMEDIES.get(error.errno or 0)
    return f"{text}: {remedy}" if remedy else text
