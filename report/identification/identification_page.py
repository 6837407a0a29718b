"""Write the report on an identification: the recommended plant, then evidence, other methods."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...config.command_line import command_line
from ...config.version import __version__
from ...identification.greybox.identify_greybox import GreyBox
from ...identification.nonparametric.robust_multisine import BestLinearApproximation
from ...identification.records.record import describe_position
from ...identification.results import ClosedLoopPoint, IdentificationResult, OpenLoopPoint
from ..figures.response_deviation import worst_on_diagonal
from ..plotting.figure_to_svg import Picture
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
from ..plotting.labelled_frequency_responses import SignalLabels
from ..plotting.style import signed
from ..session.flight_data import Session
from ..session.session_page import listed, session_sections, session_words
from .closed_loop import (
    ClosedLoopReport,
    Truth,
    closed_loop_numbers,
    closed_loop_report,
    closed_loop_words,
    uses_ho_kalman,
)
from .closed_loop_identification_sections import closed_loop_sections
from .greybox import (
    NOISE_MOST,
    NOT_WHITE,
    GreyBoxReport,
    grey_box_answer,
    grey_box_numbers,
    grey_box_report,
    grey_box_words,
    least_chance,
)
from .greybox_sections import grey_box_sections
from .multisine import multisine_numbers, multisine_report, multisine_sections, multisine_words
from .open_loop import open_loop_numbers, open_loop_sections, open_loop_words
from .subspace import subspace_numbers, subspace_report, subspace_sections, subspace_words

_POOR_FIT_PERCENT = 50.0
_FAST_S = 2e-4
_BEAM = "beam"
"""Shipped session in which the beam moves."""
Fly = Callable[[str], str]
_RESPONSE = re.compile(
    r"fitted-response|plant-(subspace|ho-kalman)|(multisine|point-\d+)-magnitude"
)
"""Names of the pictures that show the magnitude of a plant."""
_READ_REMARKS = (
    "Read the remarks on the records: a linear model treats what they list as noise.",
    "",
)
_NO_TRUTH = "Judge the model by held-out data and by the agreement of the methods."


def _no_flight(_session: str) -> str:
    return ""


def identification_report(
    result: IdentificationResult | None,
    session: Session | None,
    out_dir: Path,
    truth: Truth | None = None,
    grey: GreyBox | None = None,
    multisine: Sequence[BestLinearApproximation] = (),
    notes: Sequence[str] = (),
    command: str = "",
    logs: Sequence[Path] = (),
    fly: Fly = _no_flight,
) -> Path:
    """Write the report on an identification to `out_dir` and return the page's path.

    The page begins with the recommended plant: the fitted model if it leaves no more than noise,
    else the first reliable one of subspace, Ho-Kalman, multisines and open loop. The others follow,
    folded. `command` reproduces the identification; it is shown at the end. For the next steps,
    `logs` are its logs, and `fly` returns the command by which the same rig flies a shipped
    session, empty if it cannot.

    Args without results are omitted from the page: `result` is None without suitable records,
    `grey` without a declared model, `multisine` is empty without periodic records. `session` is the
    result of flight_data.read_session, or None to omit the flight. `truth` returns the true P
    (F, m, p) for a beam position and frequencies in Hz; only the caller has the simulator. `notes`
    list omitted records, 'log: reason'.

    Raises:
        ValueError: nothing was identified.
        OSError: the page cannot be written.
    """
    points = () if result is None else result.points
    if not points and grey is None and not multisine:
        raise ValueError(
            "expected at least one operating point, fitted model or multisine to report on, found "
            "none"
        )
    signals = _signals(result, grey, multisine)
    closed = [p for p in points if isinstance(p, ClosedLoopPoint)]
    others = [p for p in points if isinstance(p, OpenLoopPoint)]
    chapters: list[_Chapter] = []
    if grey is not None:
        chapters.append(_grey_box_chapter(grey, closed, signals, truth, logs, out_dir, fly))
    if any(p.subspace for p in closed):
        chapters.append(_subspace_chapter(closed, signals, truth))
    if closed:
        chapters.append(_closed_loop_chapter(closed, signals, truth, grey, fly))
    if multisine:
        chapters.append(_multisine_chapter(multisine, signals, truth))
    for number, point in enumerate(others, start=1):
        chapters.append(_open_loop_chapter(point, signals, truth, number, command))
    best = next((c for c in chapters if c.reliable), chapters[0])
    steps = tuple(dict.fromkeys(step for chapter in chapters for step in chapter.steps))
    answer: list[Part] = [Text(best.answer, "lead"), *(Next(*s) for s in (*best.steps, *steps)[:1])]
    answer += [Figures(best.numbers), *best.pictures[:1]]
    if session is not None:
        answer.append(Text(session_words(session), "note"))
    if truth is None and (grey is not None or multisine or closed):
        answer.append(Text(_NO_TRUTH, "note"))
    first, *evidence = best.sections
    first = replace(first, parts=(*best.words, *first.parts))
    sections = [
        first,
        Section("What next", (Steps(steps),)),
        *evidence,
        *(section for c in chapters if c is not best for section in c.folded()),
    ]
    sections = [_without(section, best.pictures[:1]) for section in sections]
    details = _record_parts(result, grey, multisine, notes)
    flown: list[Section] = []
    if session is not None:
        flown = [replace(s, folded=True) for s in session_sections(session)]
        details += _versions_parts(session)
    sections = _numbered_once([Section("Answer", tuple(answer)), *sections, *flown])
    sections.append(Section("Records and provenance", (*details, *_provenance(command))))
    title = f"Identification of '{_name(result, session, grey, multisine)}'"
    return write_report(out_dir, title, sections)


def _without(section: Section, shown: Sequence[Part]) -> Section:
    """Return a section without parts that the page shows already."""
    return replace(section, parts=tuple(part for part in section.parts if part not in shown))


def _provenance(command: str) -> tuple[Part, ...]:
    version = Text(f"Written by levid {__version__}.", "note")
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


@dataclass(frozen=True)
class _Chapter:
    """The contribution of one identification method to the page.

    answer: the sentences that recommend its plant. reliable: whether it can be recommended.
    """

    name: str
    answer: str
    reliable: bool
    words: tuple[Text, ...]
    numbers: tuple[Number, ...]
    sections: tuple[Section, ...]
    steps: Sequence[tuple[str, str]]

    @property
    def pictures(self) -> list[Picture]:
        """Its pictures of the plant's magnitude."""
        parts = [part for s in self.sections for part in s.parts if isinstance(part, Picture)]
        return [p for p in parts if _RESPONSE.fullmatch(p.name)]

    def folded(self) -> tuple[Section, ...]:
        """Return its sections folded, with the method's name, words and numbers in the first."""
        first, *rest = self.sections
        head: tuple[Part, ...] = (*self.words, Figures(self.numbers))
        return (
            Section(f"{self.name}: {_lower(first.title)}", (*head, *first.parts), folded=True),
            *(
                Section(f"{self.name}: {_lower(section.title)}", section.parts, folded=True)
                for section in rest
            ),
        )


def _lower(title: str) -> str:
    return f"{title[0].lower()}{title[1:]}"


def _closed_loop_chapter(
    points: Sequence[ClosedLoopPoint],
    signals: SignalLabels,
    truth: Truth | None,
    grey: GreyBox | None,
    fly: Fly,
) -> _Chapter:
    report = closed_loop_report(points, signals, truth)
    beam_moved = grey is not None and any(p.experiment.moving for p in grey.fit.predictions)
    return _Chapter(
        "Ho-Kalman",
        f"Use the state-space model by Ho-Kalman. {closed_loop_words(report)[0].text}",
        report.trusted,
        closed_loop_words(report),
        closed_loop_numbers(report),
        closed_loop_sections(report),
        _after_closed_loop(report, beam_moved, fly),
    )


def _subspace_chapter(
    points: Sequence[ClosedLoopPoint], signals: SignalLabels, truth: Truth | None
) -> _Chapter:
    report = subspace_report(points, signals, truth)
    words = subspace_words(report)
    return _Chapter(
        "Subspace",
        f"Use the state-space model by the subspace method. {words[0].text}",
        all(model.trusted for model in report.models),
        words,
        subspace_numbers(report),
        subspace_sections(report),
        (),
    )


def _open_loop_chapter(
    point: OpenLoopPoint,
    signals: SignalLabels,
    truth: Truth | None,
    number: int,
    command: str,
) -> _Chapter:
    words = open_loop_words(point, signals)
    return _Chapter(
        "Open loop",
        " ".join(text.text for text in words[:2]),
        True,
        words,
        open_loop_numbers(point),
        open_loop_sections(point, signals, truth, number),
        _after_open_loop(point, command),
    )


def _multisine_chapter(
    blas: Sequence[BestLinearApproximation], signals: SignalLabels, truth: Truth | None
) -> _Chapter:
    report = multisine_report(blas, signals, truth)
    steps = []
    if report.distorted():
        steps.append(
            (
                "The plant is nonlinear at this amplitude. Fly the multisines at half of it: "
                "distortion falls by more than half.",
                "",
            )
        )
    if any(bla.remarks for bla in blas):
        steps.append(_READ_REMARKS)
    words = multisine_words(report)
    return _Chapter(
        "Multisines",
        " ".join(text.text for text in words),
        True,
        words,
        multisine_numbers(report),
        multisine_sections(report),
        steps,
    )


def _grey_box_chapter(
    grey: GreyBox,
    points: Sequence[ClosedLoopPoint],
    signals: SignalLabels,
    truth: Truth | None,
    logs: Sequence[Path],
    out_dir: Path,
    fly: Fly,
) -> _Chapter:
    report = grey_box_report(grey, points, signals, truth)
    return _Chapter(
        "Fitted model",
        grey_box_answer(report),
        report.explains,
        grey_box_words(report),
        grey_box_numbers(report),
        grey_box_sections(report),
        _after_grey_box(report, logs, out_dir, fly),
    )


def _signals(
    result: IdentificationResult | None,
    grey: GreyBox | None,
    multisine: Sequence[BestLinearApproximation],
) -> SignalLabels:
    """Return names and units; an input with the name of its DOF gets a tau."""
    if grey is not None:
        inputs, dof = grey.declared.inputs, grey.declared.dof
        return SignalLabels(
            tuple(q.name for q in inputs),
            tuple(q.unit for q in inputs),
            tuple(q.name for q in dof),
            tuple(q.unit for q in dof),
        )
    s = multisine[0].signals if result is None else result.signals
    names = s.input_names
    if names == s.output_names:
        names = tuple(f"tau_{name}" for name in names)
    return SignalLabels(names, s.input_units, s.output_names, s.output_units)


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


def _after_closed_loop(
    report: ClosedLoopReport, beam_moved: bool, fly: Fly
) -> list[tuple[str, str]]:
    """Return the next steps, most urgent first."""
    steps = []
    orders = {point.order.order for point in report.points}
    if len(orders) > 1:
        steps.append(
            (
                f"The beam positions have {listed([str(n) for n in sorted(orders)])} main states. "
                "Compare the singular values, and set one order for all positions (--order).",
                "",
            )
        )
    if report.unreliable:
        where = listed([label for label, _ in report.unreliable])
        steps.append(
            (
                f"Do not use the model by Ho-Kalman at beam {where}. Record longer, or excite "
                "more. The response by (15) needs no model and is valid.",
                "",
            )
        )
    for name in report.ratios:
        if uses_ho_kalman(name) and not report.trusted:
            continue
        decibel, degree = report.largest(name)
        if decibel <= report.bounds.decibel and degree <= report.bounds.degree:
            continue
        worst, path, label = max(
            (
                (w, report.signals.path(i, i), label)
                for label, curve in report.evaluated(name)
                for i, w in enumerate(worst_on_diagonal(curve, report.shown))
            ),
            key=lambda entry: np.nan_to_num(entry[0].decibel, nan=np.inf),
        )
        steps.append(
            (
                f"{name.replace(' / ', ' against ')} exceeds the bounds, most at "
                f"{worst.decibel_at_hz:.1f} Hz on {path}, beam {label}: record longer, or excite "
                "more strongly there.",
                "",
            )
        )
    if any(point.remarks for point in report.points):
        steps.append(_READ_REMARKS)
    if report.points[0].loop.Ts_s > _FAST_S:
        steps.append(
            (
                "Fly the same session at 10 kHz, as in the paper, and compare.",
                fly("white-noise-10khz"),
            )
        )
    if not beam_moved:
        steps.append(_move_the_beam(fly))
    return steps


def _after_grey_box(
    report: GreyBoxReport, logs: Sequence[Path], out_dir: Path, fly: Fly
) -> list[tuple[str, str]]:
    fit, steps = report.grey.fit, list[tuple[str, str]]()
    least, tests = least_chance(report)
    worst = report.worst
    if least * tests < NOT_WHITE or (worst is not None and worst.over_noise > NOISE_MOST):
        model, out = out_dir / "model.yaml", out_dir / "trace"
        trace = command_line("trace", logs=logs, model=model, out=out) if logs else ""
        steps.append(("Find the effect that the model lacks.", trace))
    if fit.unidentifiable:
        names = listed([u.name for u in fit.unidentifiable])
        steps.append(
            (
                f"{names} could not be fitted and kept the declared value. Add a record that "
                "depends on it, or fix it in the model file if it is known.",
                "",
            )
        )
        if report.grey.declared.scheduling and not report.moving and fly(_BEAM):
            steps.append(_move_the_beam(fly))
    if fit.at_bound:
        steps.append(
            (f"Check {listed(list(fit.at_bound))}: the fit ended at a bound of the model file.", "")
        )
    if not steps:
        file = out_dir / "model.yaml"
        steps.append((f"Use {file} as --model of the next identification or trace.", ""))
    return steps


def _move_the_beam(fly: Fly) -> tuple[str, str]:
    return (
        "Fly a moving beam, and compare the platform's motion with the model (Fig. 14).",
        fly(_BEAM),
    )


def _after_open_loop(point: OpenLoopPoint, command: str) -> list[tuple[str, str]]:
    # A constant output has no fit; NaN does not count as a poor fit.
    poor = [h for h in point.holdout if np.any(h.simulated_fit_percent < _POOR_FIT_PERCENT)]
    if poor:
        return [
            (
                "The simulation leaves much unexplained. Record longer, or excite more at the "
                "frequencies where the confidence band is wide.",
                "",
            )
        ]
    what = "Use the model. This command prints its matrices:"
    return [(what, f"{command} --json" if command else "")]


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
    for prediction in () if grey is None else grey.fit.predictions:
        experiment = prediction.experiment
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
