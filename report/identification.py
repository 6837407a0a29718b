"""The report on an identification: summary, figures of the paper, agreement, what to do next."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..identification.results import ClosedLoopPoint, IdentificationResult, OpenLoopPoint
from .closed_loop import (
    ClosedLoopReport,
    Truth,
    closed_loop_numbers,
    closed_loop_report,
    closed_loop_words,
)
from .closed_loop_sections import closed_loop_sections
from .curves import Signals
from .flown import Session
from .open_loop import open_loop_numbers, open_loop_sections, open_loop_words
from .page import Figures, Part, Section, Steps, Table, Text, write_report
from .session import listed, session_sections, session_words
from .style import signed

_POOR_FIT_PERCENT = 50.0
_FAST_S = 2e-4


def identification_report(
    result: IdentificationResult,
    session: Session | None,
    out_dir: Path,
    truth: Truth | None = None,
) -> Path:
    """Write the page on an identification into `out_dir` and return its path.

    `session` is what flown.read_session makes of the logs, None to leave the flight out. `truth`
    gives the true P (F, m, p) of a beam position at frequencies in Hz; who calls knows the
    simulator, this page does not.

    Raises:
        ValueError: the result has no operating point.
        OSError: the page cannot be written.
    """
    if not result.points:
        raise ValueError("expected at least one operating point to report on, found none")
    signals = _signals(result)
    closed = [p for p in result.points if isinstance(p, ClosedLoopPoint)]
    others = [p for p in result.points if isinstance(p, OpenLoopPoint)]
    summary: list[Part] = []
    sections: list[Section] = []
    steps: list[tuple[str, str]] = []
    if session is not None:
        summary.append(Text(session_words(session), "lead"))
    if closed:
        report = closed_loop_report(closed, signals, truth)
        summary += closed_loop_words(report)
        summary.append(Figures(closed_loop_numbers(report)))
        sections += closed_loop_sections(report)
        steps += _after_closed_loop(report)
    for number, point in enumerate(others, start=1):
        summary += open_loop_words(point, signals)
        summary.append(Figures(open_loop_numbers(point)))
        sections += open_loop_sections(point, signals, truth, number)
        steps += _after_open_loop(point)
    details = _record_parts(result)
    if session is not None:
        sections[:0] = session_sections(session)
        details += _versions_parts(session)
    sections.append(Section("Records", details))
    sections.append(Section("What next", (Steps(tuple(steps)),)))
    name = ", ".join(result.points[0].records) if session is None else session.name
    return write_report(
        out_dir, f"Identification of {name}", [Section("Summary", tuple(summary)), *sections]
    )


def _signals(result: IdentificationResult) -> Signals:
    """Return names and units; wrenches that are called like the axes they act on get a tau."""
    s = result.signals
    inputs = s.input_names
    if inputs == s.output_names:
        inputs = tuple(f"tau_{name}" for name in inputs)
    return Signals(inputs, s.input_units, s.output_names, s.output_units)


def _after_closed_loop(report: ClosedLoopReport) -> list[tuple[str, str]]:
    """Return what to do next, most urgent first."""
    steps = []
    orders = {point.order.order for point in report.points}
    if len(orders) > 1:
        steps.append(
            (
                f"The beam positions show {listed([str(n) for n in sorted(orders)])} main states: "
                "look at the singular values, and choose one order for all if the noise decides.",
                "",
            )
        )
    for name in report.ratios:
        decibel, degree = report.largest(name)
        if decibel <= report.bounds.decibel and degree <= report.bounds.degree:
            continue
        worst, path, label = max(
            (
                (w, report.signals.path(i, i), label)
                for label, position in zip(report.labels, report.worst(name), strict=True)
                for i, w in enumerate(position)
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
        steps.append(
            ("Read the remarks on the records: what they name is noise to a linear model.", "")
        )
    flight = " --virtual" if report.truth else ""
    if report.points[0].loop.Ts_s > _FAST_S:
        steps.append(
            (
                "Fly the same at 10 kHz, as the paper did, with about the same result.",
                f"levid excite config/sessions/white-noise-10khz.yaml{flight} --out out/10khz",
            )
        )
    steps.append(
        (
            "Let the beam move and see what that does to the platform: the paper's Fig. 14.",
            f"levid excite config/sessions/beam.yaml{flight} --out out/beam",
        )
    )
    return steps


def _after_open_loop(point: OpenLoopPoint) -> list[tuple[str, str]]:
    poor = [h for h in point.holdout if np.nanmin(h.simulated_fit_percent) < _POOR_FIT_PERCENT]
    if poor:
        return [
            (
                "The simulated fit leaves much unexplained: a longer record, or inputs that move "
                "more at the frequencies where the band is wide, would tell noise from dynamics.",
                "",
            )
        ]
    what = "Use the model: its matrices are in the JSON of the same command."
    return [(what, "levid identify LOG --out DIR --json")]


def _record_parts(result: IdentificationResult) -> tuple[Part, ...]:
    rows = []
    for point in result.points:
        where = "—" if point.beam_m is None else f"{signed(1e3 * point.beam_m, 1)} mm"
        for record in point.records:
            own = [r.removeprefix(f"{record}: ") for r in point.remarks if r.startswith(record)]
            rows.append((record, where, "; ".join(own) or "—"))
    parts: list[Part] = [
        Table("Records that were identified", ("record", "beam", "remarks"), tuple(rows), 3)
    ]
    if result.skipped:
        skipped = tuple(_log_and_reason(text) for text in result.skipped)
        parts.append(Table("Logs left out", ("log", "reason"), skipped, 2))
    return tuple(parts)


def _log_and_reason(text: str) -> tuple[str, str]:
    log, _, reason = text.partition(": ")
    return log, reason


def _versions_parts(session: Session) -> tuple[Part, ...]:
    rows = tuple(sorted(session.versions.items()))
    return (Table("Versions that wrote the logs", ("what", "version"), rows, 2),) if rows else ()
