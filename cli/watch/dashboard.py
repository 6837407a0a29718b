"""Lay out the full screen: what fits beside each other, and what is shown shorter or left out."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import chain

from ..readable_values import duration
from . import panels
from .styled_lines import Line, fit, side_by_side, title, width_of, wrap
from .view import Status, View

_TWO_COLUMNS, _THREE_COLUMNS = 70, 120
"""Widths from which panels stand beside each other."""
_LEAST_EVENTS = 2
"""Lines for which a longer form of coils and gaps is given up: a heading and an event."""
_LEAST_CHARTS = 9
_SILENT_S = 3.0
_KEYS = (("s", "STOP"), ("l", "land"), ("c", "clear"), ("?", "help"), ("q", "quit"))
_QUESTIONS = {
    "land": "Land now? The platform descends onto its stops; a session ends early.",
    "clear": "Clear the fault? Its cause must be removed; drives may move to home.",
}
_HELP = (
    ("s", "stop: zero force at once, without a question; the platform drops onto its stops"),
    ("l", "land: the platform descends onto its stops; a session ends early; asks first"),
    ("c", "clear a fault after its cause is removed; opens buses, may home drives; asks first"),
    ("?", "show or leave this page; all other keys work here, too"),
    ("q", "quit this screen; the daemon and the flight go on"),
)
_READING = (
    "A bar is full at the limit; beyond it a bar ends in ! and is red. Yellow: 80 % of the limit.",
    "coils: force commanded in the newest cycle; rms: long-term RMS of this force, which heats the "
    "coil. gap: height at a sensor above the working point.",
    "Values have the digits that their noise supports. lateness: start of a cycle after its "
    "deadline; p99: 99 of 100 cycles since the daemon's start were below it.",
    "Times of events are local. A fault is explained in docs/daemon.md.",
)


def draw(view: View, width: int, height: int) -> list[Line]:
    """Return the whole screen, `height` lines of `width` cells."""
    room = max(height - 2, 0)
    if view.help:
        body = _help(width)
    elif view.status is None or view.problem:
        body = _no_connection(view, width, room)
    else:
        body = _body(view, view.status, width, room)
    body = [*body[:room], *([[]] * (room - len(body)))]
    lines = [_header(view, width), *body, _footer(view, width)]
    return [fit(line, width) for line in lines[-height:]]


def _body(view: View, status: Status, width: int, height: int) -> list[Line]:
    state = panels.state_panel(status, width, max(height // 2, 2))
    room = height - len(state)
    if width >= _THREE_COLUMNS:
        return state + _three_columns(view, status, width, room)
    if width >= _TWO_COLUMNS:
        return state + _two_columns(view, status, width, room)
    return state + _one_column(view, status, width, room)


def _three_columns(view: View, status: Status, width: int, height: int) -> list[Line]:
    third = (width - 4) // 3
    last = width - 4 - 2 * third
    left = [
        *panels.pose_panel(view, status, third),
        *panels.timing_panel(status, third),
        *panels.recorder_panel(view, status, third),
    ]
    coils, gaps = (
        panels.coils_panel(view, status, third),
        panels.gaps_panel(view, status, last),
    )
    if max(len(coils), len(gaps)) > max(len(left), height - _LEAST_EVENTS):
        coils, gaps = panels.channels_as_numbers(view, status, third)
    top = side_by_side([(left, third), (coils, third), (gaps, last)])
    return top + _charts_and_events(view, status, width, height - len(top), 2 * third + 2)


def _two_columns(view: View, status: Status, width: int, height: int) -> list[Line]:
    half = (width - 2) // 2
    other = width - 2 - half
    right = [
        *panels.timing_panel(status, other, brief=True),
        *panels.recorder_panel(view, status, other, brief=True),
    ]
    top = side_by_side([(panels.pose_panel(view, status, half), half), (right, other)])
    forms: Sequence[Callable[[], list[Line]]] = (
        lambda: side_by_side(
            [
                (panels.coils_panel(view, status, half), half),
                (panels.gaps_panel(view, status, other), other),
            ]
        ),
        lambda: _in_two(panels.channels_as_numbers(view, status, half), half, other),
        lambda: panels.channels_in_short(view, status, width),
    )
    channels = _longest_that_fits(forms, height - len(top) - _LEAST_EVENTS)
    used = len(top) + len(channels)
    return [
        *top,
        *channels,
        *_charts_and_events(view, status, width, height - used, half),
    ]


def _one_column(view: View, status: Status, width: int, height: int) -> list[Line]:
    pose, timing = panels.pose_panel(view, status, width), panels.timing_panel(status, width)
    forms: Sequence[Callable[[], list[Line]]] = (
        lambda: [*panels.coils_panel(view, status, width), *panels.gaps_panel(view, status, width)],
        lambda: [*chain(*panels.channels_as_numbers(view, status, width))],
        lambda: panels.channels_in_short(view, status, width),
    )
    recorder = panels.recorder_panel(view, status, width)
    lines = pose + _longest_that_fits(forms, height - len(pose) - len(timing))
    for panel in (timing, recorder):
        if len(lines) + len(panel) <= height:
            lines = lines + panel
    return lines + panels.events_panel(view, width, height - len(lines))


def _charts_and_events(
    view: View, status: Status, width: int, height: int, left: int
) -> list[Line]:
    """Return charts of recent values with the events beside them, or events alone."""
    if height < _LEAST_CHARTS:
        return panels.events_panel(view, width, height)
    right = width - 2 - left
    return side_by_side(
        [
            (panels.history_panel(view, status, left, height), left),
            (panels.events_panel(view, right, height), right),
        ]
    )


def _longest_that_fits(forms: Sequence[Callable[[], list[Line]]], height: int) -> list[Line]:
    for form in forms[:-1]:
        lines = form()
        if len(lines) <= height:
            return lines
    return forms[-1]()


def _in_two(panels_: tuple[list[Line], list[Line]], half: int, other: int) -> list[Line]:
    return side_by_side([(panels_[0], half), (panels_[1], other)])


def _header(view: View, width: int) -> Line:
    status = view.status
    line: Line = [("levid watch", "bold")]
    if status is not None:
        line.append((f"  {status['rig']} at {status['rate_hz']:g} Hz", ""))
    right, style = time.strftime("%H:%M:%S"), "dim"
    if view.problem:
        right, style = " NOT CONNECTED, reconnecting ", "alarm"
    elif status is not None and view.silent_s > _SILENT_S:
        right, style = f" NO ANSWER for {duration(view.silent_s)} ", "alarm"
    line = fit(line, max(width - len(right), 0))
    return [*line, (right, style)]


def _footer(view: View, width: int) -> Line:
    if view.asking:
        answers: Line = [(" y ", "key"), (" yes  ", ""), (" n ", "key"), (" no", "")]
        question = fit(
            [(_QUESTIONS[view.asking], "warning")], max(width - width_of(answers) - 1, 0)
        )
        return [*question, (" ", ""), *answers]
    text, style = view.message
    keys: Line = []
    for key, meaning in _KEYS:
        keys += [(f" {key} ", "key"), (f" {meaning}  ", "bad" if key == "s" else "")]
    if width_of(keys) + len(text) > width:
        keys = keys[:2]
    return [*keys, (text, style)]


def _no_connection(view: View, width: int, height: int) -> list[Line]:
    if not view.problem:
        return [[("connecting to the daemon ...", "")]]
    lines = [
        *wrap(view.problem, width, "bad"),
        *wrap("Trying again every second. Without the daemon, no key can stop the rig.", width),
        [],
    ]
    return lines + panels.events_panel(view, width, height - len(lines))


def _help(width: int) -> list[Line]:
    lines = [title("keys", width)]
    for key, meaning in _HELP:
        first, *rest = wrap(meaning, width - 5)
        lines.append([(f" {key} ", "key"), ("  ", ""), *first])
        lines += [[("     ", ""), *line] for line in rest]
    lines.append(title("how to read the screen", width))
    for text in _READING:
        lines += wrap(text, width)
    return lines
