"""Write the report on a flown session."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...config.command_line import command_line
from ...daemon.control.states import State
from ..plotting.figure_to_svg import Picture, to_svg
from ..plotting.html_page import (
    Figures,
    Next,
    Number,
    Part,
    Section,
    Table,
    Text,
    Verdict,
    write_report,
)
from ..plotting.labelled_frequency_responses import symbol
from ..plotting.min_max_bins import all_samples
from ..plotting.number_format import amount
from ..plotting.style import signed
from .cycle_times import quantile_s, timing_histogram
from .flight_data import Session, StepFlown, read_session
from .pose_during_beam_moves import beam_trajectory
from .time_plot import session_plot

_COIL = "coil:"
_MOST_FIGURES = 6
"""Largest number of records with a figure of the moving beam; the table has all records."""
_NEAR = 0.8
"""Share of the gap limit above which the next flight may exceed the limit."""
_TAKING_OFF = (
    " Lift-off from the stops and landing on them, some 0.9 mm away, are outside the plotted range."
)


def session_report(log_paths: Sequence[Path], out_dir: Path, *, full: bool = False) -> Path:
    """Write the report on a session from its logs, one per step; return the page's path.

    The page has at most MOST_BYTES, and its charts minima and maxima of bins in long sessions;
    `full` embeds every sample.

    Raises:
        LogError: a log cannot be read.
        ValueError: no log was given.
        OSError: the page cannot be written.
    """
    with all_samples(full):
        return _session_page(read_session(log_paths), out_dir)


def _session_page(session: Session, out_dir: Path) -> Path:
    folder = session.steps[0].path.parent
    next_step = ("Fly a session that excites every input, then identify it.", "")
    if any(step.excited for step in session.steps):
        logs = sorted(folder.glob("*.mcap"))
        command = command_line("identify", logs=logs, out=folder / "identification")
        next_step = ("Identify the plant from the records.", command)
    words = f"{session_words(session)} {_verdict(session)}".rstrip()
    summary = (Text(words, "lead"), Next(*next_step), Figures(session_numbers(session)))
    sections = (Section("Summary", summary), *session_sections(session))
    return write_report(out_dir, f"Session '{session.name}'", sections)


def session_words(session: Session) -> str:
    """Return a summary of the flight in one or two sentences."""
    records = [step for step in session.steps if step.kind == "record"]
    if all(span.state is None for span in session.spans):
        return f"{_count(len(session.steps), 'log')} of measured data."
    steps = _count(len(session.steps), "step") + f", {len(records)} of them records"
    if len(records) == len(session.steps):
        steps = _count(len(records), "record")
    text = f"A flight of {session.duration_s:.0f} s at {session.rate_hz:g} Hz: {steps}."
    inputs = dict.fromkeys(_input_name(name) for step in records for name in step.excited)
    if inputs:
        names = listed(list(inputs))
        turn = " in turn" if all(len(step.excited) <= 1 for step in records) else ""
        text += f" The session excited {names}{turn}"
        beams = sorted({round(1e3 * step.beam_m[1]) for step in records if step.beam_m})
        if beams:
            text += f", with the beam at {listed([signed(b, 0) for b in beams])} mm"
        text += "."
    return text


def _verdict(session: Session) -> str:
    """Return whether the records of a flight are complete and undisturbed; empty without any."""
    records = [step for step in session.steps if step.kind == "record"]
    if not records or all(span.state is None for span in session.spans):
        return ""
    doubtful = [step.name for step in records if step.remarks]
    if doubtful:
        return f"See the remarks on {listed(doubtful)} before you use these records."
    return "The records are good: complete, no fault, no coil at its limit, no cycle missed."


def listed(words: Sequence[str]) -> str:
    """Return words as a list in a sentence, such as 'a, b and c'."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def session_numbers(session: Session) -> tuple[Number, ...]:
    """Return the numbers of the session's summary."""
    numbers = [Number(f"{session.duration_s:.0f} s", f"flown at {session.rate_hz:g} Hz")]
    peaks = [s.peak_gap_m for s in session.steps if s.kind == "record" and s.peak_gap_m is not None]
    if peaks:
        numbers.append(_farthest(max(peaks), session.gap_limit_m))
    saturated = sum(step.saturated for step in session.steps if step.kind == "record")
    skipped = sum(step.skipped for step in session.steps)
    numbers.append(
        Number(str(saturated), "cycles with a coil at its force limit", _zero_is_good(saturated))
    )
    numbers.append(Number(str(skipped), "control cycles missed", _zero_is_good(skipped)))
    return tuple(numbers)


def _farthest(peak_m: float, limit_m: float | None) -> Number:
    value, words = amount(peak_m, "m"), "largest reading of a gap sensor in a record"
    if limit_m is None:
        return Number(value, words)
    near = peak_m > _NEAR * limit_m
    return Number(value, f"{words}; limit {amount(limit_m, 'm')}", "bad" if near else "good")


def session_sections(session: Session) -> tuple[Section, ...]:
    """Return the sections of a session: flight; moving beam and timing if logged."""
    flown: list[Part] = []
    if session.signals:
        flown.append(
            Picture(
                "session",
                to_svg(session_plot(session)),
                f"Time plots of the session over {session.duration_s:.0f} s: states, pose, beam, "
                "coil forces and excitation.",
                "The whole session. The bar on top shows the loop's state and the names of the "
                "records. Excitation played, or the beam moved, in the shaded parts. Signals are "
                "bands from minimum to maximum."
                + (_TAKING_OFF if any(s.state == State.IDLE for s in session.spans) else ""),
            )
        )
    flown.append(_steps_table(session.steps))
    sections = [Section("What was flown", tuple(flown))]
    if session.beam_records:
        sections.append(Section("The moving beam", tuple(_beam_pictures(session))))
    if session.timing is not None:
        t = session.timing
        median, late = (quantile_s(t.lateness, t.edges_s, share) for share in (0.5, 0.999))
        sections.append(
            Section(
                "Timing",
                (
                    Picture(
                        "timing",
                        to_svg(timing_histogram(t)),
                        "Histograms of lateness and of execution time of all cycles.",
                        "Lateness and execution time of all cycles. Half of the cycles began "
                        f"within {1e6 * median:.0f} µs of their deadline, 99.9 % within "
                        f"{1e6 * late:.0f} µs.",
                    ),
                ),
            )
        )
    return tuple(sections)


def _beam_pictures(session: Session) -> list[Picture]:
    pictures = []
    shown = list(session.beam_records.items())[:_MOST_FIGURES]
    for number, (name, record) in enumerate(shown):
        theta, z = (float(np.ptp(x)) for x in (record.theta_rad, record.z_m))
        pictures.append(
            Picture(
                f"beam-{number + 1}",
                to_svg(beam_trajectory(record)),
                f"Beam position, tilt theta and height z over time in record {name}.",
                f"Record {name}: only the moving beam excites the platform. Its weight and "
                f"acceleration move θ over {1e6 * theta:.0f} µrad and z over {1e6 * z:.1f} µm.",
                "" if number else "Fig. 14",
            )
        )
    return pictures


def _steps_table(steps: Sequence[StepFlown]) -> Table:
    rows = tuple(
        (
            step.name,
            step.kind,
            _excitation(step),
            "; ".join(step.remarks) or "—",
            f"{step.start_s:.1f}",
            f"{step.end_s - step.start_s:.1f}",
            _beam(step),
            _peak(step),
        )
        for step in steps
    )
    head = ("step", "kind", "excitation", "remarks", "start s", "length s", "beam mm", "peak mm")
    return Table(
        "Steps, one log each; peak: largest displacement of a corner", head, rows, labels=4
    )


def _excitation(step: StepFlown) -> str:
    words = []
    levels = dict(zip(step.excited, step.excitation_rms, strict=True))
    coils = {name: rms for name, rms in levels.items() if name.startswith(_COIL)}
    for name, rms in levels.items():
        if name not in coils or len(coils) == 1:
            unit = "N m" if name.endswith("n_m") else "N"
            words.append(f"{_input_name(name)} {rms:.3g} {unit}")
    if len(coils) > 1:
        words.append(f"{len(coils)} coils, {max(coils.values()):.3g} N at most")
    return ", ".join(words) or "—"


def _input_name(field: str) -> str:
    if field.startswith(_COIL):
        return "coils one by one"
    return symbol(field.removeprefix("v_").split("_")[0])


def _beam(step: StepFlown) -> str:
    if step.beam_m is None:
        return "—"
    start, end, low, high = (1e3 * x for x in step.beam_m)
    if high - low < 1.0:
        return signed(end, 1)
    if step.kind == "record":
        return f"{signed(low, 0)} to {signed(high, 0)}"
    return f"{signed(start, 0)} → {signed(end, 0)}"


def _peak(step: StepFlown) -> str:
    # During lift-off and landing the peak only shows the end stops.
    if step.peak_gap_m is None or step.kind in ("levitate", "land"):
        return "—"
    return f"{1e3 * step.peak_gap_m:.3f}"


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")


def _zero_is_good(count: int) -> Verdict:
    return "good" if count == 0 else "bad"
