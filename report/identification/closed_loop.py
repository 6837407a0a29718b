"""Summarise the closed-loop identification with a known controller (the paper's method)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...identification.results import ClosedLoopPoint
from ..figures.response_deviation import AGREEMENT, Bounds, Worst, largest, worst_on_diagonal
from ..plotting.html_page import Number, Text, Verdict
from ..plotting.labelled_frequency_responses import (
    Curve,
    Range,
    SignalLabels,
    determined,
    ratio,
    shown_range,
)
from ..plotting.style import TRUTH, doubtful, line_of, position_label

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

Truth = Callable[[float | None, Array], Complex]
"""Function of beam position in m and frequencies in Hz (F,) that returns the true P (F, m, p)."""

TRUTH_NAME = "truth of the simulator"

ESTIMATOR = {"least_squares": "least squares", "correlation": "cross-correlation"}

_TRUTH_POINTS = 240


@dataclass(frozen=True)
class ClosedLoopReport:
    """The curves of all beam positions: data of figures, numbers and tables.

    ratios: by comparison ('Ho-Kalman / truth'), one curve of ratios (F, m, p) per position.
    Positions with an unreliable Ho-Kalman model are drawn as such and not evaluated, unless there
    are no others.
    """

    points: tuple[ClosedLoopPoint, ...]
    signals: SignalLabels
    labels: tuple[str, ...]
    shown: Range
    drawn: Range
    """The Bode diagrams also show what lies above `shown`, up to half the rate: the peaks there."""
    ho_kalman: tuple[Curve, ...]
    sensitivity: tuple[Curve, ...]
    truth: tuple[Curve, ...]
    ratios: dict[str, tuple[Curve, ...]]
    bounds: Bounds = AGREEMENT

    @property
    def unreliable(self) -> tuple[tuple[str, str], ...]:
        """Labels of the positions with an unreliable Ho-Kalman model, and reasons."""
        pairs = zip(self.labels, self.points, strict=True)
        return tuple((label, "; ".join(p.doubts)) for label, p in pairs if not p.trusted)

    @property
    def trusted(self) -> bool:
        """Whether the Ho-Kalman model of any position is reliable."""
        return len(self.unreliable) < len(self.points)

    def evaluated(self, name: str) -> tuple[tuple[str, Curve], ...]:
        """Return label and ratios of the positions that a comparison evaluates."""
        pairs = tuple(zip(self.labels, self.ratios[name], strict=True))
        if not uses_ho_kalman(name) or not self.trusted:
            return pairs
        return tuple(pair for pair, p in zip(pairs, self.points, strict=True) if p.trusted)

    def worst(self, name: str) -> tuple[tuple[Worst, ...], ...]:
        """Return the largest errors of one comparison, by position and DOF."""
        return tuple(worst_on_diagonal(curve, self.shown) for curve in self.ratios[name])

    def largest(self, name: str) -> tuple[float, float]:
        """Return the largest errors of the evaluated positions in dB and degrees."""
        return largest([curve for _, curve in self.evaluated(name)], self.shown)


HO_KALMAN, SENSITIVITY = "Ho-Kalman", "sensitivity"
METHOD = {
    HO_KALMAN: "the model by Ho-Kalman's algorithm",
    SENSITIVITY: "the frequency response from the sensitivity",
}


def uses_ho_kalman(name: str) -> bool:
    """Return whether a comparison uses the Ho-Kalman model."""
    return HO_KALMAN in name.split(" / ")


def closed_loop_report(
    points: Sequence[ClosedLoopPoint], signals: SignalLabels, truth: Truth | None = None
) -> ClosedLoopReport:
    """Collect the curves of the operating points, in ascending order of the beam's position."""
    beams = [point.beam_m for point in points]
    labels = tuple(position_label(beam, beams) for beam in beams)
    lines = [line_of(k) for k in range(len(points))]
    modes_hz = [f for p in points for f, _ in modes_of(p)]
    shown = shown_range(float(points[0].freq_hz[0]), float(points[0].freq_hz[-1]), modes_hz)
    positions = list(zip(points, labels, lines, strict=True))
    ho_kalman = tuple(
        Curve(label, line, p.freq_hz, p.from_ho_kalman)
        if p.trusted
        else Curve(f"{label}, not reliable", doubtful(line), p.freq_hz, p.from_ho_kalman)
        for p, label, line in positions
    )
    measured = tuple(
        Curve(
            label,
            line,
            p.from_sensitivity.freq_hz,
            p.from_sensitivity.H,
            p.from_sensitivity.standard_deviation,
        )
        for p, label, line in positions
    )
    shown = determined(shown, measured)
    ratios: dict[str, tuple[Curve, ...]] = {}
    truths: tuple[Curve, ...] = ()
    if truth is not None:
        f = np.geomspace(shown.low_hz, float(points[0].freq_hz[-1]), _TRUTH_POINTS)
        truths = tuple(Curve(TRUTH_NAME, TRUTH, f, truth(b, f)) for b in beams)
        for name, estimates in ((HO_KALMAN, ho_kalman), (SENSITIVITY, measured)):
            exact = [
                Curve("", TRUTH, estimate.freq_hz, truth(beam, estimate.freq_hz))
                for estimate, beam in zip(estimates, beams, strict=True)
            ]
            ratios[f"{name} / truth"] = _ratios(estimates, exact)
    ratios[f"{HO_KALMAN} / {SENSITIVITY}"] = _ratios(ho_kalman, measured)
    top_hz = float(points[0].freq_hz[-1])
    drawn = replace(shown, high_hz=max(top_hz, shown.high_hz), valid_to_hz=shown.top_hz)
    return ClosedLoopReport(
        tuple(points), signals, labels, shown, drawn, ho_kalman, measured, truths, ratios
    )


def modes_of(point: ClosedLoopPoint) -> list[tuple[float, float]]:
    """Return frequency in Hz and damping ratio of the modes of the plant by Ho-Kalman."""
    poles = np.linalg.eigvals(point.plant.core.A)
    with np.errstate(divide="ignore"):
        s = np.log(poles.astype(complex)) / point.plant.core.Ts_s
    return sorted(
        (float(abs(x) / (2 * np.pi)), float(-x.real / abs(x)))
        for x in s
        if x.imag >= 0 and np.isfinite(x) and abs(x) > 0
    )


def closed_loop_words(report: ClosedLoopReport) -> tuple[Text, ...]:
    """Return the sentences of the summary."""
    main = next(iter(report.points[0].markov))
    found = (
        f"Ho-Kalman's model of the loop has {_numbers(p.order for p in report.points)} states; the "
        f"singular values of the impulse response by {ESTIMATOR.get(main, main)} show "
        f"{_numbers(_shown(p, main) for p in report.points)} above its noise. The plant has "
        f"{_numbers(len(p.plant.core.A) for p in report.points)}; the others are the controller's "
        "integrators."
    )
    span = f"From {report.shown.bottom_hz:.3g} to {report.shown.top_hz:.3g} Hz on the diagonal of P"
    agreement = "; ".join(_comparison(report, name) for name in report.ratios)
    texts = [Text(found)]
    for label, why in report.unreliable:
        texts.append(Text(f"The model by Ho-Kalman at beam {label} is not reliable: {why}."))
    if report.unreliable and report.trusted:
        texts.append(Text("The following figures of this model are of the other positions."))
    texts.append(Text(f"{span}, {agreement}."))
    fits = _fits(report)
    if fits.size:
        kept_back = (
            "Held-out rows, simulated in the loop: the excited outputs fit by "
            f"{fits.min():.1f} to {fits.max():.1f} %."
        )
        texts.append(Text(kept_back))
    return tuple(texts)


def closed_loop_numbers(report: ClosedLoopReport) -> tuple[Number, ...]:
    """Return the numbers of the summary."""
    orders = _numbers(p.order for p in report.points)
    meaning = "states of the loop by Ho-Kalman"
    numbers = [Number(orders, meaning, "none" if report.trusted else "doubt")]
    for label, why in report.unreliable:
        numbers.append(Number("not reliable", f"model by Ho-Kalman, beam {label}: {why}", "doubt"))
    for name in report.ratios:
        first, second = name.split(" / ")
        if second != "truth" and report.truth:
            continue
        decibel, degree = report.largest(name)
        kept = decibel <= report.bounds.decibel and degree <= report.bounds.degree
        against = "the truth" if second == "truth" else second
        meaning = f"{first} against {against} at worst, up to {report.shown.top_hz:.3g} Hz"
        verdict: Verdict = "good" if kept else "bad"
        if uses_ho_kalman(name) and report.unreliable:
            verdict = verdict if report.trusted else "doubt"
            meaning += ", where it is reliable" if report.trusted else "; not reliable"
        numbers.append(Number(f"{decibel:.2f} dB, {degree:.1f}°", meaning, verdict))
    fits = _fits(report)
    if fits.size:
        meaning = "lowest fit on held-out data"
        if report.trusted:
            numbers.append(Number(f"{fits.min():.1f} %", meaning))
        else:
            numbers.append(Number(f"{fits.min():.1f} %", f"{meaning}; not reliable", "doubt"))
    return tuple(numbers)


def _shown(point: ClosedLoopPoint, method: str) -> int:
    return int(np.sum(point.singular_values[method] > point.noise_levels[method]))


def _comparison(report: ClosedLoopReport, name: str) -> str:
    first, second = name.split(" / ")
    decibel, degree = report.largest(name)
    error = f"{decibel:.2f} dB and {degree:.1f}°"
    if second == "truth":
        return f"{METHOD[first]} is within {error} of the simulator's truth"
    return f"{METHOD[first]} and {METHOD[second]} differ by at most {error}"


def _numbers(values: Iterable[int]) -> str:
    return " or ".join(str(n) for n in sorted(set(values)))


def _ratios(estimates: Sequence[Curve], references: Sequence[Curve]) -> tuple[Curve, ...]:
    return tuple(
        Curve(e.label, e.line, e.freq_hz, ratio(e, r))
        for e, r in zip(estimates, references, strict=True)
    )


def _fits(report: ClosedLoopReport) -> Array:
    """Return the fits of all records' excited outputs."""
    points = [p for p in report.points if p.trusted] or report.points
    held = [h for point in points for h in point.holdout]
    fits = [h.simulated_fit_percent[h.driven] for h in held if h.driven is not None]
    together = np.concatenate([np.zeros(0), *fits])
    return np.asarray(together[np.isfinite(together)])
