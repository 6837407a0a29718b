"""Write the report on an identification: the recommended plant, then evidence, other methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ...config.version import __version__
from ...identification.greybox.identify_greybox import GreyBox
from ...identification.nonparametric.robust_multisine import BestLinearApproximation
from ...identification.records.record import describe_position
from ...identification.results import IdentificationResult
from ..plotting.figure_to_svg import Picture
from ..plotting.html_page import (
    Figures,
    Next,
    Part,
    Section,
    Steps,
    Table,
    Text,
    write_report,
)
from ..plotting.style import signed
from ..session.flight_data import Session
from ..session.session_page import session_sections, session_words
from .chapters import Commands, identification_chapters
from .closed_loop import Truth

_NO_TRUTH = "Judge the model by held-out data and by the agreement of the methods."


def identification_report(
    result: IdentificationResult | None,
    session: Session | None,
    out_dir: Path,
    truth: Truth | None = None,
    grey: GreyBox | None = None,
    multisine: Sequence[BestLinearApproximation] = (),
    notes: Sequence[str] = (),
    commands: Commands | None = None,
) -> Path:
    """Write the report on an identification to `out_dir` and return the page's path.

    The page begins with the answer and the recommended model (`identification_chapters`). The
    others follow, folded. The command that repeats the identification is shown at the end.

    Args without results are omitted from the page: `result` is None without suitable records,
    `grey` without a declared model, `multisine` is empty without periodic records. `session` is the
    result of flight_data.read_session, or None to omit the flight. `truth` returns the true P
    (F, m, p) for a beam position and frequencies in Hz; only the caller has the simulator. `notes`
    list omitted records, 'log: reason'.

    Raises:
        ValueError: nothing was identified.
        OSError: the page cannot be written.
    """
    best, *others = identification_chapters(result, grey, multisine, truth, out_dir, commands)
    steps = tuple(dict.fromkeys(step for c in (best, *others) for step in c.steps))
    steps = (*best.use, *steps)
    answer: list[Part] = [Text(best.answer, "lead"), *(Next(*s) for s in (*best.steps, *steps)[:1])]
    answer += [Figures(best.numbers), *best.pictures[:1]]
    if session is not None:
        answer.append(Text(session_words(session), "note"))
    if truth is None and any(c.name != "Open loop" for c in (best, *others)):
        answer.append(Text(_NO_TRUTH, "note"))
    first, *evidence = best.sections
    first = replace(first, parts=(*best.words, *first.parts))
    sections = [
        first,
        Section("What next", (Steps(steps),)),
        *evidence,
        *(section for c in others for section in c.folded()),
    ]
    sections = [_without(section, best.pictures[:1]) for section in sections]
    details = _record_parts(result, grey, multisine, notes)
    flown: list[Section] = []
    if session is not None:
        flown = [replace(s, folded=True) for s in session_sections(session)]
        details += _versions_parts(session)
    sections = _numbered_once([Section("Answer", tuple(answer)), *sections, *flown])
    sections.append(Section("Records and provenance", (*details, *_provenance(commands))))
    title = f"Identification of '{_name(result, session, grey, multisine)}'"
    return write_report(out_dir, title, sections)


def _without(section: Section, shown: Sequence[Part]) -> Section:
    """Return a section without parts that the page shows already."""
    return replace(section, parts=tuple(part for part in section.parts if part not in shown))


def _provenance(commands: Commands | None) -> tuple[Part, ...]:
    version = Text(f"Written by levid {__version__}.", "note")
    command = "" if commands is None else commands.identify
    if not command:
        return (version,)
    return version, Steps((("This command repeats the identification:", command),))


def _numbered_once(sections: Sequence[Section]) -> list[Section]:
    """Return the sections with each figure number of the paper at its first picture only."""
    claimed: set[str] = set()

    def once(part: Part) -> Part:
        if not isinstance(part, Picture) or not part.paper:
            return part
        if part.paper in claimed:
            return replace(part, paper="")
        claimed.add(part.paper)
        return part

    return [replace(s, parts=tuple(once(part) for part in s.parts)) for s in sections]


def _name(
    result: IdentificationResult | None,
    session: Session | None,
    grey: GreyBox | None,
    multisine: Sequence[BestLinearApproximation],
) -> str:
    if session is not None:
        return session.name
    if result is not None and result.points:
        return ", ".join(result.points[0].records)
    return grey.declared.name if grey is not None else ", ".join(multisine[0].records)


def _record_parts(
    result: IdentificationResult | None,
    grey: GreyBox | None,
    multisine: Sequence[BestLinearApproximation],
    notes: Sequence[str],
) -> tuple[Part, ...]:
    rows: dict[tuple[str, str], list[str]] = {}
    of_point: list[Part] = []
    for point in (*(result.points if result is not None else ()), *multisine):
        where = "—" if point.beam_m is None else f"{signed(1e3 * point.beam_m, 1)} mm"
        for record in point.records:
            own = [
                r.removeprefix(f"{record}: ") for r in point.remarks if r.startswith(f"{record}: ")
            ]
            rows[record, where] = own
    for point in result.points if result is not None else ():
        own_to_records = tuple(f"{record}: " for record in point.records)
        where = describe_position(point.beam_m)
        of_point += [
            Text(f"{where[0].upper()}{where[1:]}: {r}.")
            for r in point.remarks
            if not r.startswith(own_to_records)
        ]
    for experiment in () if grey is None else grey.fit.records:
        where = "moving" if experiment.moving else "—"
        if experiment.name not in {name for name, _ in rows}:
            rows[experiment.name, where] = list(experiment.remarks)
    cells = tuple((record, where, "; ".join(own) or "—") for (record, where), own in rows.items())
    parts: list[Part] = [Table("Identified records", ("record", "beam", "remarks"), cells, 3)]
    parts += of_point
    of_all = [
        r
        for bla in multisine
        for r in bla.remarks
        if not r.startswith(tuple(f"{record}: " for record in bla.records))
    ]
    parts += [Text(f"Multisines: {remark}.") for remark in dict.fromkeys(of_all)]
    shown = {f"record '{record}': {text}" for (record, _), own in rows.items() for text in own}
    shown.update(() if grey is None else grey.remarks)
    left_out = dict.fromkeys(
        [*(result.skipped if result is not None else ()), *(n for n in notes if n not in shown)]
    )
    if left_out:
        skipped = tuple(_log_and_reason(text) for text in left_out)
        parts.append(Table("Omitted records, and other notes", ("what", "why"), skipped, 2))
    return tuple(parts)


def _log_and_reason(text: str) -> tuple[str, str]:
    log, _, reason = text.partition(": ")
    return log, reason


def _versions_parts(session: Session) -> tuple[Part, ...]:
    rows = tuple(sorted(session.versions.items()))
    return (
        (Table("Versions of the programs that wrote the logs", ("what", "version"), rows, 2),)
        if rows
        else ()
    )
