"""Detect that a log in flight was deleted, moved or cut off, and bring back a deleted one.

The recorder holds the file open, so it would write on without an error. What is deleted stays on
the disk until the recorder closes it, and is copied to its path again before that.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from ...config.files.atomic_write import atomic_file
from ...config.files.folders import make_folder

_COPY_BYTES = 1 << 20


class Loss(StrEnum):
    """What happened to the file of a log."""

    DELETED = "deleted"
    MOVED = "moved"
    CUT = "cut"


@dataclass(frozen=True)
class LostLog:
    """A log that is no longer whole at its path."""

    path: Path
    loss: Loss
    words: str


def find_loss(path: Path, descriptor: int, size: int) -> LostLog | None:
    """Return what happened to an open log of which `size` bytes were written; None if it is whole.

    Raises OSError.
    """
    ours = os.fstat(descriptor)
    try:
        there = path.stat(follow_symlinks=False)
        in_place = (there.st_dev, there.st_ino) == (ours.st_dev, ours.st_ino)
    except OSError:
        in_place = False
    if not in_place and ours.st_nlink == 0:
        words = "was deleted in flight: the following rows go to the next part"
        return LostLog(path, Loss.DELETED, f"{path}: {words}")
    if not in_place:
        words = (
            "is no longer there: it was moved in flight, or its disk was unmounted; the rows still "
            "go to the moved file"
        )
        return LostLog(path, Loss.MOVED, f"{path}: {words}")
    if ours.st_size < size:
        words = (
            f"was cut off in flight, to {ours.st_size} of {size} bytes: its rows are lost; the "
            "following rows go to the next part"
        )
        return LostLog(path, Loss.CUT, f"{path}: {words}")
    return None


def save_deleted(path: Path, descriptor: int) -> Path:
    """Copy a deleted log to its path again, or beside it if another file is there by now.

    Returns the path of the copy. Raises OSError.
    """
    make_folder(path.parent)
    for target in (path, path.with_suffix(f".recovered{path.suffix}")):
        try:
            with (
                open(os.dup(descriptor), "rb") as deleted,  # noqa: PTH123 - it has no path
                atomic_file(target, replace=False) as copy,
            ):
                deleted.seek(0)
                shutil.copyfileobj(deleted, copy, _COPY_BYTES)
        except FileExistsError:
            continue
        return target
    raise FileExistsError(f"{path}: other files took its place")
