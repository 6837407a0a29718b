"""Summarise an open-loop identification, such as that of imported data."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...identification.results import OpenLoopPoint
from ...identification.subspace.held_out_simulation import HoldOut
from ..figures.bode import bode_magnitude, bode_phase
from ..figures.held_out_outputs import HeldOut, held_out_outputs
from ..figures.order_validation import OrderErrors, validation_errors
from ..figures.singular_values import SingularValues, Spectrum, singular_values
from ..plotting.figure_to_svg import Picture, to_svg
from ..plotting.html_page import Number, Part, Section, Table, Text
from ..plotting.labelled_frequency_responses import Curve, Range, SignalLabels
from ..plotting.style import TRUTH, line_of
from .closed_loop import ESTIMATOR, Truth

_MOST_SHOWN = 6
"""Largest number of records with sentence, numbers and figure; those with the worst fits."""


def open_loop_words(point: OpenLoopPoint, signals: SignalLabels) -> tuple[Text, ...]:
    """Return the sentences of the summary."""
    m, p = signals.shape
    texts = [
        Text(
            f"The plant with {p} input{'s' * (p != 1)} and {m} output{'s' * (m != 1)} was "
            f"identified from input to output{_loop_words(point)}. "
            + (
                f"The simulation model has {point.order} states, the one-step-ahead predictor "
                f"{point.predictor_order}."
                if point.stable
                else f"The model has {point.order} states and is unstable: it can predict one step "
                "ahead, but not simulate."
            ),
        ),
        *(Text(f"Do not use the model: {doubt}.") for doubt in point.doubts),
    ]
    for held in _worst_first(point.holdout)[:_MOST_SHOWN]:
        texts.append(
            Text(
                f"Held-out rows, {len(held.time_s)} of record {held.record}{_from(held)}: "
                f"{_fit_words(held, signals)}."
            )
        )
    if len(point.holdout) > _MOST_SHOWN:
        left = len(point.holdout) - _MOST_SHOWN
        texts.append(Text(f"The other {left} records fit better; the table below lists all."))
    return tuple(texts)


def _loop_words(point: OpenLoopPoint) -> str:
    if point.feedback:
        return " in the declared control loop, by predictions one step ahead"
    return ", assuming that the outputs do not drive the inputs: no control loop is declared"


def open_loop_answer(point: OpenLoopPoint, signals: SignalLabels) -> str:
    """Return the answer: what the model explains, or why to use no model of these records."""
    if not point.trusted:
        return f"Do not use a black-box model of these records: {'; '.join(point.doubts)}."
    return " ".join(text.text for text in open_loop_words(point, signals)[:2])


def open_loop_numbers(point: OpenLoopPoint) -> tuple[Number, ...]:
    """Return the numbers of the summary."""
    numbers = [Number(str(point.order), "states of the model")]
    least = ", lowest of all records" if len(point.holdout) > _MOST_SHOWN else ""
    for held in _worst_first(point.holdout)[: 1 if least else None]:
        if point.stable:
            fits = " / ".join(map(_percent, held.simulated_fit_percent))
            numbers.append(Number(fits, f"fit of the simulation, held-out rows{least}"))
        if held.predicted_fit_percent is not None:
            fits = " / ".join(map(_percent, held.predicted_fit_percent))
            numbers.append(Number(fits, f"fit one step ahead, held-out rows{least}"))
    return tuple(numbers)


def _worst_first(holdout: Sequence[HoldOut]) -> list[HoldOut]:
    """Return up to _MOST_SHOWN records with the worst fits, in the records' order."""
    if len(holdout) <= _MOST_SHOWN:
        return list(holdout)

    def least(held: HoldOut) -> float:
        fits = held.simulated_fit_percent
        return float(np.min(fits[np.isfinite(fits)], initial=np.inf))

    return sorted(holdout, key=least)


def _percent(fit: float) -> str:
    return f"{fit:.1f} %" if np.isfinite(fit) else "—"


def open_loop_sections(
    point: OpenLoopPoint, signals: SignalLabels, truth: Truth | None = None, number: int = 1
) -> tuple[Section, ...]:
    """Return the sections on held-out outputs, frequency response and order.

    `number` distinguishes the operating points of a page.
    """
    of = f" {number}" if number > 1 else ""
    return (
        Section(f"Held-out data{of}", _held_out_parts(point, signals, f"point-{number}")),
        Section(
            f"Frequency response{of}", _response_parts(point, signals, truth, f"point-{number}")
        ),
        Section(f"Order of the model{of}", _order_parts(point, f"point-{number}")),
    )


def _held_out_parts(point: OpenLoopPoint, signals: SignalLabels, name: str) -> tuple[Part, ...]:
    pictures: list[Part] = []
    for number, held in enumerate(_worst_first(point.holdout)[:_MOST_SHOWN]):
        tail = HeldOut(
            signals.output_names,
            signals.output_units,
            held.time_s,
            held.measured,
            held.simulated,
            held.simulated_fit_percent,
            held.predicted,
            held.predicted_fit_percent,
        )
        pictures.append(
            Picture(
                f"{name}-outputs-{number + 1}",
                to_svg(held_out_outputs(tail)),
                f"Measured, predicted and simulated outputs in held-out rows of {held.record}.",
                f"Held-out rows: {len(held.time_s)} of record {held.record}{_from(held)}. "
                "Simulated: from the input alone. One step ahead: from input and output up to the "
                "previous row. A fit of 100 % is perfect; 0 % is no better than the mean.",
            )
        )
    if len(point.holdout) > _MOST_SHOWN:
        pictures.append(_fits_table(point.holdout, signals))
    return tuple(pictures)


def _from(held: HoldOut) -> str:
    return f" from {held.time_s[0]:.4g} s on" if len(held.time_s) else ""


def _fits_table(holdout: Sequence[HoldOut], signals: SignalLabels) -> Table:
    rows = []
    for held in holdout:
        by_kind = {"simulated": held.simulated_fit_percent}
        if held.predicted_fit_percent is not None:
            by_kind["one step ahead"] = held.predicted_fit_percent
        rows += [(held.record, kind, *map(_percent, fits)) for kind, fits in by_kind.items()]
    head = ("record", "model", *signals.output_names)
    return Table("Fit on held-out rows", head, tuple(rows), labels=2)


def _response_parts(
    point: OpenLoopPoint, signals: SignalLabels, truth: Truth | None, name: str
) -> tuple[Part, ...]:
    spectra, response = point.from_spectra, point.response
    shown = Range(float(spectra.freq_hz[0]), float(spectra.freq_hz[-1]))
    curves = [
        Curve("spectra", line_of(1), spectra.freq_hz, spectra.H, spectra.standard_deviation),
        Curve("model", line_of(0), response.freq_hz, response.H, response.standard_deviation),
    ]
    true = []
    if truth is not None:
        f = np.geomspace(shown.low_hz, shown.high_hz, 240)
        true = [Curve("truth of the simulator", TRUTH, f, truth(point.beam_m, f))]
    return (
        Picture(
            f"{name}-magnitude",
            to_svg(bode_magnitude(curves, signals, truth=true, shown=shown)),
            "Bode magnitude of every input to every output, by the model and from spectra.",
            f"Magnitude of the model of {point.order} states, and of the ratio of cross spectra "
            "with its 95 % interval, which needs no model.",
        ),
        Picture(
            f"{name}-phase",
            to_svg(bode_phase(curves, signals, truth=true, shown=shown)),
            "Phase of every input to every output, by the model and from spectra.",
            "Phase of the model and of the spectra, these where the uncertainty is below 60°.",
        ),
    )


def _order_parts(point: OpenLoopPoint, name: str) -> tuple[Part, ...]:
    spectra = [
        Spectrum(
            ESTIMATOR.get(method, method),
            (SingularValues("singular values", line_of(0), values),),
            None,
        )
        for method, values in point.singular_values.items()
    ]
    kinds = (
        OrderErrors("simulation", line_of(1), point.validation_error, point.order),
        OrderErrors(
            "one step ahead", line_of(0), point.predictor_validation_error, point.predictor_order
        ),
    )
    return (
        Picture(
            f"{name}-validation",
            to_svg(validation_errors(kinds)),
            "Validation error over the model's order, for simulation and for prediction.",
            "Error on the last quarter of the training rows, of models fitted to the rest. The "
            "smallest order within one standard error of the best is chosen. Orders without a "
            "stable model have no point.",
        ),
        Picture(
            f"{name}-singular-values",
            to_svg(singular_values(spectra)),
            "Singular values of the Hankel matrix on a logarithmic scale.",
            "Singular values of the Hankel matrix of the Markov parameters. "
            f"{_length_words(point)}",
        ),
    )


def _fit_words(held: HoldOut, signals: SignalLabels) -> str:
    words = []
    for i, name in enumerate(signals.output_symbols):
        kinds = {"simulated": held.simulated_fit_percent[i]}
        if held.predicted_fit_percent is not None:
            kinds["predicted one step ahead"] = held.predicted_fit_percent[i]
        fits = [f"{kind} with a fit of {x:.1f} %" for kind, x in kinds.items() if np.isfinite(x)]
        words.append(f"{name} {', '.join(fits) or 'rests there, which tests no model'}")
    return "; ".join(words)


def _length_words(point: OpenLoopPoint) -> str:
    impulse = point.impulse
    length = f"The impulse response has {impulse.length_s:.3g} s ({impulse.taps} rows)"
    if impulse.chosen_by == "given":
        return f"{length}, as given."
    if impulse.chosen_by == "rule" or not point.markov:
        return f"{length}, the longest that the rows allow."
    errors = ", ".join(
        f"{taps} rows {100 * error:.3g} %"
        for taps, error in sorted(impulse.validation_error.items())
    )
    return (
        f"{length}, the shortest one whose error on the last quarter of the training rows is "
        f"within one standard error of the best. Errors over the output: {errors}."
    )
