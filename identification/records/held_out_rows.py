"""Choose the rows at the end of a record that are held out: they must contain motion.

The last quarter of a record of steps may be at rest. An error over the output is then large for
every model, and a small one says nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BLOCKS = 40
_ROWS_A_BLOCK = 4
_FEWEST_ROWS = 40
_EVENT_BLOCKS, _FINER = 8, 4
"""Blocks that an event has at least, and how much finer blocks become where it has fewer."""
_RESTS = 0.02
"""Variance of a block over that of the loudest one, up to which the output rests in it."""
_NOISE = 4.0
"""Variance of a block over that of most blocks, from which it moves if most of them are noise. The
ratio of the variances of 10 rows of noise exceeds it with 3 % probability, of 25 rows hardly."""
_EVENT = 30.0
"""Variance of the loudest block over that of most, from which most of them are noise. Random motion
of a resonance reaches ten."""
_HALF = 0.5
_LEAST, _FITTED_ROWS = 0.05, 60
"""Least share of the rows that is fitted, and the least number."""
_INPUT_CHANGES = 0.01
"""Range of an input in the held-out rows, over that of the record, from which it drives them."""


@dataclass(frozen=True)
class HeldOut:
    """Where the held-out rows of a record begin, and whether they tell enough.

    start, stop: the first held-out row, and the one after the last. moves: whether an output moves
    in them. driven: whether an input changes in them. event: whether the outputs rest in most of
    the last rows, so that the held-out rows are those of the last motion.
    """

    start: int
    stop: int
    moves: bool
    driven: bool
    event: bool = False

    @property
    def remark(self) -> str | None:
        """What the held-out rows cannot validate, and what to record; None if they can."""
        if not self.moves:
            return (
                "no output moves in the held-out rows, so they cannot validate the model. Record "
                "the motion again, and identify both records together"
            )
        if not self.driven:
            return (
                "no input changes in the held-out rows: they validate how the motion decays, but "
                "not what an input causes. Record the step again, and identify both records "
                "together"
            )
        return None


def held_out_rows(y: Array, u: Array, share: float) -> HeldOut:
    """Return where the held-out rows of a record begin.

    y (N, m), u (N, p): outputs and inputs. share: of the blocks of time in which a signal moves;
    it is the share of the rows if one moves in half of the last rows.
    """
    rows = len(y)
    plain = rows - round(share * rows)
    blocks = block_count(rows)
    if share <= 0.0 or not blocks:
        return HeldOut(plain, rows, True, True)
    signals = np.hstack([y, u])
    moving = moving_blocks(signals, blocks)
    while 0 < np.count_nonzero(moving) < _EVENT_BLOCKS and blocks * _FINER <= rows // _ROWS_A_BLOCK:
        blocks *= _FINER  # resolve a short event
        moving = moving_blocks(signals, blocks)
    ends = np.cumsum([len(part) for part in np.array_split(np.arange(rows), blocks)])
    behind = ends > plain
    start, stop, event = plain, rows, bool(np.any(moving) and np.mean(moving[behind]) < _HALF)
    if event:
        numbers = np.flatnonzero(moving)
        fitted = numbers[: max(round((1.0 - share) * len(numbers)), 1)]
        start = max(int(ends[fitted[-1]]), round(_LEAST * rows), _FITTED_ROWS)
        start = min(start, rows - _FEWEST_ROWS // 2)
        stop = min(max(int(ends[numbers[-1]]), start + _FEWEST_ROWS), rows)
    held = (ends > start) & (ends <= stop)
    changes = np.ptp(u[start:stop], axis=0) > _INPUT_CHANGES * np.ptp(u, axis=0)
    moves = bool(np.any(moving_blocks(y, blocks)[held]))
    return HeldOut(start, stop, moves, bool(np.any(changes)), event)


def block_count(rows: int) -> int:
    """Return into how many blocks of time a record is divided; 0 for one that is too short."""
    return min(_BLOCKS, rows // _ROWS_A_BLOCK) if rows >= _FEWEST_ROWS else 0


def moving_blocks(y: Array, blocks: int) -> NDArray[np.bool_]:
    """Return in which of so many blocks of time (blocks,) a signal of y (N, m) moves.

    A block rests if it has little of the loudest block's variance, or only the noise of most.
    """
    whole = y.std(axis=0)
    unit = y / np.where(whole > 0.0, whole, 1.0)
    variance = np.array([part.var(axis=0) for part in np.array_split(unit, blocks)])
    loudest, most = variance.max(axis=0), np.median(variance, axis=0)
    noise = np.where(loudest > _EVENT * most, _NOISE * most, 0.0)
    limit = np.maximum(_RESTS * loudest, noise)
    return np.asarray(np.any(variance > limit + np.finfo(float).eps, axis=1))
