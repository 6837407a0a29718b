"""Build the general sections of a trace report: errors, search, model, records."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ...config.model import ModelParameter
from ...config.version import __version__
from ...identification.records.record import OTHER_STEP
from ...identification.subspace.response_uncertainty import SURE_95
from ...identification.trace.figure_data import Views
from ...identification.trace.run_trace import Trace
from ...identification.trace.search.predictive_criterion import certainty
from ...identification.trace.search.tested_candidate import Round
from ...identification.trace.trace_outcome import Outcome
from ...identification.trace.traced_model import model_after
from ..plotting.figure_to_svg import Picture, to_svg
from ..plotting.html_page import Part, Section, Steps, Table, Text
from ..plotting.labelled_frequency_responses import symbol
from ..plotting.number_format import (
    amount,
    change_text,
    plain,
    times_text,
    to_interval,
    unit_text,
)
from ..plotting.style import engineering
from ..session.session_page import listed
from .trace_figures import Bar, candidates, error_spectra, errors_by_record

Array = NDArray[np.float64]

_OF_EXCESS = "explained, % of what noise does not explain"
_OF_NOISE = "explained, squared errors in variances of the noise"
_MOST_BARS = 8
_NOISE = 0.01


def error_parts(found: Trace, result: Outcome, views: Views) -> list[Part]:
    """Return the error over frequency, then errors by DOF and record."""
    names = [symbol(d.name) for d in result.dof]
    floor = np.array([e.pose_floor for e in found.after])
    over_before, over_after = (
        np.sqrt(np.array([e.pose_squares for e in errors]) / floor)
        for errors in (found.before, found.after)
    )
    labels = [e.name for e in found.after]
    dof = [d.name for d in result.dof]
    freq_hz, densities, short = _pooled_spectra(found, views)
    but = f", without {listed(short)} (too short, or another rate)"
    parts: list[Part] = [
        Picture(
            "trace-spectrum",
            to_svg(
                error_spectra(
                    freq_hz,
                    densities if result.effects else (None, *densities[1:]),
                    dof,
                    [d.unit for d in result.dof],
                )
            ),
            "Spectra of the simulation error without and with effects, and of the noise.",
            "Simulation error over frequency, before and after, beside the noise; all held-out "
            f"records{but if short else ''}.",
        ),
        Text(
            "Held-out records, simulated from the excitation and the beam's motion alone. Their "
            "first 5 s, or a third, give the initial state and do not count. The declared model "
            "was fitted to the other records before, so the effects alone reduce the error."
        ),
        _dof_table(result),
        Picture(
            "trace-records",
            to_svg(
                errors_by_record(labels, dof, over_before if result.effects else None, over_after)
            ),
            "Error over noise of every held-out record and DOF, without and with effects.",
            "Error of every held-out record, over the error that noise alone would leave.",
        ),
        _record_table(found, result, names),
    ]
    if result.unsettled:
        parts.append(
            Text(
                f"The simulation with effects did not converge in {', '.join(result.unsettled)}: "
                "the error there is not reliable."
            )
        )
    return parts


def _dof_table(result: Outcome) -> Table:
    caption = "RMS error of each DOF over all held-out records"
    if not result.effects:
        alone = tuple(
            (
                symbol(d.name),
                amount(d.after, d.unit),
                amount(d.floor, d.unit),
                times_text(d.after / d.floor),
            )
            for d in result.dof
        )
        return Table(caption, ("", "error", "noise alone", "error / noise"), alone)
    rows = tuple(
        (
            symbol(d.name),
            amount(d.before, d.unit),
            amount(d.after, d.unit),
            amount(d.floor, d.unit),
            change_text(d.before, d.after),
            times_text(d.before / d.floor),
            times_text(d.after / d.floor),
        )
        for d in result.dof
    )
    head = ("without effects", "with effects", "noise alone", "change")
    return Table(caption, ("", *head, "without / noise", "with / noise"), rows)


def _record_table(found: Trace, result: Outcome, names: Sequence[str]) -> Table:
    rows = []
    for b, a in zip(found.before, found.after, strict=True):
        cells = [b.name]
        for i, unit in enumerate(found.places.dof_units):
            before, after = (amount(float(np.sqrt(e.pose_squares[i])), unit) for e in (b, a))
            sizes = [float(np.sqrt(e.pose_squares[i])) for e in (b, a)]
            times = [times_text(size / float(np.sqrt(a.pose_floor[i]))) for size in sizes]
            cells += (
                [f"{before} → {after}", change_text(*sizes), " → ".join(times)]
                if result.effects
                else [after, times[1]]
            )
        rows.append(tuple(cells))
    each = ("change", "/ noise") if result.effects else ("/ noise",)
    head = ("record", *(h for n in names for h in (n, *each)))
    what = ", without → with effects" if result.effects else ""
    return Table(f"RMS error of each held-out record{what}", head, tuple(rows))


def _pooled_spectra(
    found: Trace, views: Views
) -> tuple[Array, tuple[Array, Array, Array], list[str]]:
    """Return frequencies (F,), densities (F, n) before, after, of noise, and omitted records."""
    floors = {v.name: v.floor for v in views.records}
    freq_hz = max((e.freq_hz for e in found.after), key=len)
    n = found.after[0].psd.shape[1]
    sums = [np.zeros((len(freq_hz), n)) for _ in range(3)]
    weight, short = 0.0, []
    for b, a in zip(found.before, found.after, strict=True):
        floor = floors.get(a.name)
        if floor is None or not np.array_equal(a.freq_hz, freq_hz):
            short.append(a.name)
            continue
        for number, psd in enumerate((b.psd, a.psd, floor)):
            sums[number] += a.seconds * psd
        weight += a.seconds
    before, after, floor = (total / max(weight, 1e-300) for total in sums)
    return freq_hz, (before, after, floor), short


def search_section(found: Trace) -> Section:
    """Return the section on the candidates of every round."""
    parts: list[Part] = [
        Text(
            "Each round tries all effects of the table, one at a time, beside the model and the "
            "effects found so far. Cross-validation over blocks of time rates them. The best are "
            "fitted; one passes if it explains a tenth of the error, and data that did not fit it "
            "agree with it beyond chance. The best one that passes is fitted with the whole model, "
            "tested again and added. The search ends when no effect passes."
        )
    ]
    for number, r in enumerate(found.found.rounds, start=1):
        bars = _bars(r)
        if not bars:
            continue
        parts.append(
            Picture(
                f"trace-round-{number}",
                to_svg(_candidates(r, bars)),
                f"What the best candidates of round {number} explain of what was left.",
                f"Round {number}: {_result(r)} Beside each bar: agreement with data that did not "
                "fit it, in standard deviations of chance.",
            )
        )
    return Section(
        "Search",
        tuple(parts),
        folded=True,
    )


def _bars(r: Round) -> list[Bar]:
    passed = {t.effect.identity for t in r.survivors}
    accepted = None if r.taken is None else r.taken.effect.identity
    # The error above the noise has an uncertainty too, so a share can exceed 1.
    whole, most = (1.0, math.inf) if _is_noise(r) else (0.01 * r.excess, 100.0)
    shown = [t for t in r.ranking if t.gain > 0][:_MOST_BARS]
    bars = []
    for tried in shown:
        is_accepted = tried.effect.identity == accepted
        t = r.taken if is_accepted and r.taken is not None else tried
        agrees = f"{certainty(t.agreement):.1f} σ".replace("-", "−")
        share = min(t.gain / whole, most)
        bars.append(Bar(t.effect.name, share, agrees, t.effect.identity in passed, is_accepted))
    return bars


def _candidates(r: Round, bars: list[Bar]) -> Figure:
    if _is_noise(r):
        return candidates(bars, _OF_NOISE)
    return candidates(bars, _OF_EXCESS, last_tick=100.0)


def _is_noise(r: Round) -> bool:
    """Return whether the remaining error is too small for shares of it."""
    return r.excess <= _NOISE * r.count


def _result(r: Round) -> str:
    left = r.excess / r.count
    text = f"the mean square of the errors is {1 + left:.3f}, 1 being noise."
    if r.taken is not None:
        text += f" {r.taken.effect.name} was added"
        if r.instead_of is not None:
            text += f" in place of {r.instead_of.name}, which explains less"
        if r.alternatives:
            text += (
                ", although "
                + ", ".join(t.effect.name for t in r.alternatives)
                + " fit equally well"
            )
        return text + "."
    return text + " No effect was added: none explains enough, beyond chance."


def model_section(found: Trace) -> Section:
    """Return the section on parameters: declared, fitted without and with effects."""
    after = model_after(found)
    without = dict(zip(found.declared.parameters.names, found.declared.values, strict=True))
    rows = tuple(
        (
            name,
            unit_text(declared.unit),
            plain(declared.value),
            plain(float(without[name])),
            *_with_error(after.parameters[name]),
        )
        for name, declared in found.config.parameters.items()
        if not declared.is_fixed
    )
    head = ("parameter", "unit", "declared", "fitted without effects", "with effects", "± 95 %")
    return Section(
        "Model parameters",
        (
            Text("The model's parameters were fitted together with the effects."),
            Table("Free parameters of the declared model, SI units", head, rows, labels=2),
        ),
    )


def _with_error(parameter: ModelParameter) -> tuple[str, str]:
    if parameter.se is None:
        return plain(parameter.value), "unknown"
    half = SURE_95 * parameter.se
    return to_interval(parameter.value, half), to_interval(half, half)


def records_section(found: Trace, command: str = "") -> Section:
    """Return the section on fitted, held-out and omitted records, and the command."""
    noise = found.found.point.disturbance
    unit = found.places.sensor_unit
    factor, prefix = engineering(noise.sensor_sd, unit)
    rows = [(name, "fitted") for name in found.fitted]
    rows += [(name, "held out") for name in found.held]
    parts: list[Part] = [
        Text(
            f"Noise of a sensor: {factor * noise.sensor_sd:.3g} {prefix}{unit} RMS, "
            + (
                "and of the force: both were measured in records without excitation."
                if noise.measured
                else "and of the force: estimated from the residual of the fit, which includes "
                "undeclared effects, because every record has excitation."
            )
        ),
        Table(
            "Records. The only record of its kind is split, and its end is held out",
            ("record", "use"),
            tuple(dict.fromkeys(rows)),
            2,
        ),
    ]
    notes = [n for n in found.notes if OTHER_STEP not in n]
    if notes:
        head = ("log or record", "what happened")
        parts.append(Table("Omitted or repaired", head, tuple(_split(n) for n in notes), len(head)))
    parts.append(Text(f"Written by levid {__version__}.", "note"))
    if command:
        parts.append(Steps((("This command repeats the trace:", command),)))
    return Section("Records and provenance", tuple(parts))


def _split(note: str) -> tuple[str, str]:
    log, _, reason = note.partition(": ")
    return log, reason
