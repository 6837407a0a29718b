"""Summarise the fit of a declared model: parameters, errors over noise, whiteness, comparisons."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

from ...identification.compare_with_black_box import BesideBlackBox
from ...identification.greybox.fitted_modes import fitted_modes
from ...identification.greybox.identify_greybox import GreyBox
from ...identification.greybox.validation import Validation
from ...identification.results import ClosedLoopPoint
from ...identification.run_identification import COMPARE_COLUMNS
from ...identification.subspace.response_uncertainty import SURE_95, Modes
from ..figures.compute_fitted_response import (
    Place,
    fitted_curves,
    places_of,
    whole_curves,
)
from ..figures.response_deviation import ACCURACY, AGREEMENT, Bounds, error_text, largest
from ..plotting.html_page import Number, Text, Verdict
from ..plotting.labelled_frequency_responses import (
    Curve,
    Range,
    SignalLabels,
    determined,
    ratio,
    shown_range,
)
from ..plotting.number_format import chance
from ..plotting.style import TRUTH, LineStyle, line_of
from .closed_loop import HO_KALMAN, TRUTH_NAME, Truth
from .loop_words import loop_answer, loop_numbers, whiteness_words

FITTED = "fitted model"

NOISE_MOST = 1.5
"""Error over noise above which a model lacks something; short records reach it by chance."""
NOT_WHITE = 0.01
"""Overall p-value of all tests below which prediction errors do not count as white."""
_BEAM = "beam_m"
_CLEAR = 0.3
"""Standard deviation over the response up to which a measured response is drawn."""
_NEIGHBOURS = 9
_STANDS_OUT = 10.0
"""Ratio to the noise below which an output's motion does not test the model."""


@dataclass(frozen=True)
class GreyBoxReport:
    """The fit, its responses at scheduling points, and the responses to compare with.

    ratios: by comparison ('fitted model / truth'), one curve of ratios (F, n, p) per place.
    """

    grey: GreyBox
    signals: SignalLabels
    places: tuple[Place, ...]
    shown: Range
    compared: Range
    fitted: tuple[Curve, ...]
    measured: tuple[Curve, ...]
    """The response without a model, by (15), where it is clear of its noise."""
    truth: tuple[Curve, ...]
    ratios: dict[str, tuple[Curve, ...]]
    modes: tuple[Modes, ...]
    """Modes of the fitted model at each place."""
    whole: tuple[Curve, ...] = ()
    """The response with the modes that the records show beside the model, one curve per place."""

    @property
    def explains(self) -> bool:
        """Whether the fitted model leaves no more than noise, as far as these records show.

        In a loop: whether the band in which it is valid covers its own modes.
        """
        if self.grey.explains_nothing:
            return False
        if self.grey.loop is not None:
            return self.grey.loop.band.end_hz >= self.rigid_hz
        least, tests = least_chance(self)
        white = not tests or not least * tests < NOT_WHITE
        return white and (self.worst is None or self.worst.over_noise <= NOISE_MOST)

    @property
    def rigid_hz(self) -> float:
        """The model's highest natural frequency, 0 without any."""
        return max((float(f) for m in self.modes for f in m.frequency_hz), default=0.0)

    def bounds(self, name: str) -> Bounds:
        """Return the error bounds of a comparison."""
        return ACCURACY if name.endswith("truth") else AGREEMENT

    @property
    def moving(self) -> tuple[Validation, ...]:
        """The validations of records with moving scheduling variables."""
        pairs = zip(self.grey.validations, self.grey.fit.records, strict=True)
        return tuple(v for v, record in pairs if record.moving)

    def carries_beam(self, v: Validation) -> bool | None:
        """Return whether the feed-forward followed the beam in a record; None without a beam."""
        pairs = zip(self.grey.validations, self.grey.fit.records, strict=True)
        loop = next(record.loop for w, record in pairs if w is v)
        beam = any(x.signal == _BEAM for x in self.grey.declared.scheduling.values())
        return bool(np.any(np.ptp(loop.feedforward, axis=0))) if loop and beam else None

    @property
    def worst(self) -> Cell | None:
        """The cell with the largest ratio of error to noise."""
        return max(self.cells(), key=lambda cell: cell.over_noise, default=None)

    def cells(self) -> Iterator[Cell]:
        """Yield a cell for every output of every record with a known error."""
        for v in self.grey.validations:
            for i, output in enumerate(self.signals.output_symbols):
                if np.isfinite(v.error_rms[i]) and v.floor_rms[i] > 0:
                    yield Cell(v, output, i)

    def fits(self) -> list[Cell]:
        """Return the cells with an output well above the noise."""
        return [
            cell
            for cell in self.cells()
            if cell.stands_out and np.isfinite(cell.validation.fit_percent[cell.index])
        ]


@dataclass(frozen=True)
class Cell:
    """One output of one record."""

    validation: Validation
    output: str
    index: int

    @property
    def over_noise(self) -> float:
        """Simulation error over the noise floor."""
        return float(self.validation.error_rms[self.index] / self.validation.floor_rms[self.index])

    @property
    def spread(self) -> float:
        """Standard deviation of `over_noise` for a perfect model."""
        return float(self.validation.floor_spread[self.index])

    @property
    def stands_out(self) -> bool:
        """Whether the output moved by ten times the noise or more."""
        v = self.validation
        return bool(v.measured[:, self.index].std() > _STANDS_OUT * v.floor_rms[self.index])

    @property
    def fit_percent(self) -> float:
        """Fit of the simulation."""
        return float(self.validation.fit_percent[self.index])


def grey_box_report(
    grey: GreyBox,
    points: Sequence[ClosedLoopPoint],
    signals: SignalLabels,
    truth: Truth | None = None,
) -> GreyBoxReport:
    """Compute the curves for the report on a fit, at the beam positions of `points`.

    They are compared with the reliable Ho-Kalman models of `points`.
    """
    places = places_of(grey, points)
    lowest = max((float(v.freq_hz[1]) for v in grey.validations if len(v.freq_hz) > 1), default=0.1)
    modes = tuple(fitted_modes(grey.fit, place.schedule) for place in places)
    modes_hz = [f for m in modes for f in m.frequency_hz]
    measured = [
        Curve("", line_of(k), r.freq_hz, r.H, r.standard_deviation)
        for k, r in enumerate(p.from_sensitivity for p in points)
    ]
    compared = determined(shown_range(lowest, 0.4 / grey.Ts_s, modes_hz), measured)
    shown, whole = compared, tuple[Curve, ...]()
    if grey.loop is not None:
        band = grey.loop.band
        own_hz = float(grey.loop.fit.points[0].freq_hz[-1])
        top_hz = max([own_hz, *(float(c.freq_hz[-1]) for c in measured)])
        valid_to_hz = None if band.complete else band.end_hz
        shown = Range(compared.low_hz, top_hz, valid_to_hz, beyond="model not valid")
        if grey.loop.fit.modes:
            whole = whole_curves(grey.loop, places, shown)
    fitted = fitted_curves(grey, places, shown)
    by_beam = {p.beam_m: p for p in points if p.trusted}
    beside = [by_beam.get(place.beam_m) for place in places]
    pale = tuple(
        Curve("", line_of(k), p.freq_hz, p.from_ho_kalman)
        for k, p in enumerate(beside)
        if p is not None
    )
    ratios: dict[str, tuple[Curve, ...]] = {}
    truths: tuple[Curve, ...] = ()
    if truth is not None:
        truths = tuple(
            Curve(TRUTH_NAME, TRUTH, c.freq_hz, truth(place.beam_m, c.freq_hz))
            for c, place in zip(fitted, places, strict=True)
        )
        ratios[f"{FITTED} / truth"] = _ratios(fitted, truths)
    if pale:
        # At the frequencies of Ho-Kalman: its sharp resonances cannot be interpolated.
        there = tuple(
            replace(
                c,
                freq_hz=r.freq_hz,
                response=grey.response(place.schedule, r.freq_hz),
                deviation=None,
            )
            for c, r, place in zip(
                (c for c, p in zip(fitted, beside, strict=True) if p is not None),
                pale,
                (place for place, p in zip(places, beside, strict=True) if p is not None),
                strict=True,
            )
        )
        ratios[f"{FITTED} / {HO_KALMAN}"] = _ratios(there, pale)
    return GreyBoxReport(
        grey,
        signals,
        places,
        shown,
        compared,
        fitted,
        tuple(_beneath(c) for c in measured),
        truths,
        ratios,
        modes,
        whole,
    )


def _beneath(measured: Curve) -> Curve:
    """Return a measured response as a wide pale line, without what noise hides."""
    assert measured.deviation is not None
    clear = measured.deviation < _CLEAR * np.abs(measured.response)
    # Single frequencies where noise happens to be large are no part of the response.
    clear &= median_filter(clear, (_NEIGHBOURS, 1, 1), mode="nearest")
    line = LineStyle(measured.line.colour, width=3.2, alpha=0.3, zorder=2.5)
    response = np.where(clear, measured.response, np.nan)
    return replace(measured, line=line, response=response, deviation=None)


def grey_box_words(report: GreyBoxReport) -> tuple[Text, ...]:
    """Return the sentences of the summary."""
    fit, declared = report.grey.fit, report.grey.declared
    rows = sum(len(e.y) for e in fit.records)
    fixed = sum(p.is_fixed for p in declared.parameters.values())
    fitted = (
        f"{_count(len(fit.free), 'parameter')} of the declared model '{declared.name}' "
        f"{_were(len(fit.free))} fitted to {_count(len(fit.records), 'record')} together, "
        f"{rows * report.grey.Ts_s:.0f} s in all"
    )
    if fixed:
        fitted += f"; {fixed} more {_were(fixed)} fixed by the model file"
    texts = [f"{fitted}. {_identifiability_words(report)}"]
    texts += [f"Remark: {r}." for r in report.grey.remarks]
    texts += at_bound_sentences(report.grey)
    if report.grey.validations:
        texts.append(f"{_explained(report)} {_whiteness(report)}".strip())
    for name in report.ratios:
        error = error_text(largest(report.ratios[name], report.compared))
        against = "the simulator's truth" if name.endswith("truth") else "Ho-Kalman's algorithm"
        texts.append(
            f"From {report.compared.bottom_hz:.3g} to {report.compared.top_hz:.3g} Hz, on the "
            f"diagonal of P, the fitted model and {against} differ by at most {error}."
        )
    return tuple(Text(text) for text in texts)


def grey_box_answer(report: GreyBoxReport, beside: BesideBlackBox | None = None) -> str:
    """Return the answer: whether to use the fitted model, parameters at a bound, and its modes.

    beside: the comparison with the black-box model of the same records; None without one.
    """
    name = report.grey.declared.name
    middle = len(report.modes) // 2
    modes = report.modes[middle]
    at = f" at {report.places[middle].label}" if len(report.places) > 1 else ""
    values = ", ".join(f"{f:#.3g}" for f in modes.frequency_hz)
    natural = (
        f" The model's natural frequencies{at} are {values} Hz." if len(modes.frequency_hz) else ""
    )
    worst = report.worst
    error = "" if worst is None else f" ({worst.over_noise:.2f} times the noise)"
    bounds = "".join(f" {text}" for text in at_bound_sentences(report.grey))
    if report.grey.loop is not None and not report.grey.explains_nothing:
        answer = loop_answer(report.grey.loop, name, report.rigid_hz, NOISE_MOST)
        return f"{answer}{bounds}{natural}"
    if report.grey.doubts:
        return f"Do not use a model of these records: {'; '.join(report.grey.doubts)}."
    if report.explains:
        found = (
            f"Use the fitted model '{name}': it explains these records down to the noise{error}."
        )
    elif beside is not None and beside.as_good and not _excluded(report.grey):
        found = (
            f"Use the fitted model '{name}': on held-out rows it explains as much as the black-box "
            f"model{_errors_beside(report, beside)}. It does not explain them down to the "
            f"noise{error}, so the plant has an effect that both models lack."
        )
    elif report.grey.explains_nothing and not report.grey.columns:
        found = (
            f"The fitted model '{name}' explains nothing of these records: its error on held-out "
            "rows is as large as the outputs, up to chance, or they determine none of its "
            "parameters. Check the order, signs and units of the columns, the model file, and "
            "the excitation."
        )
    elif report.grey.columns:
        found = (
            f"The fitted model '{name}' does not explain these records{error}. It looks as if "
            f"{report.grey.columns}: then it explains nearly all of the force. {COMPARE_COLUMNS}."
        )
    else:
        found = (
            f"The fitted model '{name}' does not explain these records{error}: the plant has an "
            "effect that the model lacks."
        )
    return f"{found}{bounds}{natural}"


def _excluded(grey: GreyBox) -> bool:
    return bool(grey.columns) or grey.explains_nothing


def at_bound_sentences(grey: GreyBox) -> tuple[str, ...]:
    """Return a sentence for each parameter that ended at a bound of the model file."""
    return tuple(
        f"{name} ended at its bound of {grey.fit.values[name]:.4g} "
        f"{grey.declared.parameters[name].unit}: the data do not determine it, or the model is "
        "wrong; its value and interval are not reliable."
        for name in grey.fit.at_bound
    )


def _errors_beside(report: GreyBoxReport, beside: BesideBlackBox) -> str:
    output = report.signals.output_symbols[beside.output]
    kind = "simulation" if beside.simulated else "prediction one step ahead"
    text = (
        f" (error of the {kind}, over {output}: {beside.fitted_percent:.3g} %, and "
        f"{beside.black_box_percent:.3g} %)"
    )
    return text if beside.stable else f", which is unstable and cannot simulate{text}"


def grey_box_numbers(report: GreyBoxReport) -> tuple[Number, ...]:
    """Return the numbers of the summary."""
    fit = report.grey.fit
    free, held = len(fit.free), len(fit.unidentifiable)
    numbers = [
        Number(
            f"{free} of {free + held}",
            f"parameters of '{report.grey.declared.name}' determined by the records",
            "bad" if fit.at_bound else "none" if held else "good",
        )
    ]
    fits = [cell.fit_percent for cell in report.fits()]
    if fits:
        numbers.append(
            Number(f"{min(fits):.2f} %", "lowest fit of a simulation to rows kept aside")
        )
    if report.worst is not None:
        times = report.worst.over_noise
        numbers.append(
            Number(
                f"{times:.2f}",
                "times the noise: largest simulation error; a perfect model has up to "
                f"{1.0 + SURE_95 * report.worst.spread:.2f}",
                _good(times <= NOISE_MOST),
            )
        )
    least, tests = least_chance(report)
    if report.grey.loop is not None:
        numbers += loop_numbers(report.grey.loop, NOISE_MOST)
    elif tests:
        white = not least * tests < NOT_WHITE
        numbers.append(
            Number(
                "random" if white else "not random",
                f"errors one step ahead (white noise: lowest p {chance(least)} of {tests} tests)",
                _good(white),
            )
        )
    for name in report.ratios:
        decibel, degree = largest(report.ratios[name], report.compared)
        bounds = report.bounds(name)
        against = "the truth" if name.endswith("truth") else HO_KALMAN
        numbers.append(
            Number(
                error_text((decibel, degree), ", "),
                f"fitted model against {against} at worst, up to {report.compared.top_hz:.3g} Hz",
                _good(decibel <= bounds.decibel and degree <= bounds.degree),
            )
        )
    return tuple(numbers)


def least_chance(report: GreyBoxReport) -> tuple[float, int]:
    """Return the smallest p-value of all whiteness tests, and their number."""
    p = np.array([x for v in report.grey.validations for x in v.whiteness.p_value])
    p = p[np.isfinite(p)]
    return (float(p.min()), len(p)) if len(p) else (float("nan"), 0)


def _identifiability_words(report: GreyBoxReport) -> str:
    held = report.grey.fit.unidentifiable
    if not held:
        return "These records determine all of them."
    words = " ".join(f"{u}." for u in held)
    if report.grey.loop is None:
        return words
    return f"{words} The intervals of the others count it as known to a fifth of its value."


def _explained(report: GreyBoxReport) -> str:
    fits, worst = report.fits(), report.worst
    texts = []
    if fits:
        least = min(fits, key=lambda cell: cell.fit_percent)
        texts.append(
            "Held-out rows, simulated from excitation and schedule alone: every output well above "
            f"the noise fits by {least.fit_percent:.2f} % or more (lowest: {least.output} of "
            f"{least.validation.record})."
        )
    if worst is not None:
        texts.append(
            f"The largest simulation error is {worst.over_noise:.2f} times the error that noise "
            f"alone would leave ({worst.output} of {worst.validation.record})."
        )
    return " ".join(texts)


def _whiteness(report: GreyBoxReport) -> str:
    if report.grey.loop is not None:
        return whiteness_words(report.grey.loop)
    least, tests = least_chance(report)
    if not tests:
        return ""
    if least * tests >= NOT_WHITE:
        return "One-step-ahead errors are white noise."
    names = report.signals.output_symbols
    failed = [
        f"{names[i]} of {v.record}"
        for v in report.grey.validations
        for i, p in enumerate(v.whiteness.p_value)
        if p * tests < NOT_WHITE
    ]
    shown = ", ".join(failed[:4]) + (f" and {len(failed) - 4} more" if len(failed) > 4 else "")
    return (
        f"One-step-ahead errors are not white ({shown}): the model lacks something, and the "
        "standard errors are too small."
    )


def _ratios(estimates: Sequence[Curve], references: Sequence[Curve]) -> tuple[Curve, ...]:
    return tuple(
        Curve(e.label, e.line, e.freq_hz, ratio(e, r))
        for e, r in zip(estimates, references, strict=True)
    )


def _good(yes: bool) -> Verdict:
    return "good" if yes else "bad"


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")


def _were(number: int) -> str:
    return "was" if number == 1 else "were"
