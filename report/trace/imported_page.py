"""Write the report on a trace of imported records: the answer, then parameters and evidence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...config.command_line import command_line
from ...config.model import EffectParameter
from ...config.version import __version__
from ...identification.trace.force_balance.reported_errors import ReportedError
from ...identification.trace.force_search.rated_candidate import Rated
from ...identification.trace.force_trace.force_trace_outcome import ForceOutcome, force_outcome
from ...identification.trace.force_trace.force_trace_summary import ABOUT
from ...identification.trace.force_trace.found_law import FoundLaw
from ...identification.trace.force_trace.model_with_effects import (
    declared_effects,
    model_with_effects,
)
from ...identification.trace.force_trace.trace_imported import ForceTrace
from ..plotting.figure_to_svg import Picture, to_svg
from ..plotting.html_page import (
    Figures,
    Next,
    Number,
    Part,
    Section,
    Steps,
    Table,
    Text,
    write_report,
)
from ..plotting.labelled_frequency_responses import symbol
from ..plotting.number_format import half_percent, plain, unit_text, with_interval
from .answer import imported_answer
from .effect_shapes import effect_shapes
from .law_shapes import law_shapes
from .missing_force import missing_force


def imported_report(
    trace: ForceTrace, out_dir: Path, command: str = "", logs: Sequence[Path] = ()
) -> Path:
    """Write the report on a trace of imported records and return the page's path.

    The page begins with the answer; parameters, evidence, method and provenance follow. `command`
    reproduces the trace; it is shown at the end. `logs`: the traced logs, for the next command.

    Raises:
        OSError: the page cannot be written.
    """
    result = force_outcome(trace)
    picture, errors = _force_parts(trace, result)
    steps = _steps(result, out_dir, logs)
    sections = [
        Section("Answer", (*_answer(trace, result, steps), picture)),
        *_effects(result),
        Section("Model parameters", (_parameters(trace),)),
        Section("What next", (Steps(tuple(steps)),)),
        *(
            Section(f"{number}. {law.name}", _law_parts(trace, law, number))
            for number, law in enumerate(result.laws, start=1)
        ),
        Section("Error before and after", (errors,)),
        Section("Search", _search_parts(trace), folded=True),
        Section("Records and provenance", _provenance(trace, command)),
    ]
    names = (f"perhaps {law.name}" if law.doubtful else law.name for law in result.laws)
    title = ", ".join(names) or "no effect confirmed"
    if result.exchange is not None:
        title = f"it looks as if {result.exchange.words}"
    return write_report(out_dir, f"Trace of '{trace.config.name}': {title}", sections)


def _answer(
    trace: ForceTrace, result: ForceOutcome, steps: Sequence[tuple[str, str]]
) -> list[Part]:
    lead = imported_answer(result)
    parts: list[Part] = [Text(lead, "lead"), *(Next(*step) for step in steps[:1])]
    parts.append(Figures(_numbers(result)))
    parts += [Text(text) for text in _notes(result)]
    about = ABOUT[result.metric].format(limit=trace.limit_hz)
    parts.append(Text(f"Error: {about}.", "note"))
    if result.floor is None:
        parts.append(
            Text(
                "The noise of the outputs is estimated from their highest frequencies, where there "
                "is more than noise if a record is sampled slowly. State noise_sd of the outputs "
                "in the signals file if you know it.",
                "note",
            )
        )
    return parts


def _notes(result: ForceOutcome) -> list[str]:
    texts = [f"{result.verdict[0].upper()}{result.verdict[1:]}."]
    if result.lacks_something:
        texts.append(
            "The model lacks something: its numbers may be wrong by more than their intervals."
        )
    told = None
    for law in result.laws:
        if law.own_doubts:
            texts.append(f"{law.name} is uncertain: {'; '.join(law.own_doubts)}.")
        if law.curve is not None and law.curve is not told:
            told = law.curve
            texts.append(f"The equation of {law.name} is not exact: {law.inexact}.")
        if law.laws:
            names = ", ".join(r.placed.effect.title for r in law.laws)
            texts.append(f"Other laws fit as well as {law.name}: {names}.")
    if result.doubts_of_all:
        texts.append(f"Every effect is uncertain: {'; '.join(result.doubts_of_all)}.")
    if result.doubtful:
        texts.append(
            "If the true effect is not in the table, the nearest one explains a part of it."
        )
    return texts


def _effects(result: ForceOutcome) -> list[Section]:
    """Return the section with the numbers of all effects; none without effects."""
    rows = tuple(
        (
            law.name,
            "a free form: its coefficients have no physical meaning"
            if law.free
            else "; ".join(f"{n} = {with_interval(p)}" for n, p in law.parameters.items()),
            f"{100 * law.rated.share:.3g} %",
        )
        for law in result.laws
    )
    if not rows:
        return []
    head = ("effect", "parameters", "share of the squared missing force")
    return [Section("Effects", (Table("Effects with 95 % intervals", head, rows, labels=2),))]


def _numbers(result: ForceOutcome) -> tuple[Number, ...]:
    numbers = []
    for i, name in enumerate(result.dof):
        before, after = (e.force_percent[i] for e in (result.before, result.after))
        numbers.append(Number(f"{before:.3g} %", f"of the force at {symbol(name)} missing before"))
        numbers.append(Number(f"{after:.3g} %", f"of the force at {symbol(name)} missing after"))
    if result.metric == "free_run":
        for i, name in enumerate(result.dof):
            percent = result.after.percent[i]
            numbers.append(Number(f"{percent:.3g} %", f"free-run error of {symbol(name)}, after"))
    return tuple(numbers)


def _percent(value: float) -> str:
    return f"{value:.3g} %" if np.isfinite(value) else "—"


def _force_parts(trace: ForceTrace, result: ForceOutcome) -> tuple[Picture, Table]:
    """Return the missing force over time, and the table of errors by DOF."""
    rows = []
    for i, name in enumerate(result.dof):
        rows.append(
            (
                symbol(name),
                *(f"{error.force_percent[i]:.3g} %" for error in (result.before, result.after)),
                _percent(result.after.noise_percent[i]),
                _percent(result.fitted[i]),
                _percent(result.free_form[i]),
                *(_percent(error.percent[i]) for error in (result.before, result.after)),
            )
        )
    head = (
        "DOF", "force, before", "force, after", "noise", "fitted rows", "free form",
        "free run, before", "free run, after",
    )  # fmt: skip
    return (
        Picture(
            "missing-force",
            to_svg(missing_force(trace)),
            "Force of the inputs and missing force over time",
            "Missing force before and after, without its mean, on rows that neither fitted the "
            f"model nor chose its effects: M q″ + D q′ + K q − B u below {trace.limit_hz:.3g} Hz; "
            "0 where the DOF rests.",
        ),
        Table(
            "Errors of all reported rows: missing force over the inputs' force, and free-run error "
            "over the output. Noise: missing force that noise of the outputs gives. Fitted rows: "
            "what the model leaves in these; free form: what a general function of all signals "
            "leaves there",
            head,
            tuple(rows),
        ),
    )


def _law_parts(trace: ForceTrace, law: FoundLaw, number: int) -> tuple[Part, ...]:
    effect, rated = law.placed.effect, law.rated
    parts: list[Part] = [Text(f"{effect.equation}.", "lead")]
    shapes = law_shapes(trace, law)
    if shapes:
        parts.append(
            Picture(
                f"law-{number}",
                to_svg(effect_shapes(shapes)),
                f"{effect.name} over its signal and over time",
                "Measured: the law's force and what the model lacks beside it, without the mean.",
            )
        )
    if not law.free:
        rows = [
            (name, with_interval(p), half_percent(p.value, p.se))
            for name, p in law.parameters.items()
        ]
        parts.append(
            Table(
                "Parameters, 95 % intervals by scatter of blocks, choice of the band, and noise",
                ("parameter", "value", "half the interval"),
                tuple(rows),
            )
        )
    others = [g for g in rated.gain.others if np.isfinite(g)]
    asked = f"{len(others)} held-out parts of the records agree." if others else ""
    parts.append(
        Text(
            f"Cross-validation: it explains {100 * rated.share:.3g} % of the squared missing force "
            f"of held-out blocks, {rated.gain.statistic:.1f} times the standard error. {asked}"
        )
    )
    rivals = [*law.alternatives, *law.laws]
    if rivals:
        parts.append(
            Table(
                "Effects that these records cannot tell from it",
                ("effect", "equation", "share of the squared missing force"),
                tuple(_rival(r) for r in rivals),
                labels=2,
            )
        )
    if effect.told_apart_by:
        parts.append(Text(f"To tell it from others, record: {effect.told_apart_by}.", "note"))
    return tuple(parts)


def _rival(rated: Rated) -> tuple[str, str, str]:
    effect = rated.placed.effect
    return effect.name, effect.equation, f"{100 * rated.share:.3g} %"


def _parameters(trace: ForceTrace) -> Table:
    declared = trace.config.parameters
    rows = [
        (
            name,
            f"{plain(declared[name].value)} {unit_text(declared[name].unit)}",
            with_interval(EffectParameter(value=p.value, unit=p.unit, se=p.se)),
        )
        for name, p in model_with_effects(trace).parameters.items()
        if name in trace.found.point.parameters.names
    ]
    for effect, parameters in declared_effects(trace):
        rows += [(f"{name}, {effect.name}", "", with_interval(p)) for name, p in parameters.items()]
    return Table(
        "Parameters of the declared model, with 95 % intervals where the records tell them",
        ("parameter", "declared", "fitted"),
        tuple(rows),
    )


def _search_parts(trace: ForceTrace) -> tuple[Part, ...]:
    o = trace.options
    parts: list[Part] = [
        Text(
            f"An effect is added if it explains more than {100 * o.least_gain:.0f} % of the "
            f"squared missing force of held-out blocks, by more than {o.standard_errors:g} "
            "standard errors, and if no other record contradicts it. Among effects that the "
            "records cannot tell apart, the one with the fewest parameters is added."
        )
    ]
    nearest = trace.found.nearest
    if nearest:
        parts.append(
            Table(
                "Best candidates that were not added",
                (
                    "effect",
                    "share of the squared missing force",
                    "over its standard error",
                    "other records",
                ),
                tuple(
                    (
                        r.placed.effect.name,
                        f"{100 * r.share:.3g} %",
                        f"{r.gain.statistic:.1f}",
                        "agree" if r.gain.elsewhere else "contradict",
                    )
                    for r in nearest
                ),
            )
        )
    return tuple(parts)


def _provenance(trace: ForceTrace, command: str) -> tuple[Part, ...]:
    parts: list[Part] = [_records(trace), Text(f"Written by levid {__version__}.", "note")]
    if command:
        parts.append(Steps((("This command repeats the trace:", command),)))
    return tuple(parts)


def _missing(error: ReportedError) -> str:
    """Return the missing force over the acting force, of the DOF on which one acts."""
    acts = error.force_acting > 0.0
    ratios = error.force[acts] / error.force_acting[acts]
    return f"{100 * np.sqrt(np.mean(ratios**2)):.3g} %" if acts.any() else "—"


def _records(trace: ForceTrace) -> Table:
    rows = []
    for before, after, fitted in zip(trace.before, trace.after, trace.fitted, strict=True):
        parts = [_missing(e) for e in (before, after)]
        seconds = f"{fitted.rows * fitted.band.row_s:.3g} s"
        rows.append((after.record, seconds, f"{after.seconds:.3g} s", *parts))
    return Table(
        "Records: time that fitted and chose, time that only reports, missing force in it",
        ("record", "fitted", "reported", "before", "after"),
        tuple(rows),
    )


def _steps(result: ForceOutcome, out_dir: Path, logs: Sequence[Path]) -> Sequence[tuple[str, str]]:
    if result.exchange is not None:
        again = (
            "Compare columns and units in the signals files with the rig, import and trace again."
        )
        return [(again, "")]
    steps = []
    for law in result.laws:
        if law.alternatives:
            how = law.placed.effect.told_apart_by or "another excitation"
            steps.append((f"To tell the members of {law.name} apart, record: {how}.", ""))
    if result.laws:
        steps.append(
            (
                "Identify the plant with these effects in the model. Their force is subtracted "
                "from the records first.",
                command_line(
                    "identify",
                    logs=logs,
                    model=out_dir / "model.yaml",
                    out=out_dir / "identification",
                )
                if logs
                else "",
            )
        )
    steps.append(
        (
            "Record other amplitudes and speeds. They show effects that differ from the linear "
            "model.",
            "",
        )
    )
    return steps
