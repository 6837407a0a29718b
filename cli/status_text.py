"""Print the status of the daemon as text: `levid status`, and the lines of `levid watch`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from .readable_values import Scale, duration, scale_of

WIDTH = 80
_LABEL = 12
_COUNTERS = {
    "stale": "stale readings",
    "lost": "rows lost",
}
"""Counters that are printed if they are not zero."""

Status = Mapping[str, Any]
_RESOURCE_PROBLEMS = {
    "clients_gone": "{} clients disconnected in flight",
    "recorder_restarts": "recorder restarted {} times",
    "flooded_s": "socket flooded for {:g} s",
    "memory_stalled_s": "waited {:g} s for memory",
    "stolen_s": "host took {:g} s of CPU time",
}
"""Keys of the status that are shown if they are not zero."""


def status_lines(status: Status) -> Iterator[str]:
    """Yield the lines of `levid status`."""
    yield f"{status['rig']} at {status['rate_hz']:g} Hz: {activity(status)}"
    yield from fault_lines(status)
    counts = [f"{status[key]} {words}" for key, words in _COUNTERS.items() if status[key]]
    yield ", ".join([f"cycle {status['cycle']}", f"{status['late']} late", *counts])
    if "pose" in status:  # not from a daemon of an older version
        yield from _quantities([*status["pose"], *status["manipulator"]])
        yield from _channels(status)
    for quantity in ("lateness", "execution"):
        us = status["timing"][f"{quantity}_us"]
        percentiles = ", ".join(f"{name} {us[name]:.0f}" for name in ("p50", "p99", "p99.9", "max"))
        yield f"{quantity} in us: {percentiles}"
    if status["late"]:
        yield f"late: {late_causes(status)}"
    yield from resource_problems(status)
    for failed in (f for f in status["preflight"] if f["outcome"] == "failed"):
        yield f"not ready to lift off: {failed['check']}: {failed['found']}"
        yield f"  {failed['remedy']}"
    if status["recording"]:
        yield f"not recording: {status['recording']}"
    if status.get("log_lost"):
        yield f"log: {status['log_lost']}"
    if status["fault_log"]:
        yield f"last flight recording: {status['fault_log']}"


def watch_line(status: Status) -> str:
    """Return one line of at most WIDTH characters: cycle, late cycles, z, beam, activity."""
    z_m, beam_m = status["z_m"], status["beam_m"]
    position = "" if z_m is None else f"  z {1e6 * z_m:z6.1f} um"
    position += "" if beam_m is None else f"  beam {1e3 * beam_m:z6.2f} mm"
    stale = f"  {status['stale']} stale" if status["stale"] else ""
    counts = f"{status['cycle']:>9d} {status['late']:>4d} late{stale}"
    return shortened(f"{counts}{position}  {activity(status)}", WIDTH)


def activity(status: Status) -> str:
    """Return in a few words what the daemon does: its fault, its session or its state."""
    if status["fault"] != "NONE":
        detail = f" ({status['detail']})" if status["detail"] else ""
        return f"fault {status['fault']}{detail}"
    if status["session"]:
        left = f", {duration(status['left_s'])} left" if status.get("left_s") else ""
        return f"session {status['session']}, {status['step']}, {100 * status['share']:.0f} %{left}"
    if status["state"] == "IDLE":
        return f"idle, {force_at_rest(status)}"
    return str(status["state"]).lower().replace("_", "-")


def force_at_rest(status: Status) -> str:
    """Return in words whether the coils are at zero force, or only commanded to be."""
    zero = status.get("zero_force")  # not from a daemon of an older version
    if zero is None:
        return "zero force commanded"
    return "zero force" if zero["confirmed"] else f"zero force commanded; {zero['found']}"


def fault_lines(status: Status) -> Iterator[str]:
    """Yield cause and remedy of the present fault from the table of faults, if there is one."""
    from ..daemon.control.faults import FAULTS, Fault

    name = status["fault"]
    if name == "NONE" or name not in Fault.__members__:
        return
    text = FAULTS[Fault[name]]
    yield f"  cause: {text.cause}"
    yield f"  check: {text.check}"
    yield f"  then:  {text.cleared}"
    yield f"  coils: {force_at_rest(status)}"


def late_causes(status: Status) -> str:
    """Return the late cycles by cause."""
    causes = status["timing"]["late_by"].items()
    return ", ".join(f"{count} by {cause.replace('_', '-')}" for cause, count in causes)


def resource_problems(status: Status) -> Iterator[str]:
    """Yield a line for each resource problem and restart since the daemon's start."""
    for key, text in _RESOURCE_PROBLEMS.items():
        if status[key]:
            yield text.format(status[key])


def shortened(text: str, width: int) -> str:
    """Return a text of at most `width` characters; a cut end shows as "..."."""
    return text if len(text) <= width else f"{text[: max(width - 3, 0)]}..."


def _quantities(quantities: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a table of single quantities: value, unit, limit."""
    yield f"{'':{_LABEL}}{'value':>10} {'unit':5}{'limit':>8}"
    for quantity in quantities:
        scale = scale_of(quantity["unit"], quantity["noise"], quantity["limit"])
        value, limit = scale.text(quantity["value"]), scale.limit(quantity["limit"])
        yield f"{quantity['name']:{_LABEL}}{value:>10} {scale.unit:5}{limit:>8}"


def _channels(status: Status) -> Iterator[str]:
    """Yield tables of coils and sensors, one column for each."""
    coils, gaps = status["coils"], status["gaps"]
    force = rms = scale_of(coils["unit"], None, coils["limit"])  # a command has no noise
    gap = scale_of(gaps["unit"], gaps["noise"], gaps["limit"])
    yield from _table(
        "coil",
        [
            (f"force {force.unit}", coils["value"], force, coils["limit"]),
            (f"read {force.unit}", coils["readback"], force, None),
            (f"rms {rms.unit}", coils["rms"], rms, coils["rms_limit"]),
        ],
    )
    yield from _table("sensor", [(f"gap {gap.unit}", gaps["value"], gap, gaps["limit"])])


def _table(
    what: str, rows: Sequence[tuple[str, Sequence[float | None], Scale, float | None]]
) -> Iterator[str]:
    """Yield the rows with as many channels side by side as fit into WIDTH."""
    if not rows[0][1]:
        return
    texts = [[scale.text(value) for value in values] for _, values, scale, _ in rows]
    limits = [scale.limit(limit) for _, _, scale, limit in rows]
    cell = max(len(text) for row in texts for text in row) + 1
    at_once = max((WIDTH - _LABEL - 8) // cell, 1)
    for begin in range(0, len(texts[0]), at_once):
        part = range(begin, min(begin + at_once, len(texts[0])))
        yield f"{what:{_LABEL}}{''.join(f'{i:>{cell}}' for i in part)}{'limit':>8}"
        for (label, *_), row, limit in zip(rows, texts, limits, strict=True):
            yield f"{label:{_LABEL}}{''.join(f'{row[i]:>{cell}}' for i in part)}{limit:>8}"
