"""Does a flight over a bus give the P that a flight on loopback gives, and how sure is that?

P (3 x 3, at every beam position of the session) is identified in both by (15) with its standard
deviation, and by Ho-Kalman and (14). A delay of the backend's own, common to all entries, is fitted
and taken out; what is left is compared entry by entry with its 95 % region, and all frequencies
together as one difference in gain, which shows what no single frequency could.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from levid.benchmarks.harness.table import Figure, Target
from levid.benchmarks.identification.contenders import LAG_S, impulse_taps
from levid.identification.nonparametric.frequency_response import (
    plant_from_sensitivity,
    sensitivity,
)
from levid.identification.nonparametric.markov_parameters import estimate_markov
from levid.identification.records.from_log import from_log
from levid.identification.records.record import PiController, Record, operating_points
from levid.identification.subspace.delay_removal import without_delay
from levid.identification.subspace.ho_kalman import Scaling, decompose, realise
from levid.identification.subspace.plant_from_loop import IdentifiedPlant, plant_from_loop
from levid.log.reader import read_log

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

WITHIN_95 = float(np.sqrt(-np.log(0.05)))
"""So many standard deviations hold 95 % of a circular complex normal variable: 1.73."""
_MOST_DELAY_US = 100.0
"""A tenth of a period: a force acts from the next cycle on, on every backend. Cycles that are late
or whose setpoints are lost delay some of them by a whole one."""
_LEAST_AGREEING = 92.0
"""Percent of what holds 95: neighbouring frequencies share noise, and entries of one flight too."""
_GAIN_SE = 2.58
"""Standard errors that a flight without any difference exceeds in one of 100."""
_SEEN_SE = 1.96 + 0.84
"""A difference of so many standard errors is found in 80 of 100 cases by a test at 5 %."""


@dataclass(frozen=True)
class Plants:
    """P (B, F, 3, 3) at each beam position by both ways, (15)'s deviation; rows identified from."""

    freq_hz: Array
    ho_kalman: Complex
    spectral: Complex
    deviation: Array
    rows: int

    @classmethod
    def of(cls, logs: Sequence[Path], segment_s: float) -> Plants:
        """Identify from the records of a session; raises IdentificationError."""
        records = [from_log(read_log(path)) for path in logs]
        freq_hz = np.unique(np.round(np.geomspace(1.0, 64.0, 60) * segment_s)) / segment_s
        ho_kalman, spectral, deviation = [], [], []
        for point in operating_points(records):
            controller = point.records[0].controller
            assert controller is not None
            S = sensitivity(point.records, freq_hz, segment_s)
            P = plant_from_sensitivity(S, controller)
            spectral.append(P.H)
            deviation.append(P.standard_deviation)
            ho_kalman.append(_ho_kalman(point.records, controller).response(freq_hz))
        rows = sum(len(record.y) for record in records)
        return cls(freq_hz, *map(np.array, (ho_kalman, spectral, deviation)), rows)


class Difference(NamedTuple):
    """Of one flight's P from the reference's: its own delay, and what is left without that.

    agree: share of entries of (15) within their 95 % region. entry_se: relative standard error of
    the difference of a diagonal entry at one frequency, the median. gain: common relative
    difference of all diagonal entries, gain_se its standard error. ho_kalman: rms relative
    difference of the diagonal by Ho-Kalman.
    """

    delay_s: float
    delay_se_s: float
    agree: float
    entry_se: float
    gain: float
    gain_se: float
    ho_kalman: float


def difference(found: Plants, reference: Plants) -> Difference:
    """Compare two flights that are independent of each other: other noise, other excitation."""
    freq_hz = found.freq_hz[:, None]
    deviation = np.hypot(found.deviation, reference.deviation)
    se = _diagonal(deviation) / np.abs(_diagonal(reference.spectral))
    ratio = _diagonal(found.spectral) / _diagonal(reference.spectral)
    # Of a small circular error its phase has half the variance, its logarithm's modulus the rest.
    weight = 2.0 / se**2
    moment = 2.0 * np.pi * freq_hz * weight
    delay_s = -float((moment * np.angle(ratio)).sum() / (2 * np.pi * freq_hz * moment).sum())
    delay_se_s = float(1.0 / np.sqrt((2 * np.pi * freq_hz * moment).sum()))
    back = np.exp(2j * np.pi * found.freq_hz * delay_s)[None, :, None, None]
    off = np.abs(found.spectral * back - reference.spectral)
    ratio = _diagonal(found.spectral * back) / _diagonal(reference.spectral)
    by_ho_kalman = _diagonal(found.ho_kalman * back) / _diagonal(reference.ho_kalman)
    return Difference(
        delay_s,
        delay_se_s,
        float(np.mean(off < WITHIN_95 * deviation)),
        float(np.median(se)),
        float((weight * (ratio.real - 1.0)).sum() / weight.sum()),
        float(1.0 / np.sqrt(weight.sum())),
        float(np.sqrt(np.mean(np.abs(by_ho_kalman - 1.0) ** 2))),
    )


def agreement_figures(name: str, who: str, it: Difference) -> list[Figure]:
    """Return what was found, and the smallest differences that would have been."""
    return [
        Figure(
            f"{name}_agree_percent",
            100.0 * it.agree,
            "%",
            f"{who}: P by (15), all entries: within the 95 % region of loopback's",
            target=Target(least=_LEAST_AGREEING),
        ),
        Figure(
            f"{name}_entry_se_percent",
            100.0 * it.entry_se,
            "%",
            f"{who}: standard error of an entry's difference, diagonal, median",
        ),
        Figure(
            f"{name}_entry_seen_percent",
            100.0 * WITHIN_95 * it.entry_se,
            "%",
            f"{who}: the least that leaves the region at one frequency",
        ),
        Figure(
            f"{name}_gain_percent",
            100.0 * it.gain,
            "%",
            f"{who}: common gain, difference",
            target=Target(least=-100.0 * _GAIN_SE * it.gain_se, most=100.0 * _GAIN_SE * it.gain_se),
        ),
        Figure(f"{name}_gain_se_percent", 100.0 * it.gain_se, "%", f"{who}: its standard error"),
        Figure(
            f"{name}_gain_seen_percent",
            100.0 * _SEEN_SE * it.gain_se,
            "%",
            f"{who}: the least that would be seen (5 %, power 80 %)",
        ),
        Figure(f"{name}_differ_percent", 100.0 * it.ho_kalman, "%", f"{who}: Ho-Kalman, rms"),
        Figure(
            f"{name}_delay_us",
            1e6 * it.delay_s,
            "us",
            f"{who}: its own delay, taken out",
            target=Target(least=-_MOST_DELAY_US, most=_MOST_DELAY_US),
        ),
        Figure(f"{name}_delay_se_us", 1e6 * it.delay_se_s, "us", f"{who}: its standard error"),
    ]


def _ho_kalman(records: Sequence[Record], controller: PiController) -> IdentifiedPlant:
    """Return P from Markov parameters by least squares, as tenkhz does."""
    first = records[0]
    pole = float(np.exp(-first.Ts_s / LAG_S))
    g = estimate_markov(records, impulse_taps(records), "least_squares").g
    series = without_delay(g, first.leading_zeros, pole, controller, first.Ts_s)
    loop = realise(decompose(series, first.Ts_s, Scaling.of(records)), 9)
    return IdentifiedPlant(plant_from_loop(loop, controller), first.leading_zeros, pole)


def _diagonal(P: NDArray[Any]) -> NDArray[Any]:
    return np.einsum("bfii->bfi", P)
