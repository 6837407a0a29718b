"""Summarise multisine records: best linear approximation, noise and nonlinear distortion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...identification.nonparametric.nonlinear_distortion import ExcessTest
from ...identification.nonparametric.robust_multisine import BestLinearApproximation
from ...identification.records.record import BEAM_POSITION_TOLERANCE_M
from ..figures.bode import bode_magnitude, bode_phase
from ..figures.nonlinear_distortion import (
    OutputLevels,
    Response,
    detection_levels,
    response_with_distortion,
)
from ..figures.response_deviation import ACCURACY, bounds_text, deviation, error_text, largest
from ..plotting.figure_to_svg import Picture, to_svg
from ..plotting.html_page import Number, Part, Section, Table, Text, Verdict
from ..plotting.labelled_frequency_responses import (
    CONFIDENCE,
    Curve,
    Range,
    SignalLabels,
    determined,
    inside,
    ratio,
    shown_range,
)
from ..plotting.number_format import chance
from ..plotting.style import TRUTH, line_of, position_label, signed
from .closed_loop import TRUTH_NAME, Truth
from .significance import SIGNIFICANT

Array = NDArray[np.float64]

_TRUTH_POINTS = 240
_LINES_DRAWN = 140


@dataclass(frozen=True)
class MultisineReport:
    """The approximations in ascending order of position, their curves, and the ratios to the truth.

    The curves' deviations make the band in figures the radius of the 95 % confidence circle.
    """

    blas: tuple[BestLinearApproximation, ...]
    signals: SignalLabels
    labels: tuple[str, ...]
    shown: Range
    curves: tuple[Curve, ...]
    truth: tuple[Curve, ...]
    ratios: tuple[Curve, ...]

    def distorted(self) -> list[tuple[int, int]]:
        """Return (position, output) of all significant distortions."""
        return _significant([bla.test() for bla in self.blas])

    def kinds(self) -> tuple[str, ...]:
        """Return the kinds of distortion that unexcited lines show: odd, even or both."""
        tests = (
            ("odd", [bla.odd.test() for bla in self.blas]),
            ("even", [bla.even.test() for bla in self.blas]),
        )
        return tuple(kind for kind, of_kind in tests if _significant(of_kind))

    def uncertainty_db(self) -> float:
        """Return the largest 95 % confidence radius on the diagonal in dB, up to top_hz."""
        worst = [0.0]
        for bla in self.blas:
            part = (bla.freq_hz >= self.shown.bottom_hz) & (bla.freq_hz <= self.shown.top_hz)
            for i in range(min(bla.H.shape[1:])):
                with np.errstate(divide="ignore", invalid="ignore"):
                    share = bla.radius()[part, i, i] / np.abs(bla.H[part, i, i])
                worst.append(float(np.max(20 * np.log10(1 + share), initial=0.0)))
        return float(np.max(worst))


def multisine_report(
    blas: Sequence[BestLinearApproximation], signals: SignalLabels, truth: Truth | None = None
) -> MultisineReport:
    """Collect the curves of approximations at one or more positions."""
    blas = sorted(blas, key=lambda bla: bla.beam_m or 0.0)
    beams = [bla.beam_m for bla in blas]
    labels = _labels(blas)
    shown = shown_range(
        min(float(bla.freq_hz[0]) for bla in blas),
        max(float(bla.freq_hz[-1]) for bla in blas),
    )
    curves = tuple(
        Curve(label, line_of(k), bla.freq_hz, bla.H, bla.radius() / CONFIDENCE)
        for k, (bla, label) in enumerate(zip(blas, labels, strict=True))
    )
    shown = determined(shown, curves)
    truths: tuple[Curve, ...] = ()
    ratios: tuple[Curve, ...] = ()
    if truth is not None:
        f = np.geomspace(shown.low_hz, shown.high_hz, _TRUTH_POINTS)
        truths = tuple(Curve(TRUTH_NAME, TRUTH, f, truth(beam, f)) for beam in beams)
        ratios = tuple(
            Curve(c.label, c.line, c.freq_hz, ratio(c, replace(c, response=truth(beam, c.freq_hz))))
            for c, beam in zip(curves, beams, strict=True)
        )
    return MultisineReport(tuple(blas), signals, labels, shown, curves, truths, ratios)


def _positions(blas: Sequence[BestLinearApproximation]) -> list[float | None]:
    """Return the positions in ascending order; those within 1 mm are set to the first."""
    positions: list[float | None] = []
    last: float | None = None
    for beam in (bla.beam_m for bla in blas):
        if beam is None or last is None or beam - last > BEAM_POSITION_TOLERANCE_M:
            last = beam
        positions.append(last)
    return positions


def _labels(blas: Sequence[BestLinearApproximation]) -> tuple[str, ...]:
    """Return the positions' labels, with record names if a position has several levels."""
    positions = _positions(blas)
    distinct = list(dict.fromkeys(positions))
    labels = []
    for bla, position in zip(blas, positions, strict=True):
        label = position_label(position, distinct)
        alone = positions.count(position) == 1
        labels.append(label if alone else f"{label}, {', '.join(bla.records)}")
    return tuple(labels)


def multisine_words(report: MultisineReport) -> tuple[Text, ...]:
    """Return the sentences of the summary."""
    first = report.blas[0]
    positions = len(set(_positions(report.blas)))
    texts = [
        f"Multisines give the best linear approximation at {len(first.freq_hz)} lines from "
        f"{first.freq_hz[0]:.3g} to {first.freq_hz[-1]:.3g} Hz"
        + (f" and {positions} beam positions" if positions > 1 else "")
        + f". Up to {report.shown.top_hz:.3g} Hz its diagonal is known with 95 % confidence to "
        f"{_short(report.uncertainty_db())} dB",
    ]
    if report.ratios:
        error = error_text(largest(report.ratios, report.shown))
        texts[0] += f", and within {error} of the simulator's truth"
    return Text(f"{texts[0]}."), Text(_distortion_words(report))


def multisine_numbers(report: MultisineReport) -> tuple[Number, ...]:
    """Return the numbers of the summary."""
    top = f"up to {report.shown.top_hz:.3g} Hz"
    numbers = [
        Number(f"{_short(report.uncertainty_db())} dB", f"95 % confidence by multisines, {top}"),
        Number(*_distortion_number(report)),
    ]
    if report.ratios:
        decibel, degree = largest(report.ratios, report.shown)
        kept = decibel <= ACCURACY.decibel and degree <= ACCURACY.degree
        verdict: Verdict = "good" if kept else "bad"
        meaning = f"multisines against the truth at worst, {top}"
        numbers.append(Number(error_text((decibel, degree), ", "), meaning, verdict))
    return tuple(numbers)


def multisine_sections(report: MultisineReport) -> tuple[Section, ...]:
    """Return the sections on the response and on its distortion."""
    return (
        Section("Best linear approximation", _response_parts(report)),
        Section("Noise and distortion apart", _distortion_parts(report)),
    )


def _short(value: float) -> str:
    return f"{value:.2g}" if value < 10.0 else f"{value:.0f}"


def level_db(bla: BestLinearApproximation, i: int) -> float:
    """Return the distortion power over the power of output i at all excited lines, in dB."""
    excess = np.sum(bla.total_level[:, i] ** 2 - bla.noise_level[:, i] ** 2)
    power = np.sum(bla.output_level[:, i] ** 2)
    return float(10 * np.log10(excess / power)) if excess > 0 and power > 0 else float("-inf")


def _distortion_words(report: MultisineReport) -> str:
    lines = {
        (): "lines left out do not show it",
        ("odd",): "lines left out show an odd nonlinearity, as of a spring that hardens",
        ("even",): "lines left out show an even nonlinearity, an asymmetry",
        ("odd", "even"): "lines left out show both an odd and an even nonlinearity",
    }[report.kinds()]
    distorted = report.distorted()
    if not distorted and report.kinds():
        scatter = "is too small to show" if _tested(report) else "is not told by one realisation"
        return f"There is nonlinear distortion, whose size {scatter}: {lines}."
    if not _tested(report):
        return "With one realisation noise and nonlinear distortion cannot be told apart."
    if not distorted:
        return "No nonlinear distortion stands above the noise: at this amplitude it is linear."
    k, i = max(distorted, key=lambda at: report.blas[at[0]].test().ratio[at[1]])
    symbols = report.signals.output_symbols
    outputs = [symbols[o] for o in sorted({o for _, o in distorted})]
    worst, where = report.blas[k], f"beam {report.labels[k]}"
    return (
        f"Nonlinear distortion stands above the noise in {', '.join(outputs)}, most in "
        f"{symbols[i]}, {where}: the scatter over realisations has {worst.test().ratio[i]:.2f} "
        f"times the power of that over periods, {_decibels(level_db(worst, i))} of the output; "
        f"{lines}. The confidence given holds it."
    )


def _distortion_number(report: MultisineReport) -> tuple[str, str]:
    if not _tested(report) and not report.kinds():
        return "not told", "nonlinear distortion: one realisation only"
    distorted = report.distorted()
    if not distorted and report.kinds():
        return " and ".join(report.kinds()), "nonlinear distortion, at lines left out alone"
    if not distorted:
        return "none", "nonlinear distortion above the noise"
    worst = max(level_db(report.blas[k], i) for k, i in distorted)
    return _decibels(worst), "nonlinear distortion of an output, the most"


def _tested(report: MultisineReport) -> bool:
    return any(np.isfinite(bla.test().p_value).any() for bla in report.blas)


def _significant(tests: Sequence[ExcessTest]) -> list[tuple[int, int]]:
    p = np.array([test.p_value for test in tests])
    number = max(int(np.isfinite(p).sum()), 1)
    with np.errstate(invalid="ignore"):
        return [(int(k), int(i)) for k, i in np.argwhere(p * number < SIGNIFICANT)]


def _response_parts(report: MultisineReport) -> tuple[Part, ...]:
    curves = [inside(c, report.shown, _LINES_DRAWN) for c in report.curves]
    beneath = " The wide grey lines beneath are the simulator's truth." if report.truth else ""
    parts: list[Part] = [
        Picture(
            "multisine-magnitude",
            to_svg(bode_magnitude(curves, report.signals, truth=report.truth, shown=report.shown)),
            "Bode magnitude of the best linear approximation, every input to every output.",
            "Magnitude of P from periodic records, without any model and without leakage; bands "
            f"hold 95 % of noise and distortion.{beneath}",
            "Fig. 12",
        ),
        Picture(
            "multisine-phase",
            to_svg(bode_phase(curves, report.signals, truth=report.truth, shown=report.shown)),
            "Phase of the best linear approximation, every input to every output.",
            f"Phase of the same, where it is known to 60°.{beneath}",
        ),
    ]
    if report.ratios:
        error = largest(report.ratios, report.shown)
        parts.append(
            Picture(
                "multisine-agreement",
                to_svg(
                    deviation(report.ratios, report.signals, bounds=ACCURACY, shown=report.shown)
                ),
                "Error of the best linear approximation against the truth in dB and degrees.",
                f"The best linear approximation against the simulator's truth: up to "
                f"{report.shown.top_hz:.3g} Hz {error_text(error)} at most; "
                f"{bounds_text(report.ratios, ACCURACY, report.shown)}.",
            )
        )
    return tuple(parts)


def _distortion_parts(report: MultisineReport) -> tuple[Part, ...]:
    k = _most_distorted(report)
    bla, where = report.blas[k], f"beam {report.labels[k]}"
    chosen = ", where distortion is largest" if len(report.blas) > 1 and _tested(report) else ""
    return (
        Picture(
            "distortion-response",
            to_svg(response_with_distortion(Response.of(bla), report.signals, shown=report.shown)),
            "Magnitude of the plant above the errors of its estimate, noise and distortion apart.",
            f"Magnitude of P above the standard deviations of its estimate, {where}{chosen}. "
            "Crosses above the grey line are distortion.",
        ),
        Picture(
            "distortion-lines",
            to_svg(detection_levels(OutputLevels.of(bla), report.signals, shown=report.shown)),
            "Spectra of the outputs at excited lines and at lines left out.",
            f"Outputs at excited lines, and at odd and even lines left out of the excitation, "
            f"{where}. A linear plant leaves nothing but noise there.",
        ),
        _tests_table(report),
    )


def _most_distorted(report: MultisineReport) -> int:
    ratios = [np.nan_to_num(bla.test().ratio).max() for bla in report.blas]
    return int(np.argmax(ratios)) if _tested(report) else len(report.blas) // 2


def _tests_table(report: MultisineReport) -> Table:
    rows = []
    for bla, label in zip(report.blas, report.labels, strict=True):
        tests = (bla.test(), bla.odd.test(), bla.even.test())
        for i, output in enumerate(report.signals.output_symbols):
            level = level_db(bla, i) if np.isfinite(tests[0].ratio[i]) else np.nan
            cells = [c for t in tests for c in (_times(t.ratio[i]), chance(t.p_value[i]))]
            rows.append((label, output, _decibels(level), *cells))
    caption = (
        "Power over that of noise, 1 where there is no distortion, and the chance p of so much by "
        "noise alone: excited lines over realisations, odd and even lines left out"
    )
    head = ("beam", "output", "distortion", "realisations", "p", "odd", "p", "even", "p")
    return Table(caption, head, tuple(rows), labels=2)


def _decibels(level: float) -> str:
    return f"{signed(level, 0)} dB" if np.isfinite(level) else "—"


def _times(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "—"
