"""Summarise the plant by the subspace method: response, modes, uncertainties."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ...identification.greybox.identify_greybox import GreyBox
from ...identification.greybox.modes.natural_modes import Origin, natural_modes
from ...identification.results import ClosedLoopPoint, SubspacePoint
from ...identification.subspace.response_uncertainty import SURE_95
from ..figures.bode import bode_magnitude, bode_phase
from ..figures.compute_fitted_response import places_of
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
    determined,
    ratio,
    shown_range,
)
from ..plotting.number_format import interval
from ..plotting.style import TRUTH, doubtful, line_of, position_label
from ..session.session_page import listed
from .closed_loop import HO_KALMAN, METHOD, TRUTH_NAME, Truth

Array = NDArray[np.float64]

SUBSPACE = "subspace"
_METHODS = {**METHOD, SUBSPACE: "the model by the subspace method"}
_TRUTH_POINTS = 240
_SAME_MODE = 0.05
"""Relative distance of frequencies within which two models have the same mode."""
_ORIGINS: dict[Origin, str] = {
    "declared": "declared model",
    "bending": "bending of the structure",
    "attached": "body that moves on the structure",
}


@dataclass(frozen=True)
class SubspaceReport:
    """The positions with a subspace model, their curves, and the curves to compare with.

    The curves' bands are the 95 % interval of the magnitude. ratios: by comparison ('subspace /
    truth'), one curve of ratios (F, m, p) per position. known: natural frequencies of the fitted
    model and the modes beside it at each position, if there is one. measured: where Ho-Kalman's
    model is compared, as the measured response is clear of its noise there.
    """

    points: tuple[ClosedLoopPoint, ...]
    models: tuple[SubspacePoint, ...]
    signals: SignalLabels
    labels: tuple[str, ...]
    shown: Range
    curves: tuple[Curve, ...]
    truth: tuple[Curve, ...]
    ratios: dict[str, tuple[Curve, ...]]
    measured: Range
    known: tuple[tuple[tuple[float, Origin], ...], ...] = ()

    def compared(self, name: str) -> Range:
        """Return where the responses of a comparison are evaluated."""
        return self.measured if HO_KALMAN in name else self.shown

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
    points: Sequence[ClosedLoopPoint],
    signals: SignalLabels,
    truth: Truth | None = None,
    grey: GreyBox | None = None,
) -> SubspaceReport:
    """Collect the curves of all positions with a subspace model.

    grey: the fitted model of the same records, which says what the states belong to.

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
    shown = shown_range(float(frequencies[0]), float(frequencies[-1]), modes_hz)
    curves, ho_kalman, exact = [], [], []
    for (k, point, model), label in zip(chosen, labels, strict=True):
        r = model.response
        # Figures draw CONFIDENCE deviations, which is for complex errors; this error is real.
        wide = SURE_95 / CONFIDENCE
        bands = wide * r.magnitude_deviation, wide * r.phase_deviation_rad
        line = line_of(k) if model.trusted else doubtful(line_of(k))
        name = label if model.trusted else f"{label}, not reliable"
        curves.append(Curve(name, line, r.freq_hz, r.H, *bands))
        other = line_of(k) if point.trusted else doubtful(line_of(k))
        ho_kalman.append(Curve(label, other, point.freq_hz, point.from_ho_kalman))
        if truth is not None:
            exact.append(Curve("", TRUTH, r.freq_hz, truth(point.beam_m, r.freq_hz)))
    shown = determined(shown, curves, min(model.found.top_hz for _, _, model in chosen))
    measured = [
        Curve("", line_of(k), r.freq_hz, r.H, r.standard_deviation)
        for k, r in enumerate(p.from_sensitivity for _, p, _ in chosen)
    ]
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
        determined(shown, measured),
        _known(grey, [p for _, p, _ in chosen]),
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
        f"{top:.3g} Hz{_certainty(report)}. Up to {report.shown.top_hz:.3g} Hz, the 95 % "
        f"interval of its diagonal is {_short(report.uncertainty_db())} dB or less"
    )
    compared = [f"; {_comparison(report, name)}" for name in report.ratios]
    return (Text(f"{text}{''.join(compared)}. {use}{_rest(report)}"),)


def _rest(report: SubspaceReport) -> str:
    worst = max((m.found for m in report.models), key=lambda found: found.worst)
    if worst.white:
        return ""
    return (
        f" At {worst.worst_hz:.3g} Hz a part of the response is no mode: the plant is not linear "
        "there, or differs between the records; the intervals include it."
    )


def _certainty(report: SubspaceReport) -> str:
    others = sorted({n for m in report.models for n in m.found.doubtful_orders})
    if others:
        return f"; {listed([str(n) for n in others])} states are nearly as likely"
    return ""


def subspace_numbers(report: SubspaceReport) -> tuple[Number, ...]:
    """Return the numbers of the summary."""
    top = f"up to {report.shown.top_hz:.3g} Hz"
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
        picture = deviation(curves, report.signals, bounds=ACCURACY, shown=report.compared(name))
        compared = report.compared(name)
        error = error_text(largest(curves, compared))
        parts.append(
            Picture(
                f"subspace-agreement-{number}",
                to_svg(picture),
                f"Error of {first} against {second} in dB and degrees on the diagonal.",
                f"{_upper(_METHODS[first])} against {against}: up to "
                f"{compared.top_hz:.3g} Hz {error} at most; "
                f"{bounds_text(curves, ACCURACY, compared)}.",
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
    compared = report.compared(name)
    error = error_text(largest(report.ratios[name], compared))
    if second == "truth":
        return f"it is within {error} of the simulator's truth"
    return f"{_METHODS[first]} differs from it by at most {error} up to {compared.top_hz:.3g} Hz"


def _differences_table(report: SubspaceReport) -> Table:
    rows = []
    for name, curves in report.ratios.items():
        for label, curve in zip(report.labels, curves, strict=True):
            compared = report.compared(name)
            worst = worst_on_diagonal(curve, compared)
            cells = (error_text((w.decibel, w.degree), ", ") for w in worst)
            span = f"{compared.bottom_hz:.3g} to {compared.top_hz:.3g}"
            rows.append((name.replace(" / ", " against "), label, span, *cells))
    diagonal = [report.signals.path(i, i) for i in range(min(report.signals.shape))]
    head = ("compared", "beam", "Hz", *diagonal)
    return Table("Largest differences", head, tuple(rows), labels=3)


def _known(
    grey: GreyBox | None, points: Sequence[ClosedLoopPoint]
) -> tuple[tuple[tuple[float, Origin], ...], ...]:
    if grey is None or grey.loop is None:
        return ()
    places = {place.beam_m: place.schedule for place in places_of(grey, points)}
    if not all(p.beam_m in places for p in points):
        return ()
    return tuple(natural_modes(grey.loop.fit.plant, places[p.beam_m]) for p in points)


def _modes_table(report: SubspaceReport) -> Table:
    rows = []
    for number, (model, label) in enumerate(zip(report.models, report.labels, strict=True)):
        m = model.modes
        names = _origins(m.frequency_hz, report.known[number]) if report.known else ()
        for k in range(len(m.frequency_hz)):
            frequency = interval(m.frequency_hz[k], m.frequency_se_hz[k])
            damping = interval(m.damping[k], m.damping_se[k])
            rows.append((label, frequency, damping, *names[k : k + 1]))
    head = ("beam", "frequency Hz", "damping ζ", *(["belongs to"] if report.known else []))
    return Table("Modes by the subspace method, with 95 % intervals", head, tuple(rows))


def _origins(found_hz: Array, known: Sequence[tuple[float, Origin]]) -> list[str]:
    """Return what each mode belongs to: the nearest known one, each of which counts once."""
    apart = np.abs(np.log(found_hz[:, None] / np.array([f for f, _ in known])))
    names = ["" for _ in found_hz]
    pairs = np.transpose(linear_sum_assignment(apart)).tolist()
    for k, j in pairs:
        if apart[k, j] < _SAME_MODE:
            names[k] = _ORIGINS[known[j][1]]
    return names


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
