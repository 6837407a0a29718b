"""Summarise the plant by the subspace method: response, modes, uncertainties."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...identification.results import ClosedLoopPoint, SubspacePoint
from ...identification.subspace.response_uncertainty import SURE_95
from ..figures.bode import bode_magnitude, bode_phase
from ..figures.response_deviation import (
    ACCURACY,
    bounds_text,
    deviation,
    error_text,
    largest,
    worst_on_diagonal,
)
from ..figures.singular_values import SingularValues, Spectrum, singular_values
from ..plotting.figure_to_svg import Picture, to_svg
from ..plotting.html_page import Number, Part, Section, Table, Text, Verdict
from ..plotting.labelled_frequency_responses import (
    CONFIDENCE,
    Curve,
    Range,
    SignalLabels,
    ratio,
    shown_range,
)
from ..plotting.number_format import interval
from ..plotting.style import DOUBTFUL, TRUTH, line_of, position_label
from ..session.session_page import listed
from .closed_loop import HO_KALMAN, METHOD, TRUTH_NAME, Truth

Array = NDArray[np.float64]

SUBSPACE = "subspace"
_METHODS = {**METHOD, SUBSPACE: "the model by the subspace method"}
_TRUTH_POINTS = 240


@dataclass(frozen=True)
class SubspaceReport:
    """The positions with a subspace model, their curves, and the curves to compare with.

    The curves' bands are the 95 % interval of the magnitude. ratios: by comparison ('subspace /
    truth'), one curve of ratios (F, m, p) per position.
    """

    points: tuple[ClosedLoopPoint, ...]
    models: tuple[SubspacePoint, ...]
    signals: SignalLabels
    labels: tuple[str, ...]
    shown: Range
    curves: tuple[Curve, ...]
    truth: tuple[Curve, ...]
    ratios: dict[str, tuple[Curve, ...]]

    def uncertainty_db(self) -> float:
        """Return the largest 95 % interval on the diagonal in dB, up to top_hz."""
        worst = [0.0]
        for model in self.models:
            r = model.response
            part = (r.freq_hz >= self.shown.bottom_hz) & (r.freq_hz <= self.shown.top_hz)
            for i in range(min(r.H.shape[1:])):
                share = SURE_95 * r.magnitude_deviation[part, i, i] / np.abs(r.H[part, i, i])
                worst.append(float(np.max(20 * np.log10(1 + share), initial=0.0)))
        return float(np.max(worst))


def subspace_report(
    points: Sequence[ClosedLoopPoint], signals: SignalLabels, truth: Truth | None = None
) -> SubspaceReport:
    """Collect the curves of all positions with a subspace model.

    Raises:
        ValueError: no position has a subspace model.
    """
    beams = [point.beam_m for point in points]
    chosen = [(k, p, p.subspace) for k, p in enumerate(points) if p.subspace is not None]
    if not chosen:
        raise ValueError("expected at least one position with a model by subspace, found none")
    labels = tuple(position_label(p.beam_m, beams) for _, p, _ in chosen)
    frequencies = points[0].freq_hz
    modes_hz = [f for _, _, model in chosen for f in model.modes.frequency_hz]
    shown = shown_range(float(frequencies[0]), float(frequencies[-1]), signals, modes_hz)
    curves, ho_kalman, exact = [], [], []
    for (k, point, model), label in zip(chosen, labels, strict=True):
        r = model.response
        # Figures draw CONFIDENCE deviations, which is for complex errors; this error is real.
        wide = SURE_95 / CONFIDENCE
        bands = wide * r.magnitude_deviation, wide * r.phase_deviation_rad
        line = line_of(k) if model.trusted else DOUBTFUL
        name = label if model.trusted else f"{label}, not reliable"
        curves.append(Curve(name, line, r.freq_hz, r.H, *bands))
        other = line if point.trusted else DOUBTFUL
        ho_kalman.append(Curve(label, other, point.freq_hz, point.from_ho_kalman))
        if truth is not None:
            exact.append(Curve("", TRUTH, r.freq_hz, truth(point.beam_m, r.freq_hz)))
    ratios: dict[str, tuple[Curve, ...]] = {}
    truths: tuple[Curve, ...] = ()
    if truth is not None:
        f = np.geomspace(shown.low_hz, shown.high_hz, _TRUTH_POINTS)
        truths = tuple(Curve(TRUTH_NAME, TRUTH, f, truth(p.beam_m, f)) for _, p, _ in chosen)
        ratios[f"{SUBSPACE} / truth"] = _ratios(curves, exact)
    ratios[f"{HO_KALMAN} / {SUBSPACE}"] = _ratios(ho_kalman, curves)
    return SubspaceReport(
        tuple(p for _, p, _ in chosen),
        tuple(model for _, _, model in chosen),
        signals,
        labels,
        shown,
        tuple(curves),
        truths,
        ratios,
    )


def subspace_words(report: SubspaceReport) -> tuple[Text, ...]:
    """Return the sentences of the summary."""
    states = " or ".join(str(n) for n in sorted({m.order for m in report.models}))
    top = min(m.found.top_hz for m in report.models)
    unreliable = [
        label for label, m in zip(report.labels, report.models, strict=True) if not m.trusted
    ]
    use = (
        f"It is not reliable at {', '.join(unreliable)}."
        if unreliable
        else "It is the most accurate model that assumes no physics."
    )
    text = (
        f"The subspace method identifies a plant of {states} states from the response up to "
        f"{top:.3g} Hz{_certainty(report)}. Up to {report.shown.top_hz:g} Hz, the 95 % "
        f"interval of its diagonal is {_short(report.uncertainty_db())} dB or less"
    )
    compared = "; ".join(_comparison(report, name) for name in report.ratios)
    return (Text(f"{text}; {compared}. {use}"),)


def _certainty(report: SubspaceReport) -> str:
    others = sorted({n for m in report.models for n in m.found.doubtful_orders})
    if others:
        return f"; {listed([str(n) for n in others])} states are nearly as likely"
    return ""


def subspace_numbers(report: SubspaceReport) -> tuple[Number, ...]:
    """Return the numbers of the summary."""
    top = f"up to {report.shown.top_hz:g} Hz"
    numbers = [
        Number(f"{_short(report.uncertainty_db())} dB", f"95 % confidence by subspace, {top}")
    ]
    if report.truth:
        error = largest(report.ratios[f"{SUBSPACE} / truth"], report.shown)
        kept = error[0] <= ACCURACY.decibel and error[1] <= ACCURACY.degree
        meaning = f"{SUBSPACE} against the truth at worst, {top}"
        verdict: Verdict = "good" if kept else "bad"
        if not all(model.trusted for model in report.models):
            meaning, verdict = f"{meaning}; not reliable everywhere", "doubt"
        numbers.append(Number(error_text(error, ", "), meaning, verdict))
    return tuple(numbers)


def subspace_sections(report: SubspaceReport) -> tuple[Section, ...]:
    """Return the section on the subspace model."""
    beneath = " The wide grey lines beneath are the simulator's truth." if report.truth else ""
    figure = bode_magnitude(report.curves, report.signals, truth=report.truth, shown=report.shown)
    phase = bode_phase(report.curves, report.signals, truth=report.truth, shown=report.shown)
    top_hz = min(m.found.top_hz for m in report.models)
    parts: list[Part] = [
        Picture(
            "subspace-singular-values",
            to_svg(singular_values([_spectrum(report)])),
            "Singular values of the measured response, logarithmic, and the level of its noise.",
            f"Singular values of the measured response up to {top_hz:.3g} Hz, without the known "
            "delay and lag. Dashed: the largest one that its noise has by itself; what is above "
            "it is a state of the plant.",
        ),
        Picture(
            "plant-subspace",
            to_svg(figure),
            "Bode magnitude of the plant by the subspace method, every input to every output.",
            "Magnitude of P by the subspace method, fitted to the spectra of all records; bands, "
            f"mostly narrower than the line, hold 95 % of the estimate's error.{beneath}",
        ),
        Picture(
            "plant-subspace-phase",
            to_svg(phase),
            "Phase of the plant by the subspace method, every input to every output.",
            f"Phase of the same.{beneath}",
        ),
    ]
    for number, (name, curves) in enumerate(report.ratios.items(), start=1):
        first, second = name.split(" / ")
        against = "the simulator's truth" if second == "truth" else _METHODS[second]
        picture = deviation(curves, report.signals, bounds=ACCURACY, shown=report.shown)
        error = error_text(largest(curves, report.shown))
        parts.append(
            Picture(
                f"subspace-agreement-{number}",
                to_svg(picture),
                f"Error of {first} against {second} in dB and degrees on the diagonal.",
                f"{_upper(_METHODS[first])} against {against}: up to "
                f"{report.shown.top_hz:g} Hz {error} at most; "
                f"{bounds_text(curves, ACCURACY, report.shown)}.",
            )
        )
    parts += [_differences_table(report), _modes_table(report), _fits_table(report)]
    return (Section("The plant by subspace", tuple(parts)),)


def _spectrum(report: SubspaceReport) -> Spectrum:
    orders = {m.order for m in report.models}
    return Spectrum(
        "",
        tuple(
            SingularValues(label, line_of(k), m.found.singular_values, m.found.noise_level)
            for k, (m, label) in enumerate(zip(report.models, report.labels, strict=True))
        ),
        orders.pop() if len(orders) == 1 else None,
    )


def _comparison(report: SubspaceReport, name: str) -> str:
    first, second = name.split(" / ")
    error = error_text(largest(report.ratios[name], report.shown))
    if second == "truth":
        return f"it is within {error} of the simulator's truth"
    return f"{_METHODS[first]} differs from it by at most {error}"


def _differences_table(report: SubspaceReport) -> Table:
    rows = []
    for name, curves in report.ratios.items():
        for label, curve in zip(report.labels, curves, strict=True):
            worst = worst_on_diagonal(curve, report.shown)
            cells = (error_text((w.decibel, w.degree), ", ") for w in worst)
            rows.append((name.replace(" / ", " against "), label, *cells))
    diagonal = [report.signals.path(i, i) for i in range(min(report.signals.shape))]
    span = f"{report.shown.bottom_hz:g} to {report.shown.top_hz:g} Hz"
    head = ("compared", "beam", *diagonal)
    return Table(f"Largest differences from {span}", head, tuple(rows), labels=2)


def _modes_table(report: SubspaceReport) -> Table:
    rows = []
    for model, label in zip(report.models, report.labels, strict=True):
        m = model.modes
        for k in range(len(m.frequency_hz)):
            frequency = interval(m.frequency_hz[k], m.frequency_se_hz[k])
            rows.append((label, frequency, interval(m.damping[k], m.damping_se[k])))
    head = ("beam", "frequency Hz", "damping ζ")
    return Table("Modes by the subspace method, with 95 % intervals", head, tuple(rows))


def _fits_table(report: SubspaceReport) -> Table:
    rows = []
    for point, model, label in zip(report.points, report.models, report.labels, strict=True):
        for ours, theirs in zip(model.holdout, point.holdout, strict=True):
            for name, held in (SUBSPACE, ours), (HO_KALMAN, theirs):
                cells = (_percent(fit) for fit in held.simulated_fit_percent)
                rows.append((held.record, label, name, *cells))
    outputs = (f"{name} %" for name in report.signals.output_symbols)
    caption = "Fit of the loop simulated from v alone, on rows that neither estimate has seen"
    return Table(caption, ("record", "beam", "model", *outputs), tuple(rows), labels=3)


def _short(value: float) -> str:
    return f"{value:.1g}" if value < 1.0 else f"{value:.0f}"


def _upper(text: str) -> str:
    return text[:1].upper() + text[1:]


def _percent(value: float) -> str:
    return f"{value:.1f}" if np.isfinite(value) else "—"


def _ratios(estimates: Sequence[Curve], references: Sequence[Curve]) -> tuple[Curve, ...]:
    return tuple(
        Curve(e.label, e.line, e.freq_hz, ratio(e, r))
        for e, r in zip(estimates, references, strict=True)
    )
