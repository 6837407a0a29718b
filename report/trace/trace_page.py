"""Write the report on a trace: the answer, then parameters, evidence, method, provenance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from ...config.command_line import command_line
from ...config.model import EffectParameter
from ...identification.trace.figure_data import Views
from ...identification.trace.found_effects_summary import outcome
from ...identification.trace.run_trace import Trace
from ...identification.trace.trace_outcome import (
    NO_STILL,
    NOISE_MOST,
    PERHAPS_A_PART,
    FoundEffect,
    Outcome,
    RandomForce,
    telling,
)
from ...model.effects.base import in_words
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
from ..plotting.number_format import amount, times_text, with_interval
from ..session.session_page import listed
from .affected_places import affected_places, can_be_drawn, places_in_words
from .answer import rig_answer
from .effect_sections import effect_sections, sizes
from .residual_section import left_section
from .trace_sections import error_parts, model_section, records_section, search_section

_MOST_NAMED = 2


def trace_report(
    found: Trace, views: Views, out_dir: Path, command: str = "", logs: Sequence[Path] = ()
) -> Path:
    """Write the report on a trace to `out_dir` and return the page's path.

    The page begins with the answer; parameters, evidence, method and provenance follow. `command`
    reproduces the trace; it is shown at the end. `logs`: the traced logs, for the next command.

    Raises:
        OSError: the page cannot be written.
    """
    result = outcome(found)
    spectrum, *errors = error_parts(found, result, views)
    steps = _steps(result, out_dir, logs)
    sections = [
        Section("Answer", (*_answer(found, result, steps), spectrum)),
        *_effect_table(result, views),
        model_section(found),
        Section("What next", (Steps(tuple(steps)),)),
        *effect_sections(result, views),
        Section("Error before and after", tuple(errors)),
        left_section(found, result, views),
        search_section(found),
        records_section(found, command),
    ]
    return write_report(out_dir, f"Trace of '{found.config.name}': {_title(result)}", sections)


def _answer(found: Trace, result: Outcome, steps: Sequence[tuple[str, str]]) -> list[Part]:
    parts: list[Part] = [Text(rig_answer(result), "lead"), *(Next(*step) for step in steps[:1])]
    parts.append(Figures(_numbers(result)))
    parts += [Text(text) for text in _notes(result)]
    parts.append(
        Text(
            "Error: RMS of the difference between the readings and a simulation of the whole "
            "record from the excitation alone, on records kept aside: neither the fit nor the "
            "choice of effects used them. Times the noise: this error over the error that sensor "
            "and amplifier noise alone leave on average; a perfect model has about 1.",
            "note",
        )
    )
    effects = [f.effect for f in result.effects]
    if effects and can_be_drawn(found.places):
        parts.append(
            Picture(
                "platform",
                to_svg(affected_places(found.places, effects)),
                "The platform from above with the places of the effects marked.",
                places_in_words(found.places, effects),
                narrow=True,
            )
        )
    return parts


def _notes(result: Outcome) -> list[str]:
    """Return what a reader must know beside the answer."""
    texts = [_doubt(result, f) for f in result.effects]
    texts += [_shaken(force) for force in result.shaken]
    if result.doubt:
        texts.append(
            f"All names are uncertain: {result.doubt}. If the true effect is not in the table, "
            "other effects explain a part of it."
        )
    if result.declared:
        names = listed([f.effect.name for f in result.declared])
        texts.append(f"The model declares these effects already; they were refitted: {names}.")
    if result.gone:
        texts.append(
            f"Removed, because other effects explain the same error: {listed(list(result.gone))}."
        )
    if not result.noise_measured:
        texts.append(NO_STILL)
    return [text for text in texts if text]


def _effect_table(result: Outcome, views: Views) -> list[Section]:
    """Return the section with the numbers of all effects; none without effects."""
    rows = []
    for found in (*result.effects, *result.declared):
        why = found.evidence
        values = "; ".join(f"{name} = {with_interval(p)}" for name, p in _shown(found))
        size = sizes(found, views)
        rows.append(
            (
                found.effect.name,
                values,
                "—" if size is None else f"{amount(size[2], size[1])} {size[0]}",
                "—" if why is None or not math.isfinite(why.support) else f"{why.support:.2f}",
                "declared" if why is None else f"{why.statistic:.0f}",
            )
        )
    if not rows:
        return []
    head = ("effect", "parameters", "RMS force or reading", "support", "significance")
    return [
        Section(
            "Effects",
            (
                Table("Effects with 95 % intervals", head, tuple(rows), labels=3),
                Text(
                    "Support: share of data resamples in which the search chooses this effect or "
                    "one that the records cannot tell from it; it is not the probability that the "
                    "name is right. Significance: agreement of the effect's prediction with data "
                    "that did not fit it, in standard errors.",
                    "note",
                ),
            ),
        )
    ]


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


def _doubt(result: Outcome, found: FoundEffect) -> str:
    if result.perhaps_part_of(found):
        return (
            f"{found.effect.name} is {PERHAPS_A_PART}. The true effect may not be in the table, "
            "and this may be the nearest one."
        )
    if found.evidence and result.in_doubt(found) and not result.doubt:
        return (
            f"{found.effect.name} is uncertain: it leaves "
            f"{100 * found.evidence.left_share:.2g} % of the squared prediction error above noise. "
            "If the true effect is not in the table, the nearest one explains a part of it."
        )
    return ""


def _shaken(force: RandomForce) -> str:
    s = force.shaking
    rms = with_interval(EffectParameter(value=s.rms, se=s.se, unit=force.unit))
    return (
        f"{force.name}: {rms} RMS (95 %). The missing force is the same in records with and "
        f"without excitation ({s.statistic:.0f} standard errors on held-out data). It is no part"
        " of the model, and its error remains: look for a source of vibration or wind."
    )


def _shown(found: FoundEffect) -> list[tuple[str, EffectParameter]]:
    """Return the parameters to show: all but those fixed at zero."""
    return [(n, p) for n, p in found.parameters().items() if p.value != 0.0 or p.se]


def _numbers(result: Outcome) -> tuple[Number, ...]:
    ratio = result.after / result.floor
    before = Number(
        times_text(result.before / result.floor), "times the noise: error before, without effects"
    )
    numbers = [
        *([before] if result.effects else []),
        Number(
            times_text(ratio),
            "times the noise: error"
            + (" after, with effects" if result.effects else "")
            + " (noise alone: about 1)",
            "good" if ratio <= NOISE_MOST else "bad",
        ),
    ]
    supports = [f.evidence.support for f in result.effects if f.evidence is not None]
    supports = [s for s in supports if math.isfinite(s)]
    if supports:
        most = "the effect" if len(supports) == 1 else "each effect"
        numbers.append(
            Number(f"{100 * min(supports):.0f} %", f"of resamples of the data find {most} again")
        )
    doubtful = sum(bool(f.others) for f in result.effects)
    if doubtful:
        numbers.append(
            Number(str(doubtful), "effects that these records do not tell from others", "doubt")
        )
    return tuple(numbers)


def _steps(result: Outcome, out_dir: Path, logs: Sequence[Path]) -> Sequence[tuple[str, str]]:
    model, steps = out_dir / "model.yaml", []
    for f in result.effects:
        if f.evidence is not None and f.evidence.alternatives:
            names = listed([e.name for e in f.others or f.evidence.alternatives])
            how = telling(f) or "another excitation"
            steps.append((f"To tell {f.effect.name} from {names}, record: {how}.", ""))
    if result.significant:
        steps.append(
            (
                "See below what the remaining error depends on. You can add your own effect to the "
                "table: docs/trace.md shows how.",
                "",
            )
        )
    channels = [w for f in result.effects for w in f.effect.where if ":" in w]
    if channels:
        places = in_words(tuple(dict.fromkeys(channels)))
        steps.append(
            (
                f"Check {places} at the rig. What you do not repair stays in the model: "
                f"{out_dir / 'model.yaml'} has all effects.",
                "",
            )
        )
    if result.effects or result.declared:
        steps.append(
            (
                "Identify the plant with these effects in the model. Their force is subtracted "
                "from the records first.",
                command_line("identify", logs=logs, model=model, out=out_dir / "identification")
                if logs
                else "",
            )
        )
        steps.append(
            (
                f"Fly again on another day and trace with {model} as --model. The trace should "
                "find nothing.",
                "",
            )
        )
    if not steps and not result.noise_measured:
        steps.append(
            (
                "Add a record without excitation to the session. It measures the noise, so that "
                "the trace can tell noise from model error.",
                "",
            )
        )
    elif not steps:
        steps.append(
            (
                "The model is as good as these records can show. Excite more, or longer, to find "
                "smaller effects.",
                "",
            )
        )
    return steps
