"""Tell what excites a record: steps, a transient, sine waves, or a broad band, such as noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from .held_out_rows import block_count, moving_blocks
from .persistence_of_excitation import sine_waves
from .record import Record

Array = NDArray[np.float64]

_HELD = 0.5
"""Share of rows in which an input keeps its value, from which it is a sequence of steps."""
_FEW_STEPS = 20
"""Number of steps from which a sequence is broadband, as a binary sequence is."""
_CYCLES = 2.0
"""Least number of cycles of a sine wave in a record; fewer do not repeat."""
_PART = 0.5
"""Share of the blocks of time, below which an input that varies in them only is a transient."""
_SLOW = 0.1
"""Share of the power below that frequency from which an input does not repeat."""


@dataclass(frozen=True)
class Excitation:
    """The kind of an input's variation, and the number of its steps or sine waves, else 0."""

    kind: Literal["constant", "steps", "transient", "periodic", "broadband"]
    count: int = 0


def excitations(records: Sequence[Record]) -> list[Excitation]:
    """Return the kind of excitation of each input of records that are identified together."""
    waves = sine_waves(records).tolist()
    return [_of_input([r.v[:, i] for r in records], count) for i, count in enumerate(waves)]


def _of_input(records: Sequence[Array], waves: int) -> Excitation:
    """Return the kind of one input, from all records that vary it."""
    varying = [v for v in records if np.ptp(v) > 0.0]
    if not varying:
        return Excitation("constant")
    changes = np.concatenate([np.diff(v) for v in varying])
    steps = int(np.count_nonzero(changes))
    if steps < min(_FEW_STEPS, (1.0 - _HELD) * len(changes)):
        return Excitation("steps", steps)
    if all(map(_is_transient, varying)):
        return Excitation("transient")
    # Noise has as many lines as the record has frequencies.
    lines = min(len(v) for v in varying) // 8
    return Excitation("periodic", waves) if waves < lines else Excitation("broadband")


def _is_transient(v: Array) -> bool:
    """Return whether a signal moves in a part of the record only, or does not repeat."""
    blocks = block_count(len(v))
    if blocks and np.mean(moving_blocks(v[:, None], blocks)) < _PART:
        return True
    window = signal.windows.hann(len(v), sym=False)
    lines = np.abs(fft.rfft(window * (v - v.mean()))) ** 2
    return bool(lines[: int(_CYCLES)].sum() > _SLOW * lines.sum())
