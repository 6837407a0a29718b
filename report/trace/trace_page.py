"""Write the report on a trace: error before, effects, error after, evidence."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from ...config.model import EffectParameter
from ...identification.trace.figure_data import Views
from ...identification.trace.found_effects_summary import (
    NO_STILL,
    NOISE_MOST,
    PERHAPS_A_PART,
    SQUARE_MOST,
    FoundEffect,
    Outcome,
    RandomForce,
    outcome,
    telling,
)
from ...identification.trace.run_trace import Trace
from ..plotting.html_page import Figures, Number, Section, Steps, Text, write_report
from ..plotting.labelled_frequency_responses import symbol
from ..session.session_page import listed
from .effect_sections import effect_sections, sizes
from .number_format import amount, share_text, times_text, with_interval
from .residual_section import left_section
from .trace_sections import error_section, model_section, records_section, search_section

_MOST_NAMED = 2


def trace_report(found: Trace, views: Views, out_dir: Path) -> Path:
    """Write the report on a trace to `out_dir` and return the page's path.

    Raises:
        OSError: the page cannot be written.
    """
    result = outcome(found)
    sections = [
        Section("Summary", (*_words(result, views), Figures(_numbers(result)))),
        error_section(found, result, views),
        *effect_sections(result, views),
        search_section(found),
        left_section(found, result, views),
        model_section(found),
        records_section(found),
        Section("What next", (Steps(tuple(_steps(result, out_dir))),)),
    ]
    return write_report(out_dir, f"Trace of {found.config.name}: {_title(result)}", sections)


def _title(result: Outcome) -> str:
    if len(result.effects) > _MOST_NAMED:
        return f"{len(result.effects)} effects found"
    if result.effects or result.shaken:
        names = [f"perhaps {f.name}" if result.in_doubt(f) else f.name for f in result.effects]
        return listed(names + [s.name for s in result.shaken])
    if result.significant:
        return "something unexplained"
    unknown = result.overrated or not result.noise_measured
    return "nothing can be told" if unknown else "nothing found"


def _words(result: Outcome, views: Views) -> list[Text]:
    texts = [Text(_headline(result), "lead")]
    texts += [Text(_sentence(f, views) + _doubt(result, f)) for f in result.effects]
    texts += [Text(_shaken(force)) for force in result.shaken]
    if result.declared:
        names = listed([f.effect.name for f in result.declared])
        texts.append(Text(f"Declared in the model already, and refitted: {names}."))
    if result.gone:
        texts.append(
            Text(f"Given up, since others explain what it did: {listed(list(result.gone))}.")
        )
    if not result.noise_measured:
        texts.append(Text(NO_STILL))
    if result.doubt:
        texts.append(
            Text(
                f"All of this is in doubt: {result.doubt}. The best of a table that lacks what is "
                "there takes something too; these may stand for it."
            )
        )
    if result.effects:
        texts.append(Text(_rest(result)))
    return texts


def _headline(result: Outcome) -> str:
    before, after, floor = (f"{v:.3g}" for v in (result.before, result.after, result.floor))
    measure = "times the sensors' noise (RMS, free-running, on records that were not fitted)"
    if not result.noise_measured:
        found = f"; with {_count(len(result.effects))} found, {after}" if result.effects else ""
        return (
            f"The declared model misses these records by {before} times the estimated noise (RMS, "
            f"free-running, on records that were not fitted){found}. No record tells how much of "
            "that is noise."
        )
    if result.effects:
        return (
            f"The declared model misses these records by {before} {measure}; with "
            f"{_count(len(result.effects))} that the records tell of it misses them by {after}. "
            f"Noise alone leaves {floor}."
        )
    if result.shaken:
        return (
            f"The model misses these records by {after} {measure}, where noise alone would leave "
            f"{floor}. What is left repeats nothing that is flown: something shakes the platform."
        )
    if result.significant:
        return (
            f"The model misses these records by {after} {measure}, where noise alone would leave "
            f"{floor}. More than noise is left, and no effect of the table explains it beyond "
            "chance: what it depends on is drawn below."
        )
    if result.overrated:
        return (
            f"Nothing can be told. The model misses these records by {after} {measure}, but one "
            f"step ahead the errors have {result.mean_square:.2g} of the variance that was taken "
            "for the sensors' noise: it is read at the readings' highest frequencies, and there is "
            "more than noise there. Sample faster, or excite less up there."
        )
    return (
        f"Nothing found. The model misses these records by {after} {measure}; noise alone leaves "
        f"{floor}. No effect of the table explains anything beyond chance."
    )


def _count(number: int) -> str:
    return "one effect" if number == 1 else f"{number} effects"


def _sentence(found: FoundEffect, views: Views) -> str:
    effect, why = found.effect, found.evidence
    values = listed([f"{name} = {with_interval(p)}" for name, p in _shown(found)])
    text = f"{effect.name}: {values} (95 %)."
    if found.others:
        text = f"One of these: {found.name}. If it is {effect.name}: {values} (95 %)."
    if found.unknown:
        text = f"No known effect: {effect.name}, described by a free form."
    size = sizes(found, views)
    if size is not None:
        place, unit, rms, most = size
        text += f" It is {amount(rms, unit)} RMS {place}, {amount(most, unit)} at most."
    if why is not None:
        share = "" if why.share is None else f"explains {share_text(why.share)} and "
        others = "held-out records" if why.held else "blocks of time that did not fit it"
        text += (
            f" It {share}agrees with {others} {why.statistic:.0f} standard deviations beyond "
            "chance."
        )
        laws = [e.name for e in why.alternatives if e not in found.others]
        if found.others:
            text += " These records do not tell them apart."
        if laws:
            text += f" Other laws fit as well: {listed(laws)}."
    return text


def _doubt(result: Outcome, found: FoundEffect) -> str:
    if result.perhaps_part_of(found):
        return f" It is {PERHAPS_A_PART}: the table lacks what is there, and this may be its best."
    if found.evidence and result.in_doubt(found) and not result.doubt:
        return (
            " It is in doubt: of the squared prediction error without it, "
            f"{share_text(found.evidence.left_share)} is left. If the table lacks what is there, "
            "its best takes something too."
        )
    return ""


def _shaken(force: RandomForce) -> str:
    s = force.shaking
    rms = with_interval(EffectParameter(value=s.rms, se=s.se, unit=force.unit))
    return (
        f"{force.name}: {rms} RMS (95 %). The force that the model lacks there is the same in "
        "still records as in excited ones, and in held-out ones stands out of the noise by "
        f"{s.statistic:.0f} standard deviations. Nobody can foretell it, so it is no part of the "
        "model, and the error stays: look for what shakes the floor, or blows."
    )


def _shown(found: FoundEffect) -> list[tuple[str, EffectParameter]]:
    """Return the parameters to show: all but those fixed at zero."""
    return [(n, p) for n, p in found.parameters().items() if p.value != 0.0 or p.se]


def _rest(result: Outcome) -> str:
    if not result.significant and result.noise_measured and not result.overrated:
        return "What is left is noise: no other effect of the table explains anything of it."
    if not result.significant:
        return f"{result.rest[0].upper()}{result.rest[1:]}."
    worst = max(result.dof, key=lambda d: d.after / d.floor)
    if result.after <= NOISE_MOST * result.floor:
        return (
            "One step ahead a little more than noise is left (mean square "
            f"{result.mean_square:.3f}), and no other effect of the table explains it beyond "
            "chance."
        )
    return (
        "More is left than noise, and no other effect of the table explains it beyond chance: "
        f"most on {symbol(worst.name)}, {times_text(worst.after / worst.floor)} times the noise, "
        f"between {worst.band_hz[0]:.3g} and {worst.band_hz[1]:.3g} Hz."
    )


def _numbers(result: Outcome) -> tuple[Number, ...]:
    ratio = result.after / result.floor
    without = Number(
        f"{result.before / result.floor:.3g}", "times the noise: error without effects"
    )
    numbers = [
        *([without] if result.effects else []),
        Number(
            f"{ratio:.3g}",
            "times the noise: error" + (" with effects" if result.effects else ""),
            "good" if ratio <= NOISE_MOST else "bad",
        ),
        Number(
            str(len(result.effects) + len(result.shaken)), "effects found that were not declared"
        ),
        Number(
            f"{result.mean_square:.3f}",
            "mean square of held-out one-step errors, 1 for noise",
            "bad" if result.mean_square > SQUARE_MOST else "good",
        ),
    ]
    doubtful = sum(bool(f.evidence and f.evidence.alternatives) for f in result.effects)
    if doubtful:
        numbers.append(
            Number(str(doubtful), "of them that these records do not tell from others", "doubt")
        )
    return tuple(numbers)


def _steps(result: Outcome, out_dir: Path) -> Sequence[tuple[str, str]]:
    model = shlex.quote(str(out_dir / "model.yaml"))
    steps = []
    for f in result.effects:
        if f.evidence is not None and f.evidence.alternatives:
            names = listed([e.name for e in f.others or f.evidence.alternatives])
            how = telling(f) or "another excitation"
            steps.append((f"Tell {f.effect.name} from {names}: {how}.", ""))
    if result.significant:
        steps.append(
            (
                "Look at what the rest depends on, and write the effect that would do it into the "
                "table: docs/trace.md says how.",
                "",
            )
        )
    if result.effects or result.declared:
        steps.append(
            (
                "Identify with the effects in the model: they are taken out of the records first.",
                f"levid identify LOG... --model {model} --out DIR",
            )
        )
        steps.append(
            (
                "Fly again on another day and trace with this model: nothing should be found.",
                f"levid trace LOG... --model {model} --out DIR",
            )
        )
    if not steps and not result.noise_measured:
        steps.append(
            (
                "Record a stretch without excitation as well: it tells noise from the model's "
                "error, which these records do not.",
                "",
            )
        )
    elif not steps:
        steps.append(
            (
                "Nothing: the model is as good as these records can tell. Larger or longer "
                "excitation would show smaller effects.",
                "",
            )
        )
    return steps
