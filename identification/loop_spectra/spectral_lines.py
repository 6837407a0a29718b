"""Take the spectra of records in a known control loop: outputs, plant inputs, excitation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

HIGHEST_SHARE = 0.4
"""Highest line over the sampling rate."""
SEARCH_LINES = 800
"""Lines of a record in a search; its last steps use all."""
FIRST_LINE = 3
"""Lines below it hold what drifts during the record."""
_SMOOTHED_LINES = 41
_EXCITED = 1e-8
"""Share of the strongest line's power from which a line is excited; rounding leaves 1e-20."""
LEAST_LINES = 25
"""Lines of the bands in which noise and model error are told apart."""


@dataclass(frozen=True)
class RecordLines:
    """The lines of one record: Y (F, n), U (F, p), V (F, p), DFT over the root of the length.

    `excited`: numbers of the inputs that have an excitation. `power` (F, n): |Y|^2, smoothed.
    """

    name: str
    Y: Complex
    U: Complex
    V: Complex
    excited: tuple[int, ...]
    power: Array


@dataclass(frozen=True)
class PointLines:
    """Records of one length at one point of the schedule, at freq_hz (F,).

    `controller` (F, p, n): C of u = v - C y. `delay_s`: whole cycles from command to action.
    """

    schedule: Mapping[str, float]
    freq_hz: Array
    Ts_s: float
    delay_s: float
    controller: Complex
    records: tuple[RecordLines, ...]

    def only(self, lines: NDArray[np.int_]) -> PointLines:
        """Return some of the lines."""
        records = tuple(
            replace(r, Y=r.Y[lines], U=r.U[lines], V=r.V[lines], power=r.power[lines])
            for r in self.records
        )
        return replace(
            self, freq_hz=self.freq_hz[lines], controller=self.controller[lines], records=records
        )

    @property
    def excited(self) -> NDArray[np.int_]:
        """Lines that some record excites: all with noise, those of its periods with a multisine."""
        power = np.sum([np.sum(np.abs(r.V) ** 2, axis=1) for r in self.records], axis=0)
        return np.flatnonzero(power > _EXCITED * np.max(power, initial=0.0))


@dataclass(frozen=True)
class LoopSignals:
    """The signals of one record in a loop u = v - C y, the feed-forward in u and v: rows (N, ...).

    `excited`: numbers of the inputs that have an excitation.
    """

    name: str
    y: Array
    u: Array
    v: Array
    excited: tuple[int, ...]


def point_lines(
    records: Sequence[LoopSignals],
    schedule: Mapping[str, float],
    Ts_s: float,
    delay_s: float,
    controller: Callable[[Array], Complex],
    band_hz: tuple[float, float],
) -> PointLines | None:
    """Return the lines in a band of records of one length, taken at one point of the schedule.

    `controller` gives C (F, p, n) at frequencies (F,). No window is applied: the fit eliminates
    what the begin and the end of a record leave, so there is no leakage. None if the band has fewer
    than LEAST_LINES.
    """
    freq_hz = fft.rfftfreq(len(records[0].y), Ts_s)
    lines = np.arange(FIRST_LINE, len(freq_hz))
    lines = lines[(freq_hz[lines] >= band_hz[0]) & (freq_hz[lines] <= band_hz[1])]
    if len(lines) < LEAST_LINES:
        return None
    found = tuple(_record(r, lines) for r in records)
    return PointLines(schedule, freq_hz[lines], Ts_s, delay_s, controller(freq_hz[lines]), found)


def _record(record: LoopSignals, lines: NDArray[np.int_]) -> RecordLines:
    Y, U, V = (_spectrum(x, lines) for x in (record.y, record.u, record.v))
    width = min(_SMOOTHED_LINES, len(lines))
    box = np.ones(width)
    count = np.convolve(np.ones(len(lines)), box, mode="same")
    power = [np.convolve(np.abs(column) ** 2, box, mode="same") / count for column in Y.T]
    return RecordLines(record.name, Y, U, V, record.excited, np.array(power).T)


def _spectrum(x: Array, lines: NDArray[np.int_]) -> Complex:
    found = fft.rfft(x - x.mean(axis=0), axis=0)[lines]
    return np.asarray(found / np.sqrt(len(x)))
