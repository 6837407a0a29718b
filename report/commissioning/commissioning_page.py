"""Write the page of a commissioning, the answer first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ...config.command_line import command_line
from ...config.rig import RigConfig
from ...daemon.commissioning.commission import Commissioned
from ...daemon.commissioning.corrections import (
    coil_scale,
    common_scale,
    corrections,
    problems,
    remarks,
    sensor_scale,
)
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
from .platform_drawing import Drawn, platform_drawing


def commissioning_report(
    found: Commissioned, rig: RigConfig, written: Path | None, out_dir: Path
) -> Path:
    """Write what was found of every channel of a rig to `out_dir`; return the page's path.

    written: the corrected copy of RIG.yaml, None if channels have to be repaired first.
    """
    wrong, corrected = problems(found), corrections(found)
    return write_report(
        out_dir,
        f"Commissioning of rig '{rig.name}'",
        [
            Section("Result", tuple(_result(found, rig, wrong, corrected, written))),
            Section("Channels", tuple(_channels(found, rig))),
        ],
    )


def _result(
    found: Commissioned,
    rig: RigConfig,
    wrong: Sequence[str],
    corrected: Sequence[str],
    written: Path | None,
) -> list[Part]:
    late = found.height_delay
    if wrong:
        lead = f"{_count(len(wrong), 'channel')} must be repaired before this rig can fly."
    elif corrected:
        copy = "a copy of RIG.yaml" if written is None else f"{written.name}, a copy of RIG.yaml"
        lead = (
            f"This rig can fly with {copy} with {_count(len(corrected), 'correction')}. Nothing "
            "has to be rewired."
        )
    else:
        lead = "All channels are as RIG.yaml says."
    steps = _steps(written)
    parts: list[Part] = [
        Text(lead, "lead"),
        Next(*steps[0]),
        Figures(
            (
                Number(str(len(wrong)), "channels to repair", "bad" if wrong else "good"),
                Number(str(len(corrected)), "corrections in the copy of RIG.yaml"),
                Number(f"{found.largest_n:.3g} N", "largest force that a coil was asked for"),
                Number(
                    f"{found.delay_cycles} cycles" if found.delay_cycles >= 0 else "unknown",
                    "delay from a command to its measured force",
                ),
                Number(
                    f"{1e3 * late.mean_s:.3g} ± {2e3 * late.sd_s:.1g} ms",
                    "delay from a command to the heights",
                ),
                *(
                    [
                        Number(
                            _ms(found.beam_delay.mean_s),
                            "delay from the beam's setpoint to its place",
                        )
                    ]
                    if found.beam_delay is not None
                    else []
                ),
            )
        ),
    ]
    done = "found" if written is None else "corrected"
    rows = (
        *(("problem", line) for line in wrong),
        *((done, line) for line in corrected),
        *(("remark", line) for line in remarks(found, rig)),
    )
    if rows:
        parts.append(Table("What differs from RIG.yaml", ("state", "finding"), rows, labels=2))
    parts.append(Steps(steps))
    return parts


def _steps(written: Path | None) -> tuple[tuple[str, str], ...]:
    """Return the next steps with the corrected copy of RIG.yaml; None: there is none yet."""
    if written is None:
        return (("Repair these channels, and commission again", ""),)
    first = written.with_stem(f"{written.stem}-first-lift")
    lift, land = (command_line(verb, rig=first) for verb in ("levitate", "land"))
    return (
        ("Check the corrected rig and what the daemon asks before a lift-off",
         f"{command_line('check', written)} && {command_line('check', written, preflight=True)}"),
        ("Start the daemon with tight limits", command_line("run", first)),
        ("Lift off for the first time, then land", f"{lift} && {land}"),
        ("From then on", command_line("run", written)),
    )  # fmt: skip


def _channels(found: Commissioned, rig: RigConfig) -> list[Text | Table | Picture]:
    sensors, coils = _drawn_sensors(found, rig), _drawn_coils(found, rig)
    picture = Picture(
        "platform",
        to_svg(platform_drawing(sensors, coils)),
        "The platform from above with the number of the channel that was found at each place.",
        "The platform from above: the number of the channel that was found at each place. Dead "
        "channels stand at places where no other one was found.",
    )
    at_rest, scale = found.resting, found.sensors.scale / common_scale(found)
    sensor_rows = tuple(
        (
            str(i),
            _place(found.sensors.place[i], i),
            f"{scale[i]:.3g}" if scale[i] else "-",
            "end of range" if at_rest.clipped[i] else f"{1e6 * at_rest.sd_m[i]:.3g}",
            f"{1e6 * at_rest.mains_m[i]:.3g}" if at_rest.mains_m[i] else "-",
        )
        for i in range(len(sensors))
    )
    coil_rows = tuple(
        (
            str(i),
            _place(found.coils.place[i], i),
            f"{found.coils.gain[i]:.3g}" if found.coils.gain[i] else "-",
        )
        for i in range(len(coils))
    )
    mains = f" {at_rest.mains_hz:g} Hz" if at_rest.mains_hz else ""
    return [
        picture,
        Table(
            "Sensors: a scale is the reading over the true height",
            ("channel", "place in RIG.yaml", "scale", "noise in um", f"mains{mains} in um"),
            sensor_rows,
            labels=2,
        ),
        Table(
            "Coils: a gain is the force over the command, relative to the median",
            ("channel", "place in RIG.yaml", "gain"),
            coil_rows,
            labels=2,
        ),
        Text(
            "A common error of all sensors is not told from an error of the stroke, one of all "
            "coils not from an error of the weight.",
            "note",
        ),
    ]


def _drawn_sensors(found: Commissioned, rig: RigConfig) -> list[Drawn]:
    return _drawn(
        found.sensors.place.tolist(),
        sensor_scale(found),
        found.sensors.doubtful.tolist(),
        rig.geometry.sensors_x_m,
        rig.geometry.sensors_y_m,
    )


def _drawn_coils(found: Commissioned, rig: RigConfig) -> list[Drawn]:
    return _drawn(
        found.coils.place.tolist(),
        coil_scale(found),
        found.coils.doubtful.tolist(),
        rig.geometry.coil_x_m,
        rig.geometry.coil_y_m,
    )


def _drawn(
    place: Sequence[int],
    scale: Sequence[float],
    doubtful: Sequence[bool],
    x_m: Sequence[float],
    y_m: Sequence[float],
) -> list[Drawn]:
    """Return the channels to draw; a dead one stands where no other one was found."""
    left = [p for p in range(len(place)) if p not in place]
    found = []
    for channel, own in enumerate(place):
        dead = own < 0
        at = left.pop(0) if dead else own
        state = "right" if own == channel and scale[channel] == 1.0 else "corrected"
        state = "problem" if dead or doubtful[channel] else state
        found.append(Drawn(channel, x_m[at], y_m[at], state))
    return found


def _ms(time_s: float) -> str:
    return f"{1e3 * time_s:.3g} ms"


def _place(place: int, channel: int) -> str:
    if place < 0:
        return "none: dead"
    return f"{place}" if place == channel else f"{place} (not {channel})"


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"
