"""Build the sections on a closed-loop identification: order, plant, agreement, basis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..figures.bode import bode_magnitude, bode_phase
from ..figures.coherence import coherence
from ..figures.markov_parameters import Markov, markov_parameters
from ..figures.response_deviation import bounds_text, deviation
from ..figures.singular_values import SingularValues, Spectrum, singular_values
from ..plotting.figure_to_svg import Picture, to_svg
from ..plotting.html_page import Part, Section, Table
from ..plotting.labelled_frequency_responses import Curve
from ..plotting.style import LineStyle, colour, line_of
from ..session.session_page import listed
from .closed_loop import (
    ESTIMATOR,
    METHOD,
    ClosedLoopReport,
    modes_of,
    uses_ho_kalman,
)

_MARKOV_SHOWN_S = 2.0
_SUBSCRIPT = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def closed_loop_sections(report: ClosedLoopReport) -> tuple[Section, ...]:
    """Return the sections on order, plant, agreement, and what else to check."""
    return (
        Section("Model order", _order_parts(report)),
        Section("Plant", _plant_parts(report)),
        Section("Agreement of the methods", _agreement_parts(report)),
        Section("Impulse response, coherence, controller", _foundation_parts(report)),
    )


def _order_parts(report: ClosedLoopReport) -> tuple[Part, ...]:
    order, plant = report.points[0].order, len(report.points[0].plant.core.A)
    spectra = [
        Spectrum(
            ESTIMATOR.get(method, method),
            tuple(
                SingularValues(
                    label, line_of(k), point.singular_values[method], point.noise_levels[method]
                )
                for k, (point, label) in enumerate(zip(report.points, report.labels, strict=True))
            ),
            order,
        )
        for method in report.points[0].singular_values
    ]
    shown = "; ".join(
        f"{listed(sorted({str(p.significant) for p in s.positions}))} by {s.title}" for s in spectra
    )
    picture = Picture(
        "singular-values",
        to_svg(singular_values(spectra[:1])),  # the others are in the table
        "Singular values of the Hankel matrix, logarithmic, and the level of its noise.",
        "Singular values of the Hankel matrix of the loop, without the known delay and lag. "
        "Dashed: the largest one that the errors of the impulse response have by themselves. "
        f"Above it are {shown}; the model has {order} states: {plant} belong to the plant and "
        f"{order - plant} to the controller's integrators.",
        "Fig. 9",
    )
    rows = tuple(
        (
            spectrum.title,
            position.label,
            str(position.significant),
            *(_digits(position.values[n]) for n in (0, order - 1) if n < len(position.values)),
            _digits(position.values[order]) if order < len(position.values) else "—",
            _digits(position.noise_level),
        )
        for spectrum in spectra
        for position in spectrum.positions
    )
    names = [f"σ{str(n).translate(_SUBSCRIPT)}" for n in (1, order, order + 1)]
    head = ("estimator", "beam", "above the noise", *names, "noise")
    return picture, Table("Singular values (scaled), and those of the noise", head, rows, labels=2)


def _plant_parts(report: ClosedLoopReport) -> tuple[Part, ...]:
    beneath = " The wide grey lines beneath are the simulator's truth." if report.truth else ""
    moved = (
        " The beam's position changes the inertia about θ and couples θ with z."
        if len(report.points) > 1
        else ""
    )
    scales = (
        " All panels span the same number of decades. Off-diagonal panels are centred at the "
        "geometric mean of both diagonals, so a low curve is a weak coupling."
    )
    states = len(report.points[0].plant.core.A)
    unreliable = _unreliable(report)
    parts: list[Part] = [
        Picture(
            "plant-ho-kalman",
            _magnitude(report, report.ho_kalman),
            "Bode magnitude of the identified plant, every input to every output.",
            f"Magnitude of P by Ho-Kalman's algorithm and (14), {states} states."
            f"{moved}{scales}{beneath}{unreliable}",
            "Fig. 10",
        ),
        Picture(
            "plant-phase",
            to_svg(
                bode_phase(report.ho_kalman, report.signals, truth=report.truth, shown=report.drawn)
            ),
            "Phase of the identified plant, every input to every output.",
            "Phase of P by Ho-Kalman's algorithm. P includes the delay of one cycle, the hold and "
            f"the current loops, so the phase falls below −180°.{beneath}{unreliable}",
        ),
        _modes_table(report),
        Picture(
            "plant-sensitivity",
            _magnitude(report, report.sensitivity),
            "Bode magnitude of the plant from the input sensitivity, every input to every output.",
            "Magnitude of P from the frequency response of the input sensitivity by (15) "
            "corrected, without a model; the bands are 95 % intervals. Scattered values are below "
            f"the noise.{beneath}",
            "Fig. 12",
        ),
    ]
    return tuple(parts)


def _magnitude(report: ClosedLoopReport, curves: Sequence[Curve]) -> str:
    figure = bode_magnitude(curves, report.signals, truth=report.truth, shown=report.drawn)
    return to_svg(figure)


def _agreement_parts(report: ClosedLoopReport) -> tuple[Part, ...]:
    parts: list[Part] = []
    for number, (name, curves) in enumerate(report.ratios.items()):
        first, second = name.split(" / ")
        decibel, degree = report.largest(name)
        against = "the simulator's truth" if second == "truth" else METHOD[second]
        parts.append(
            Picture(
                f"agreement-{number + 1}",
                to_svg(deviation(curves, report.signals, bounds=report.bounds, shown=report.shown)),
                f"Error of {first} against {second} in dB and degrees on the diagonal.",
                f"{_upper(METHOD[first])} against {against}. Up to "
                f"{report.shown.top_hz:.3g} Hz the largest difference is {decibel:.2f} dB and "
                f"{degree:.1f}°; "
                f"{bounds_text(curves, report.bounds, report.shown)}."
                + (_unreliable(report) if uses_ho_kalman(name) else ""),
            )
        )
    rows = []
    for name in report.ratios:
        labels = _marked(report) if uses_ho_kalman(name) else report.labels
        for label, worst in zip(labels, report.worst(name), strict=True):
            cells = (f"{w.decibel:.2f} dB, {w.degree:.1f}°" for w in worst)
            rows.append((name.replace(" / ", " against "), label, *cells))
    diagonal = [report.signals.path(i, i) for i in range(min(report.signals.shape))]
    span = f"{report.shown.bottom_hz:.3g} to {report.shown.top_hz:.3g} Hz"
    head = ("compared", "beam", *diagonal)
    parts.append(Table(f"Largest differences from {span}", head, tuple(rows), labels=2))
    return tuple(parts)


def _foundation_parts(report: ClosedLoopReport) -> tuple[Part, ...]:
    middle = len(report.points) // 2
    point = report.points[middle]
    faint = LineStyle(colour("truth"), width=1.0, alpha=0.7, zorder=2)
    estimates = []
    for method, estimate in reversed(list(point.markov.items())):
        line = line_of(middle) if method == next(iter(point.markov)) else faint
        line = LineStyle(line.colour, width=line.width, alpha=line.alpha, zorder=line.zorder)
        shown = round(_MARKOV_SHOWN_S / estimate.Ts_s)
        name = ESTIMATOR.get(method, method)
        estimates.append(Markov(name, line, estimate.g[:shown], estimate.Ts_s))
    spectra = [p.sensitivity for p in report.points]
    coherences = [
        Curve(label, line_of(k), S.freq_hz, S.coherence.astype(np.complex128))
        for k, (S, label) in enumerate(zip(spectra, report.labels, strict=True))
    ]
    return (
        Picture(
            "markov-parameters",
            to_svg(markov_parameters(estimates, report.signals)),
            "Impulse response of the loop by both estimators, every input to every output.",
            f"Impulse response (Markov parameters) of the loop from v to y, beam "
            f"{report.labels[middle]}. Least squares estimates all of it at once; in "
            "cross-correlation, the rest of the response is noise on each value.",
        ),
        Picture(
            "coherence",
            to_svg(coherence(coherences, report.signals, shown=report.drawn)),
            "Coherence of the feedback with the excitation, every input to every output.",
            "Coherence: share of the controller's feedback that the excitation explains. The "
            "sensitivity is accurate where it is near 1.",
        ),
        _fits_table(report),
        _controller_table(report),
    )


def _modes_table(report: ClosedLoopReport) -> Table:
    rows = []
    for point, label in zip(report.points, _marked(report), strict=True):
        cells = ", ".join(f"{f:.2f} Hz (ζ {zeta:.3f})" for f, zeta in modes_of(point))
        rows.append((label, cells))
    return Table("Modes of the identified plant", ("beam", "frequency (damping)"), tuple(rows), 2)


def _fits_table(report: ClosedLoopReport) -> Table:
    rows = [
        (held.record, label, *(_percent(fit) for fit in held.simulated_fit_percent))
        for point, label in zip(report.points, _marked(report), strict=True)
        for held in point.holdout
    ]
    outputs = (f"{name} %" for name in report.signals.output_symbols)
    caption = (
        "Fit of the loop simulated from v alone, on held-out rows. An output that hardly moves has "
        "a low fit"
    )
    return Table(caption, ("record", "beam", *outputs), tuple(rows), labels=2)


def _controller_table(report: ClosedLoopReport) -> Table:
    controller = report.points[0].controller
    plant = report.points[0].plant
    known = f"{plant.delay_steps} cycles"
    if plant.lag_pole:
        known += f", lag {-1e3 * plant.core.Ts_s / np.log(plant.lag_pole):.3g} ms"
    rows = [
        (name, f"{kp:g}", f"{ki:g}")
        for name, kp, ki in zip(
            report.signals.output_symbols, controller.kp, controller.ki, strict=True
        )
    ]
    caption = f"Controller. Known part of the plant: delay of {known}, with that of the hold"
    return Table(caption, ("axis", "Kp", "Ki"), tuple(rows))


def _marked(report: ClosedLoopReport) -> tuple[str, ...]:
    """Return the positions' labels; those with unreliable models are marked."""
    unreliable = {label for label, _ in report.unreliable}
    return tuple(f"{x}, not reliable" if x in unreliable else x for x in report.labels)


def _unreliable(report: ClosedLoopReport) -> str:
    """Return the end of a caption that names unreliable curves and the reasons."""
    reasons = "; ".join(f"{label}, because {why}" for label, why in report.unreliable)
    hatched = "" if report.trusted else ", in hatched panels"
    return f" Not reliable, dotted{hatched}: {reasons}." if reasons else ""


def _digits(value: float) -> str:
    return f"{value:#.3g}".removesuffix(".")


def _upper(text: str) -> str:
    return text[:1].upper() + text[1:]


def _percent(value: float) -> str:
    return f"{value:.1f}" if np.isfinite(value) else "—"
