"""Take the spectra of records in a known control loop: outputs, plant inputs, excitation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ...records.record import IdentificationError
from ..experiment.experiment_from_log import Experiment

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

FIRST_LINE = 3
"""Lines below it hold what drifts during the record."""
_SMOOTHED_LINES = 41
_EXCITED = 1e-8
"""Share of the strongest line's power from which a line is excited; rounding leaves 1e-20."""
LEAST_LINES = 25
"""Lines of the bands in which noise and model error are told apart."""
SAME_POINT = 1e-3
"""Share of a scheduling variable's range within which records count as taken at one point."""


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


def lines_by_point(
    experiments: Sequence[Experiment], band_hz: tuple[float, float]
) -> tuple[PointLines, ...]:
    """Return the lines in a band of records whose schedule rests, grouped by point and length.

    Every record has a known loop. No window is applied: the fit eliminates what the begin and the
    end of a record leave (`transients`), so there is no leakage. Records with too few lines are
    left out.

    Raises IdentificationError if no record with an excitation has enough lines in the band.
    """
    low_hz, high_hz = band_hz
    groups = []
    for group in by_point(experiments):
        lines = _lines(group[0], band_hz)
        if len(lines) >= LEAST_LINES:
            groups.append(_point(group, lines))
    if not any(r.excited for g in groups for r in g.records):
        longest = max(len(e.y) * e.Ts_s for e in experiments)
        raise IdentificationError(
            f"expected at least {LEAST_LINES} lines from {low_hz:g} to {high_hz:g} Hz in a record "
            f"with an excitation; the longest record, of {longest:g} s, has one line each "
            f"{1.0 / longest:.3g} Hz, up to {0.5 / experiments[0].Ts_s:g} Hz. Choose a wider band "
            "(--band), or record longer"
        )
    return tuple(groups)


def by_point(experiments: Sequence[Experiment]) -> list[list[Experiment]]:
    """Return records at one point of the schedule, of one length and rate, together."""
    groups: list[list[Experiment]] = []
    for e in experiments:
        same = next((g for g in groups if _together(g[0], e)), None)
        if same is None:
            groups.append([e])
        else:
            same.append(e)
    return groups


def _together(one: Experiment, other: Experiment) -> bool:
    if (len(one.y), one.Ts_s) != (len(other.y), other.Ts_s):
        return False
    return all(
        abs(one.schedule[name].mean() - other.schedule[name].mean()) <= SAME_POINT * one.spans[name]
        for name in one.schedule
        if name not in one.rates
    )


def _lines(e: Experiment, band_hz: tuple[float, float]) -> NDArray[np.int_]:
    freq_hz = fft.rfftfreq(len(e.y), e.Ts_s)
    lines = np.arange(FIRST_LINE, len(freq_hz))
    inside = (freq_hz[lines] >= band_hz[0]) & (freq_hz[lines] <= band_hz[1])
    return np.asarray(lines[inside])


def _point(experiments: Sequence[Experiment], lines: NDArray[np.int_]) -> PointLines:
    first = experiments[0]
    assert first.loop is not None
    freq_hz = fft.rfftfreq(len(first.y), first.Ts_s)
    schedule = {
        name: 0.0
        if name in first.rates
        else float(np.mean([e.schedule[name] for e in experiments]))
        for name in first.schedule
    }
    return PointLines(
        schedule,
        freq_hz[lines],
        first.Ts_s,
        first.delay_cycles * first.Ts_s,
        first.loop.controller.response(freq_hz[lines]),
        tuple(_record(e, lines) for e in experiments),
    )


def _record(e: Experiment, lines: NDArray[np.int_]) -> RecordLines:
    assert e.loop is not None
    v = e.loop.v + e.loop.feedforward
    Y, U, V = (_spectrum(x, lines) for x in (e.y, e.u, v))
    width = min(_SMOOTHED_LINES, len(lines))
    box = np.ones(width)
    count = np.convolve(np.ones(len(lines)), box, mode="same")
    power = [np.convolve(np.abs(column) ** 2, box, mode="same") / count for column in Y.T]
    excited = np.flatnonzero(np.ptp(v, axis=0) > 0)
    return RecordLines(e.name, Y, U, V, tuple(excited.tolist()), np.array(power).T)


def _spectrum(x: Array, lines: NDArray[np.int_]) -> Complex:
    found = fft.rfft(x - x.mean(axis=0), axis=0)[lines]
    return np.asarray(found / np.sqrt(len(x)))
