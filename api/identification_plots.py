"""Draw an identification: Bode diagram of the recommended plants, and held-out outputs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from ..identification.records.record import IdentificationError
from ..identification.results import ClosedLoopPoint, OpenLoopPoint
from ..identification.subspace.held_out_simulation import HoldOut
from ..identification.subspace.response_uncertainty import SURE_95, ModelResponse
from ..report.figures.bode import bode
from ..report.figures.held_out_outputs import HeldOut, held_out_outputs
from ..report.plotting.labelled_frequency_responses import (
    CONFIDENCE,
    Curve,
    SignalLabels,
    shown_range,
)
from ..report.plotting.style import TRUTH, LineStyle, doubtful, line_of, position_label
from .notebook_figure import shown

if TYPE_CHECKING:
    from .identification import Identification

_POINTS = 400
_DECADES = 3.0


def bode_plot(found: Identification) -> Figure:
    """Draw magnitude and phase of the recommended plants, or of what else was identified."""
    s = found.signals
    inputs = s.input_names
    if inputs == s.output_names:
        inputs = tuple(f"tau_{name}" for name in inputs)
    labels = SignalLabels(inputs, s.input_units, s.output_names, s.output_units)
    curves = _curves(found)
    low, high = float(curves[0].freq_hz[0]), float(curves[0].freq_hz[-1])
    modes_hz = [mode.frequency.value for mode in found.modes]
    span = shown_range(low, high, modes_hz)
    beams = found.beam_m or (None,)
    truth = []
    if found.truth is not None:
        grid = np.geomspace(span.low_hz, span.high_hz, _POINTS)
        truth = [Curve("truth", TRUTH, grid, found.truth(beam, grid)) for beam in beams]
    return shown(bode(curves, labels, truth=truth, shown=span))


def outputs_plot(found: Identification) -> Figure:
    """Draw measured and simulated outputs of the held-out record with the worst fit.

    Raises:
        IdentificationError: no record was held out.
    """
    points = () if found.results.points is None else found.results.points.points
    held = [h for point in points for h in _held(point)]
    if not held:
        raise IdentificationError("expected held-out data of a record, found none: plot 'bode'")
    worst = min(held, key=_least_fit)
    s = found.signals
    return shown(
        held_out_outputs(
            HeldOut(
                s.output_names,
                s.output_units,
                worst.time_s,
                worst.measured,
                worst.simulated,
                worst.simulated_fit_percent,
                worst.predicted,
                worst.predicted_fit_percent,
            )
        )
    )


def _curves(found: Identification) -> list[Curve]:
    results = found.results
    if results.points is not None and results.points.points:
        points = results.points.points
        beams = [point.beam_m for point in points]
        return [
            _point_curve(point, position_label(point.beam_m, beams), line_of(k))
            for k, point in enumerate(points)
        ]
    if results.multisine:
        beams = [bla.beam_m for bla in results.multisine]
        return [
            Curve(
                position_label(bla.beam_m, beams),
                line_of(k),
                bla.freq_hz,
                bla.H,
                bla.standard_deviation,
            )
            for k, bla in enumerate(results.multisine)
        ]
    assert results.grey is not None  # a study that found nothing is an error
    top = 0.5 / results.grey.Ts_s
    freq_hz = np.geomspace(top / 10**_DECADES, 0.98 * top, _POINTS)
    return [Curve("fitted model", line_of(0), freq_hz, results.grey.response({}, freq_hz))]


def _point_curve(point: ClosedLoopPoint | OpenLoopPoint, label: str, line: LineStyle) -> Curve:
    if isinstance(point, OpenLoopPoint):
        return _with_interval(label, line, point.response)
    if point.subspace is not None and point.subspace.trusted:
        return _with_interval(label, line, point.subspace.response)
    if point.trusted:
        return Curve(label, line, point.freq_hz, point.from_ho_kalman)
    return Curve(f"{label}, not to be trusted", doubtful(line), point.freq_hz, point.from_ho_kalman)


def _with_interval(label: str, line: LineStyle, response: ModelResponse) -> Curve:
    # Figures draw CONFIDENCE deviations, which is for complex errors; this error is real.
    wide = SURE_95 / CONFIDENCE
    return Curve(
        label,
        line,
        response.freq_hz,
        response.H,
        wide * response.magnitude_deviation,
        wide * response.phase_deviation_rad,
    )


def _held(point: ClosedLoopPoint | OpenLoopPoint) -> tuple[HoldOut, ...]:
    if isinstance(point, ClosedLoopPoint) and point.subspace is not None and point.subspace.trusted:
        return point.subspace.holdout
    return point.holdout


def _least_fit(held: HoldOut) -> float:
    fits = held.simulated_fit_percent
    driven = np.ones(len(fits), bool) if held.driven is None else held.driven
    return float(np.min(fits[np.isfinite(fits) & driven], initial=np.inf))
