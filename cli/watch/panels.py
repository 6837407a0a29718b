"""Draw the panels of the full screen; each returns lines of at most the given width."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from ...daemon.control.faults import FAULTS, Fault
from ...daemon.control.states import IN_FLIGHT, State
from ..readable_values import Scale, duration
from ..status_text import resource_problems
from .bars import bar, chart, signed_bar, style_of
from .styled_lines import Line, fit, title, wrap
from .view import Status, View, in_flight

_STALE_S = 2.0
"""Age of the readings from which the screen says so."""
_FEW_EVENTS = 12
"""Height of the events below which each one is cut after two lines."""
_NAME, _VALUE, _UNIT, _LIMIT = 6, 9, 5, 6


def state_panel(status: Status, width: int, most: int) -> list[Line]:
    """Draw state, session and fault in at most `most` lines."""
    name = status["state"]
    state = State[name] if name in State.__members__ else None
    style = "alarm" if state is State.FAULT else "state"
    meaning = state.meaning if state is not None else ""
    if state in IN_FLIGHT:
        meaning = f"in flight: {meaning}"
    lines: list[Line] = [[(f" {name} ", style), (f" {meaning}", "")]]
    zero = status.get("zero_force")  # not from a daemon of an older version
    if zero is not None and state not in IN_FLIGHT:
        lines[0].append((f"; {zero['found']}", "" if zero["confirmed"] else "warning"))
    if status["fault"] != "NONE":
        return (lines + _fault(status, width))[:most]
    lines.append(_session(status, width))
    if in_flight(status):
        return lines[:most]
    for failed in (f for f in status["preflight"] if f["outcome"] == "failed"):
        text = f"not ready to lift off: {failed['check']}: {failed['found']}"
        lines += [[(text, "warning")], [(f"  {failed['remedy']}", "")]]
    return [fit(line, width) for line in lines[:most]]


def pose_panel(view: View, status: Status, width: int) -> list[Line]:
    """Draw the pose and the manipulator as bars against their limits."""
    old_s = view.without_cycle_s
    heading = "pose" if old_s < _STALE_S else f"pose, {duration(old_s)} old"
    flying = in_flight(status)
    heading += "" if flying else "; limits apply in flight"
    lines = [title(heading, width)]
    for quantity in (*status["pose"], *status["manipulator"]):
        value, limit = quantity["value"], quantity["limit"]
        scale = view.scale(quantity["name"], quantity["unit"], quantity["noise"], limit)
        part = None if value is None or not limit else value / limit
        beyond = flying and part is not None and abs(part) > 1.0
        style = "bad" if beyond else "bold"
        fixed = _NAME + _VALUE + _UNIT + 3
        line: Line = [
            (f"{quantity['name'][:_NAME]:{_NAME}}", ""),
            (f"{scale.text(value):>{_VALUE}}", style),
            (f" {scale.unit:{_UNIT}}", "dim"),
        ]
        line += signed_bar(part, width - fixed - _LIMIT + 1, flying)
        line.append((f" {'±' + scale.limit(limit) if limit else '':>{_LIMIT - 1}}", "dim"))
        lines.append(line)
    return lines


def coils_panel(view: View, status: Status, width: int) -> list[Line]:
    """Draw the force of each coil and its long-term RMS, which heats it, against their limits."""
    coils = status["coils"]
    force, rms = _coil_scales(view, coils)
    limit, rms_limit = coils["limit"], coils["rms_limit"]
    heat = f", rms {rms.limit(rms_limit)}" if rms_limit else ""
    lines = [title(f"coils in {force.unit}: limit ±{force.limit(limit)}{heat}", width)]
    room = width - 3 - 8 - 1 - 5 - 6
    heat_room = room * 2 // 5 if rms_limit else 0
    for index, (value, root) in enumerate(zip(coils["value"], coils["rms"], strict=True)):
        part = None if value is None else abs(value) / limit
        line: Line = [(f"{index:>2} ", "dim"), (f"{force.text(value):>7} ", _emphasis(part))]
        line += bar(part, room - heat_room)
        line += [(" rms", "dim"), (f"{rms.text(root):>6} ", "")]
        if rms_limit:
            line += bar(None if root is None else root / rms_limit, heat_room)
        lines.append(line)
    return lines


def gaps_panel(view: View, status: Status, width: int) -> list[Line]:
    """Draw the gap of each sensor against its limit."""
    gaps = status["gaps"]
    scale = view.scale("gap", gaps["unit"], gaps["noise"], gaps["limit"])
    heading = f"sensors, gap in {scale.unit}: limit ±{scale.limit(gaps['limit'])}"
    lines, flying = [title(heading, width)], in_flight(status)
    for index, value in enumerate(gaps["value"]):
        part = None if value is None else value / gaps["limit"]
        style = _emphasis(part, flying)
        line: Line = [(f"{index:>2} ", "dim"), (f"{scale.text(value):>8} ", style)]
        lines.append(line + signed_bar(part, width - 12, flying))
    return lines


def channels_as_numbers(view: View, status: Status, width: int) -> tuple[list[Line], list[Line]]:
    """Draw coils and gaps as numbers, several in a line: where bars have no room."""
    coils, gaps = status["coils"], status["gaps"]
    force, rms = _coil_scales(view, coils)
    gap = view.scale("gap", gaps["unit"], gaps["noise"], gaps["limit"])
    heat = f", rms to {_largest(rms, coils['rms'])} of {rms.limit(coils['rms_limit'])}"
    heading = f"coils {force.unit}, of ±{force.limit(coils['limit'])}"
    return (
        [
            title(heading + (heat if coils["rms_limit"] else ""), width),
            *_numbers(coils["value"], force, coils["limit"], width),
        ],
        [
            title(f"gaps {gap.unit}, of ±{gap.limit(gaps['limit'])}", width),
            *_numbers(gaps["value"], gap, gaps["limit"], width, in_flight(status)),
        ],
    )


def channels_in_short(view: View, status: Status, width: int) -> list[Line]:
    """Draw the largest coil force, RMS and gap, a line each: where there is room for no more."""
    coils, gaps = status["coils"], status["gaps"]
    force, rms = _coil_scales(view, coils)
    gap = view.scale("gap", gaps["unit"], gaps["noise"], gaps["limit"])
    rows = [
        ("coil", coils["value"], force, coils["limit"]),
        ("rms", coils["rms"], rms, coils["rms_limit"]),
        ("gap", gaps["value"], gap, gaps["limit"]),
    ]
    lines: list[Line] = []
    for name, values, scale, limit in rows:
        known = [(abs(value), i) for i, value in enumerate(values) if value is not None]
        if not known:
            continue
        largest, index = max(known)
        applies = name != "gap" or in_flight(status)
        style = style_of(largest / limit, applies) if limit else ""
        text = f"{scale.text(values[index])} {scale.unit}"
        of = f" of {scale.limit(limit)}" if limit else ""
        lines.append([(f"largest {name:5}", ""), (text, style), (f"{of}, number {index}", "dim")])
    return [fit(line, width) for line in lines]


def timing_panel(status: Status, width: int, brief: bool = False) -> list[Line]:
    """Draw lateness, execution time and late cycles; `brief` leaves out causes."""
    timing = status["timing"]
    columns = "".join(f"{name:>8}" for name in ("last", "p99", "max"))
    lines = [title(f"{'timing us':10}{columns}", width)]
    for name in ("lateness", "execution"):
        us, last = timing[f"{name}_us"], timing["last"][f"{name}_us"]
        shown = "-" if last is None else f"{last:.0f}"
        lines.append([(f"{name:10}{shown:>8}{us['p99']:>8.0f}{us['max']:>8.0f}", "")])
    late, cycle = status["late"], status["cycle"]
    lines.append([(f"late cycles {late} of {cycle}", "warning" if late else "")])
    if late and not brief:
        causes = timing["late_by"].items()
        by = ", ".join(f"{name.replace('_', '-')} {count}" for name, count in causes if count)
        lines.append([(f"late by {by}", "dim")])
    if status["stale"]:
        lines.append([(f"stale readings in {status['stale']} cycles", "warning")])
    return [fit(line, width) for line in lines]


def recorder_panel(view: View, status: Status, width: int, brief: bool = False) -> list[Line]:
    """Draw the recorder, the disk and resource problems; `brief` takes one line if all is well."""
    lines = [title("recorder", width)]
    free = "" if view.free_bytes is None else f"{view.free_bytes * 1e-9:.1f} GB free"
    now: Line = [("writing ", ""), (Path(status["log"]).name, "bold")]
    if not status["log"]:
        now = [("no log", "dim")]
    if status["recording"]:
        lines += wrap(f"not recording: {status['recording']}", width, "bad", 2, 2)
    else:
        lines.append([*now, (f", {free}" if brief and free else "", "")])
    if status.get("log_lost"):
        lines += wrap(f"log: {status['log_lost']}", width, "bad", 2, 2)
    if free and (not brief or status["recording"]):
        text = f"disk {free} in "
        lines.append([(text, ""), (_end_of(status["log_folder"], width - len(text)), "dim")])
    if status["lost"]:
        lines.append([(f"{status['lost']} rows lost", "bad")])
    lines += [[(text, "warning")] for text in resource_problems(status)]
    return [fit(line, width) for line in lines]


def history_panel(view: View, status: Status, width: int, height: int) -> list[Line]:
    """Draw a chart of the last ranges of each DOF; together `height` lines."""
    quantities = status["pose"]
    rows = height // max(len(quantities), 1) - 1
    if rows < 1 or not view.begun_s:
        return []
    begun_s = list(view.begun_s)[-2 * width :]
    lines: list[Line] = []
    for quantity in quantities:
        name = quantity["name"]
        scale = view.scale(name, quantity["unit"], quantity["noise"], quantity["limit"])
        ranges = list(view.history.get(name, ()))[-2 * width :]
        known = [value for pair in ranges if pair is not None for value in pair]
        span = ""
        if known:
            low, high = scale.text(min(known)), scale.text(max(known))
            span = f" {low} to {high} {scale.unit}, last {duration(view.heard_s - begun_s[0])}"
        lines.append(title(f"{name}{span}", width))
        drawn_s, drawn = view.charts.get((name, width, rows), (0.0, []))
        if drawn_s != begun_s[-1]:
            drawn = chart(ranges, width, rows)
            view.charts[name, width, rows] = begun_s[-1], drawn
        lines += [[(row, "good")] for row in drawn]
    return lines


def events_panel(view: View, width: int, height: int) -> list[Line]:
    """Draw the newest events, in `height` lines."""
    if height < 2:
        return []
    lines: list[Line] = []
    for at_s, text in reversed(view.events()):
        clock = time.strftime("%H:%M:%S", time.localtime(at_s))
        style = "bad" if text.startswith("fault ") and text != "fault cleared" else ""
        room = height - 1 - len(lines)
        most = min(room, 2) if height < _FEW_EVENTS else room
        wrapped = wrap(text, width - 9, style, most=most)
        if lines and len(wrapped) > room:
            break
        event: list[Line] = [[(f"{clock} ", "dim"), *wrapped[0]]]
        event += [[(" " * 9, ""), *line] for line in wrapped[1:]]
        lines = event + lines
        if len(lines) >= height - 1:
            break
    return [title("events", width), *lines]


def _session(status: Status, width: int) -> Line:
    if not status["session"]:
        return [("no session", "dim")]
    share = status["share"] or 0.0
    text = f"session {status['session']}"
    text += f", step {status['step']}" if status["step"] else ""
    left = f" {100 * share:3.0f} %"
    left += f", {duration(status['left_s'])} left" if status["left_s"] else ""
    room = min(width - len(text) - len(left) - 1, 40)
    done: Line = []
    if room >= 8:
        full = round(share * room)
        done = [(" ", ""), ("█" * full, "good"), ("·" * (room - full), "dim")]
    return [(text, "bold"), *done, (left, "")]


def _fault(status: Status, width: int) -> list[Line]:
    """Return name, detail, cause and remedy of a fault, from the table of faults."""
    name = status["fault"]
    detail = f": {status['detail']}" if status["detail"] else ""
    lines = wrap(f"FAULT {name}{detail}", width, "alarm", 0, 2)
    if name in Fault.__members__:
        text = FAULTS[Fault[name]]
        lines += wrap(f"cause: {text.cause}", width, "bad", 7)
        lines += wrap(f"check: {text.check}", width, "", 7)
        lines += wrap(f"then:  {text.cleared} (key c)", width, "", 7)
    if status["fault_log"]:
        lines.append([(f"flight recording: {status['fault_log']}", "dim")])
    return lines


def _coil_scales(view: View, coils: Status) -> tuple[Scale, Scale]:
    limit = coils["limit"]
    return (
        view.scale("coil", coils["unit"], 1e-3 * limit, limit),
        view.scale("rms", coils["unit"], 1e-3 * limit, limit),
    )


def _numbers(
    values: Sequence[float | None], scale: Scale, limit: float, width: int, applies: bool = True
) -> list[Line]:
    texts = [scale.text(value) for value in values]
    cell = max((len(text) for text in texts), default=0) + 5
    at_once = max(width // cell, 1)
    lines: list[Line] = []
    for begin in range(0, len(texts), at_once):
        line: Line = []
        for index in range(begin, min(begin + at_once, len(texts))):
            value = values[index]
            part = None if value is None else abs(value) / limit
            line += [
                (f"{index:>2} ", "dim"),
                (f"{texts[index]:>{cell - 5}}", _emphasis(part, applies)),
            ]
            line.append(("  ", ""))
        lines.append(line)
    return lines


def _largest(scale: Scale, values: Sequence[float | None]) -> str:
    return scale.text(max((value for value in values if value is not None), default=None))


def _emphasis(part: float | None, applies: bool = True) -> str:
    return "" if part is None else style_of(abs(part), applies).replace("good", "")


def _end_of(path: str, width: int) -> str:
    """Return the end of a path that is too long."""
    return path if len(path) <= width else f"…{path[len(path) - width + 1 :]}"
