"""Group records by point of the schedule, and take their lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ...loop_spectra.measured_response import measured_response
from ...loop_spectra.spectral_lines import LEAST_LINES, LoopSignals, PointLines, point_lines
from ...nonparametric.frequency_response import ResponseEstimate
from ...records.record import IdentificationError
from ...records.varying_signals import varying
from ..experiment.experiment_from_log import Experiment

SAME_POINT = 1e-3
"""Share of a scheduling variable's range within which records count as taken at one point."""


def lines_by_point(
    experiments: Sequence[Experiment], band_hz: tuple[float, float]
) -> tuple[PointLines, ...]:
    """Return the lines in a band of records whose schedule rests, grouped by point and length.

    Every record has a known loop. Records with too few lines are left out.

    Raises IdentificationError if no record with an excitation has enough lines in the band.
    """
    low_hz, high_hz = band_hz
    groups = [g for g in (_point(group, band_hz) for group in by_point(experiments)) if g]
    if not any(r.excited for g in groups for r in g.records):
        longest = max(len(e.y) * e.Ts_s for e in experiments)
        raise IdentificationError(
            f"expected at least {LEAST_LINES} lines from {low_hz:g} to {high_hz:g} Hz in a record "
            f"with an excitation; the longest record, of {longest:g} s, has one line each "
            f"{1.0 / longest:.3g} Hz, up to {0.5 / experiments[0].Ts_s:g} Hz. Choose a wider band "
            "(--band), or record longer"
        )
    return tuple(groups)


def measured_responses(
    experiments: Sequence[Experiment], top_hz: float
) -> tuple[ResponseEstimate, ...]:
    """Return P (F, n, p) at each point whose records excite every input, at common frequencies."""
    excited = [e for e in experiments if e.loop is not None and varying(e.loop.v).any()]
    rows = min((len(e.y) for e in excited), default=0)
    found = []
    for group in _grouped(excited, _at_one_point):
        some = [signals(e) for e in group]
        try:
            found.append(measured_response(some, group[0].Ts_s, top_hz, rows))
        except IdentificationError:
            continue  # too few records, or too short: other points tell
    longest = max((len(r.freq_hz) for r in found), default=0)
    return tuple(r for r in found if len(r.freq_hz) == longest)


def by_point(experiments: Sequence[Experiment]) -> list[list[Experiment]]:
    """Return records at one point of the schedule, of one length and rate, together."""
    return _grouped(
        experiments, lambda one, other: len(one.y) == len(other.y) and _at_one_point(one, other)
    )


def _grouped(
    experiments: Sequence[Experiment], together: Callable[[Experiment, Experiment], bool]
) -> list[list[Experiment]]:
    groups: list[list[Experiment]] = []
    for e in experiments:
        same = next((g for g in groups if together(g[0], e)), None)
        if same is None:
            groups.append([e])
        else:
            same.append(e)
    return groups


def _at_one_point(one: Experiment, other: Experiment) -> bool:
    return one.Ts_s == other.Ts_s and all(
        abs(one.schedule[name].mean() - other.schedule[name].mean()) <= SAME_POINT * one.spans[name]
        for name in one.schedule
        if name not in one.rates
    )


def signals(e: Experiment) -> LoopSignals:
    """Return the signals of a record of a known loop."""
    assert e.loop is not None
    v = e.loop.v + e.loop.feedforward
    return LoopSignals(e.name, e.y, e.u, v, tuple(np.flatnonzero(varying(v)).tolist()))


def _point(experiments: Sequence[Experiment], band_hz: tuple[float, float]) -> PointLines | None:
    first = experiments[0]
    assert first.loop is not None
    schedule = {
        name: 0.0
        if name in first.rates
        else float(np.mean([e.schedule[name] for e in experiments]))
        for name in first.schedule
    }
    return point_lines(
        [signals(e) for e in experiments],
        schedule,
        first.Ts_s,
        first.delay_cycles * first.Ts_s,
        first.loop.controller.response,
        band_hz,
    )
