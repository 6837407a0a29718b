"""Collect what each identification method contributes, and choose the model to recommend."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ...config.command_line import command_line
from ...identification.compare_with_black_box import compare_with_black_box
from ...identification.greybox.identify_greybox import GreyBox
from ...identification.nonparametric.robust_multisine import BestLinearApproximation
from ...identification.results import ClosedLoopPoint, IdentificationResult, OpenLoopPoint
from ..figures.response_deviation import worst_on_diagonal
from ..plotting.figure_to_svg import Picture
from ..plotting.html_page import Figures, Number, Part, Section, Text
from ..plotting.labelled_frequency_responses import SignalLabels
from ..session.session_page import listed
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
from .open_loop import open_loop_answer, open_loop_numbers, open_loop_sections, open_loop_words
from .subspace import subspace_numbers, subspace_report, subspace_sections, subspace_words

_POOR_FIT_PERCENT = 50.0
_FAST_S = 2e-4
_BEAM = "beam"
"""Shipped session in which the beam moves."""
_RESPONSE = re.compile(
    r"fitted-response|plant-(subspace|ho-kalman)|(multisine|point-\d+)-magnitude"
)
"""Names of the pictures that show the magnitude of a plant."""
_READ_REMARKS = (
    "Read the remarks on the records: a linear model treats what they list as noise.",
    "",
)


@dataclass(frozen=True)
class Commands:
    """What the commands of next steps are made of.

    identify: the command that repeats the identification. logs: its logs. fly: returns the command
    by which the same rig flies a shipped session, empty if it cannot.
    """

    identify: str = ""
    logs: Sequence[Path] = ()
    fly: Callable[[str], str] = lambda _session: ""


def identification_chapters(
    result: IdentificationResult | None,
    grey: GreyBox | None,
    multisine: Sequence[BestLinearApproximation],
    truth: Truth | None = None,
    out_dir: Path = Path(),
    commands: Commands | None = None,
) -> list[Chapter]:
    """Return a chapter for each method, the recommended one first.

    It is the fitted model if it leaves no more than noise, or no more than the black-box model, or
    says that columns seem wrong;
    else the first reliable one of subspace, Ho-Kalman, multisines and open loop. Without a reliable
    model the first chapter says so.

    Raises ValueError if nothing was identified.
    """
    points = () if result is None else result.points
    if not points and grey is None and not multisine:
        raise ValueError(
            "expected at least one operating point, fitted model or multisine to report on, found "
            "none"
        )
    commands = commands or Commands()
    signals = signals_of(result, grey, multisine)
    closed = [p for p in points if isinstance(p, ClosedLoopPoint)]
    others = [p for p in points if isinstance(p, OpenLoopPoint)]
    chapters: list[Chapter] = []
    if grey is not None:
        chapters.append(_grey_box_chapter(grey, closed, others, signals, truth, out_dir, commands))
    if any(p.subspace for p in closed):
        chapters.append(_subspace_chapter(closed, signals, truth, grey))
    if closed:
        chapters.append(_closed_loop_chapter(closed, signals, truth, grey, commands))
    if multisine:
        chapters.append(_multisine_chapter(multisine, signals, truth))
    for number, point in enumerate(others, start=1):
        chapters.append(_open_loop_chapter(point, signals, truth, number, commands))
    doubted = [c for c in chapters if c.doubted]
    if grey is not None and grey.columns:
        return chapters  # columns that seem wrong are wrong for every model
    best = next((c for c in chapters if c.reliable), (doubted or chapters)[0])
    return [best, *(c for c in chapters if c is not best)]


def identification_answer(
    result: IdentificationResult | None,
    grey: GreyBox | None,
    multisine: Sequence[BestLinearApproximation],
) -> str:
    """Return the answer of an identification, with which its page begins: the model to use, or why
    there is none.
    """
    return identification_chapters(result, grey, multisine)[0].answer


@dataclass(frozen=True)
class Chapter:
    """The contribution of one identification method to the page.

    answer: the sentences that recommend its plant, or say why not. reliable: whether it can be
    recommended. draw: returns its sections. steps: next steps; use: how to use its model. doubted:
    whether a test of the records, and not of the model, is why it cannot be recommended.
    """

    name: str
    answer: str
    reliable: bool
    words: tuple[Text, ...]
    numbers: tuple[Number, ...]
    draw: Callable[[], tuple[Section, ...]]
    steps: Sequence[tuple[str, str]]
    use: Sequence[tuple[str, str]] = ()
    doubted: bool = False

    @cached_property
    def sections(self) -> tuple[Section, ...]:
        """Its sections, with the pictures."""
        return self.draw()

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
    commands: Commands,
) -> Chapter:
    report = closed_loop_report(points, signals, truth)
    beam_moved = grey is not None and any(e.moving for e in grey.fit.records)
    return Chapter(
        "Ho-Kalman",
        _advice("model by Ho-Kalman", [p.doubts for p in points], report.trusted)
        + closed_loop_words(report)[0].text,
        report.trusted,
        closed_loop_words(report),
        closed_loop_numbers(report),
        lambda: closed_loop_sections(report),
        _after_closed_loop(report, beam_moved, commands),
    )


def _subspace_chapter(
    points: Sequence[ClosedLoopPoint],
    signals: SignalLabels,
    truth: Truth | None,
    grey: GreyBox | None,
) -> Chapter:
    report = subspace_report(points, signals, truth, grey)
    words = subspace_words(report)
    trusted = all(model.trusted for model in report.models)
    return Chapter(
        "Subspace",
        _advice("model by the subspace method", [m.doubts for m in report.models], trusted)
        + words[0].text,
        trusted,
        words,
        subspace_numbers(report),
        lambda: subspace_sections(report),
        (),
    )


def _open_loop_chapter(
    point: OpenLoopPoint,
    signals: SignalLabels,
    truth: Truth | None,
    number: int,
    commands: Commands,
) -> Chapter:
    words = open_loop_words(point, signals)
    return Chapter(
        "Open loop",
        open_loop_answer(point, signals),
        point.trusted,
        words,
        open_loop_numbers(point),
        lambda: open_loop_sections(point, signals, truth, number),
        _after_open_loop(point),
        _use_of_open_loop(point, commands),
        doubted=not point.trusted,
    )


def _multisine_chapter(
    blas: Sequence[BestLinearApproximation], signals: SignalLabels, truth: Truth | None
) -> Chapter:
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
    return Chapter(
        "Multisines",
        " ".join(text.text for text in words),
        True,
        words,
        multisine_numbers(report),
        lambda: multisine_sections(report),
        steps,
    )


def _grey_box_chapter(
    grey: GreyBox,
    points: Sequence[ClosedLoopPoint],
    others: Sequence[OpenLoopPoint],
    signals: SignalLabels,
    truth: Truth | None,
    out_dir: Path,
    commands: Commands,
) -> Chapter:
    report = grey_box_report(grey, points, signals, truth)
    beside = compare_with_black_box(grey, others)
    as_good = beside is not None and beside.as_good
    as_good = as_good and not (grey.columns or grey.explains_nothing)
    reliable = not grey.doubts and (report.explains or as_good)
    return Chapter(
        "Fitted model",
        grey_box_answer(report, beside),
        reliable,
        grey_box_words(report),
        grey_box_numbers(report),
        lambda: grey_box_sections(report),
        _after_grey_box(report, out_dir, commands),
    )


def signals_of(
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


def _after_closed_loop(
    report: ClosedLoopReport, beam_moved: bool, commands: Commands
) -> list[tuple[str, str]]:
    """Return the next steps, most urgent first."""
    steps = []
    orders = {point.order for point in report.points}
    if len(orders) > 1:
        steps.append(
            (
                f"The beam positions have {listed([str(n) for n in sorted(orders)])} states by "
                "Ho-Kalman. Compare the singular values, and set one order for all positions "
                "(--order).",
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
                commands.fly("white-noise-10khz"),
            )
        )
    if not beam_moved:
        steps.append(_move_the_beam(commands))
    return steps


def _after_grey_box(
    report: GreyBoxReport, out_dir: Path, commands: Commands
) -> list[tuple[str, str]]:
    fit, steps = report.grey.fit, list[tuple[str, str]]()
    least, tests = least_chance(report)
    worst, loop = report.worst, report.grey.loop
    if loop is not None and loop.fit.modes:
        steps.append(
            (
                f"Keep motion and control below {loop.band.end_hz:.3g} Hz. Beyond it, use the "
                f"response with the modes that {out_dir / 'result.json'} lists (grey_box, loop).",
                "",
            )
        )
    white = not least * tests < NOT_WHITE if loop is None else loop.fit.white
    lacks = not white or (worst is not None and worst.over_noise > NOISE_MOST)
    if lacks and not steps:
        logs, model, out = commands.logs, out_dir / "model.yaml", out_dir / "trace"
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
        if report.grey.declared.scheduling and not report.moving and commands.fly(_BEAM):
            steps.append(_move_the_beam(commands))
    if fit.at_bound:
        steps.append(
            (f"Check {listed(list(fit.at_bound))}: the fit ended at a bound of the model file.", "")
        )
    if not steps:
        file = out_dir / "model.yaml"
        steps.append((f"Use {file} as --model of the next identification or trace.", ""))
    return steps


def _move_the_beam(commands: Commands) -> tuple[str, str]:
    return (
        "Fly a moving beam, and compare the platform's motion with the model (Fig. 14).",
        commands.fly(_BEAM),
    )


def _after_open_loop(point: OpenLoopPoint) -> list[tuple[str, str]]:
    if not point.trusted:
        again = "Record again as the answer says, correct the signals file, import and identify."
        return [(again, "levid import TABLE --signals SIGNALS.yaml -o LOG.mcap")]
    # A constant output has no fit; NaN does not count as a poor fit.
    poor = [h for h in point.holdout if np.any(h.simulated_fit_percent < _POOR_FIT_PERCENT)]
    if not poor:
        return []
    return [
        (
            "The simulation leaves much unexplained. Record longer, or excite more at the "
            "frequencies where the confidence band is wide.",
            "",
        )
    ]


def _use_of_open_loop(point: OpenLoopPoint, commands: Commands) -> list[tuple[str, str]]:
    if _after_open_loop(point):
        return []
    what = "Use the model. This command prints its matrices:"
    return [(what, f"{commands.identify} --json" if commands.identify else "")]


def _advice(model: str, doubts: Sequence[Sequence[str]], trusted: bool) -> str:
    """Return whether to use a model, as the first sentence of an answer."""
    if trusted:
        return f"Use the state-space {model}. "
    reasons = "; ".join(dict.fromkeys(text for each in doubts for text in each))
    return f"Do not use the state-space {model}: {reasons}. "
