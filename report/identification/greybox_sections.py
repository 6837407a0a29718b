"""Build the sections on a fitted model: parameters, response, simulation, residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ...config.model import ModelConfig, ModelParameter
from ...identification.greybox.fit import Fit
from ...identification.greybox.identifiability import Unidentifiable
from ...identification.greybox.validation import Validation
from ...identification.subspace.response_uncertainty import SURE_95
from ..figures.bode import bode_magnitude, bode_phase
from ..figures.residuals import Residuals, residual_correlation, residual_spectra
from ..figures.response_deviation import bounds_text, deviation, error_text, largest
from ..figures.simulated_outputs import (
    Simulated,
    SimulatedOutput,
    simulated_outputs,
    simulated_side_by_side,
)
from ..plotting.figure_to_svg import Picture, to_svg
from ..plotting.html_page import Part, Section, Table, Text
from ..plotting.labelled_frequency_responses import Curve
from ..plotting.number_format import chance, interval, plain, to_interval
from ..plotting.style import signed
from ..session.session_page import listed
from .greybox import GreyBoxReport
from .loop_words import modes_table, shape_parts

Array = NDArray[np.float64]

_MOST_PICTURED = 3
_FEED_FORWARD = {True: "with feed-forward", False: "without feed-forward"}


def grey_box_sections(report: GreyBoxReport) -> tuple[Section, ...]:
    """Return the sections on parameters and modes, response, simulation and residuals."""
    sections = [
        Section("Parameters and modes", _parameter_parts(report)),
        Section("Response of the fitted model", _response_parts(report)),
    ]
    if report.grey.validations:
        sections += [
            Section("Simulated against measured", _simulated_parts(report)),
            Section("Remaining error", _residual_parts(report)),
        ]
    return tuple(sections)


def _parameter_parts(report: GreyBoxReport) -> tuple[Part, ...]:
    fit, declared = report.grey.fit, report.grey.declared
    held = {u.name: u for u in fit.unidentifiable}
    rows = tuple(
        (
            name,
            parameter.about or "—",
            parameter.unit,
            *_values(name, parameter, fit),
        )
        for name, parameter in declared.parameters.items()
    )
    head = ("parameter", "meaning", "unit", "declared", "fitted", "± 95 %")
    parts: list[Part] = [
        Table(
            "Parameters in SI units, declared and fitted, with the change in percent and in "
            "standard errors",
            (*head, "change %", "in s.e."),
            rows,
            labels=3,
        ),
        _modes_table(report),
    ]
    loop = report.grey.loop
    if loop is not None and loop.fit.modes:
        parts.append(modes_table(loop, report.signals.output_symbols))
        parts += shape_parts(loop)
    parts += [Text(f"{u}; {_if_fitted(u, declared)}.") for u in held.values()]
    return tuple(parts)


def _values(name: str, parameter: ModelParameter, fit: Fit) -> tuple[str, ...]:
    """Return declared value, fitted value, half its interval, change in percent and in errors."""
    before = plain(parameter.value)
    error = fit.standard_errors.get(name)
    if error is None:
        return before, "fixed" if parameter.is_fixed else "held", "—", "—", "—"
    after, half = fit.values[name], SURE_95 * error
    change = after - parameter.value
    return (
        before,
        to_interval(after, half) + (" (at bound)" if name in fit.at_bound else ""),
        to_interval(half, half),
        _percent(change, half, parameter.value),
        signed(change / error, 1) if error > 0 else "—",
    )


def _percent(change: float, half: float, of: float) -> str:
    """Return a change in percent of a value, to the first digit of half its interval."""
    if not of:
        return "—"
    share = 100.0 / abs(of)
    return ("+" if change > 0 else "") + to_interval(share * change, share * half, 1)


def _if_fitted(held: Unidentifiable, declared: ModelConfig) -> str:
    if np.isfinite(held.standard_error):
        unit = declared.parameters[held.name].unit
        return f"fitted, its standard error would be {plain(held.standard_error, 2)} {unit}"
    if held.together_with:
        return "these have the same effect"
    return "these records do not depend on it"


def _modes_table(report: GreyBoxReport) -> Table:
    rows = tuple(
        (
            place.label,
            interval(m.frequency_hz[k], m.frequency_se_hz[k]),
            interval(m.damping[k], m.damping_se[k]),
        )
        for place, m in zip(report.places, report.modes, strict=True)
        for k in range(len(m.frequency_hz))
    )
    head = ("at", "natural frequency in Hz", "damping ratio ζ")
    return Table("Modes of the fitted model, with 95 % intervals", head, rows)


def _response_parts(report: GreyBoxReport) -> tuple[Part, ...]:
    pale = list(report.measured)
    if pale:
        pale[0] = replace(pale[0], label="measured, beneath")
    beneath = " over the measured response by (15), wide and pale, above its noise" if pale else ""
    if report.truth:
        beneath += f"{', and' if beneath else ' over'} the simulator's truth, wide and grey"
    if report.whole:
        beneath += f"{', and' if beneath else ', '} dotted: with the modes that it lacks"
    parts: list[Part] = [
        Picture(
            "fitted-response",
            to_svg(_bode(report, [*report.fitted, *report.whole, *pale])),
            "Bode magnitude of the fitted model, every input to every output.",
            f"Magnitude of P of the fitted model{beneath}. {_of_schedule(report)}{_bands(report)}",
            "Fig. 13",
        ),
        Picture(
            "fitted-phase",
            to_svg(
                bode_phase(report.fitted, report.signals, truth=report.truth, shown=report.shown)
            ),
            "Phase of the fitted model, every input to every output.",
            "Phase of P of the fitted model, with the delay, the hold and the actuators' lag.",
        ),
    ]
    for number, (name, curves) in enumerate(report.ratios.items(), start=1):
        bounds = report.bounds(name)
        against = "the simulator's truth" if name.endswith("truth") else "Ho-Kalman's estimate"
        error = error_text(largest(curves, report.compared))
        parts.append(
            Picture(
                f"fitted-agreement-{number}",
                to_svg(deviation(curves, report.signals, bounds=bounds, shown=report.compared)),
                f"Difference of the fitted model from {against} in dB and degrees.",
                f"The fitted model against {against}: up to {report.compared.top_hz:.3g} Hz "
                f"{error} at most; {bounds_text(curves, bounds, report.compared)}.",
            )
        )
    return tuple(parts)


def _of_schedule(report: GreyBoxReport) -> str:
    return "One set of parameters is valid at all positions. " if len(report.places) > 1 else ""


def _bands(report: GreyBoxReport) -> str:
    if any(c.deviation is not None for c in report.fitted):
        return "Bands: 95 % intervals from the parameters' errors."
    return "The 95 % intervals from the parameters' errors are narrower than the lines."


def _bode(report: GreyBoxReport, curves: Sequence[Curve]) -> Figure:
    return bode_magnitude(curves, report.signals, truth=report.truth, shown=report.shown)


def _simulated_parts(report: GreyBoxReport) -> tuple[Part, ...]:
    parts: list[Part] = []
    pictured = report.moving[:_MOST_PICTURED]
    runs = [_simulated(report, v) for v in pictured]
    if len(runs) > 1 and all(run.schedule for run in runs):
        titles = [v.record for v in pictured]
        columns = listed(titles)
        carries = [report.carries_beam(v) for v in pictured]
        if None not in carries:
            named = [f"{r}, {_FEED_FORWARD[bool(c)]}" for r, c in zip(titles, carries, strict=True)]
            columns = "; ".join(named)
            if len(set(carries)) == len(carries):
                titles = [_FEED_FORWARD[bool(c)] for c in carries]
        parts.append(
            Picture(
                "simulated-side-by-side",
                to_svg(simulated_side_by_side(runs, titles)),
                "Measured and simulated outputs of the records with a moving beam, side by side.",
                f"The end of the records in which {runs[0].schedule[0].name} moves, measured and "
                f"simulated, on the same axes: {columns}. The figures below show each record on "
                "its own axes, with its error.",
                "Fig. 14",
            )
        )
    for number, (v, run) in enumerate(zip(pictured, runs, strict=True), start=1):
        names = ", ".join(trace.name for trace in _traces(report, v))
        parts.append(
            Picture(
                f"simulated-{number}",
                to_svg(simulated_outputs(run)),
                f"Measured and simulated outputs of record {v.record}, with the differences.",
                f"The end of record {v.record}, simulated from {names or 'its schedule'} and the "
                f"excitation. {_feed_forward_sentence(report, v)}The seconds before it give the "
                "initial state and the constant force; no later output is used. Below each output: "
                "the error on its own scale, with the noise as a band.",
                "Fig. 14",
            )
        )
    if len(report.moving) > _MOST_PICTURED:
        parts.append(Text("The other records with a moving schedule are in the table.", "note"))
    if not report.moving:
        parts.append(Text("No record has a moving schedule; all are in the table.", "note"))
    parts.append(_fits_table(report))
    return tuple(parts)


def _simulated(report: GreyBoxReport, v: Validation) -> Simulated:
    s = report.signals
    return Simulated(
        s.output_names,
        s.output_units,
        v.time_s,
        v.measured,
        v.simulated,
        v.fit_percent,
        v.floor_rms,
        _traces(report, v),
    )


def _feed_forward_sentence(report: GreyBoxReport, v: Validation) -> str:
    carries = report.carries_beam(v)
    if carries is None:
        return ""
    if carries:
        return "The feed-forward carried the beam, as far as its model is right. "
    return "The feed-forward did not carry the beam: its weight and reaction disturbed. "


def _traces(report: GreyBoxReport, v: Validation) -> tuple[SimulatedOutput, ...]:
    """Return the scheduling variables that are log fields, without derivatives."""
    return tuple(
        SimulatedOutput(name, variable.unit, v.schedule[name])
        for name, variable in report.grey.declared.scheduling.items()
        if not variable.derivative and name in v.schedule
    )


def _fits_table(report: GreyBoxReport) -> Table:
    names = report.signals.output_symbols
    rows = tuple(
        (
            v.record,
            *(
                cell
                for i in range(len(names))
                for cell in (_digits(v.fit_percent[i]), _over(v.error_rms[i], v.floor_rms[i]))
            ),
        )
        for v in report.grey.validations
    )
    head = ("record", *(h for name in names for h in (f"{name} fit %", "error / noise")))
    spreads = np.concatenate([v.floor_spread for v in report.grey.validations])
    caption = (
        "Fit of the simulation, and its error over the error that noise alone would leave (of a "
        f"perfect model 1, with a standard deviation of {_between(spreads)}). An output that "
        "hardly moves has a low fit"
    )
    return Table(caption, head, rows)


def _residual_parts(report: GreyBoxReport) -> tuple[Part, ...]:
    drawn = _drawn(report)
    residuals = [
        Residuals(
            v.record,
            v.freq_hz,
            v.error_psd,
            v.floor_psd,
            v.whiteness.correlation,
            v.whiteness.bound,
            v.whiteness.p_value,
        )
        for v in drawn
    ]
    s = report.signals
    which = "the record with the largest error over noise"
    if report.moving:
        which += (
            " and " + ("the record" if len(drawn) <= 2 else "records") + " with a moving schedule"
        )
    rows = tuple(
        (v.record, *(chance(p) for p in v.whiteness.p_value)) for v in report.grey.validations
    )
    return (
        Picture(
            "residual-spectrum",
            to_svg(residual_spectra(residuals, s.output_names, s.output_units)),
            "Spectra of the simulation's error and of the noise, every output.",
            f"Error of the simulation and error that noise alone would leave, of {which}. The "
            "model lacks something at frequencies where the error exceeds the noise.",
        ),
        Picture(
            "residual-correlation",
            to_svg(residual_correlation(residuals, s.output_names)),
            "Autocorrelation of one-step-ahead errors with the bound of white noise.",
            "One-step-ahead errors of the same records. They are white if the model and its noise "
            "explain the record. p: probability of a larger correlation by chance (Ljung-Box "
            "test).",
        ),
        Table("Whiteness of one-step-ahead errors, p", ("record", *s.output_symbols), rows),
    )


def _drawn(report: GreyBoxReport) -> list[Validation]:
    """Return the record with the largest error, then those with moving scheduling variables."""
    worst = report.worst
    first = report.grey.validations[0] if worst is None else worst.validation
    others = [v for v in report.moving if v is not first]
    return [first, *others][:_MOST_PICTURED]


def _between(values: Array) -> str:
    known = values[np.isfinite(values)]
    if not known.size:
        return "—"
    low, high = f"{known.min():.2f}", f"{known.max():.2f}"
    return low if low == high else f"{low} to {high}"


def _digits(value: float) -> str:
    return signed(value, 2).removeprefix("+") if np.isfinite(value) else "—"


def _over(error: float, floor: float) -> str:
    return f"{error / floor:.2f}" if floor > 0 and np.isfinite(error) else "—"
