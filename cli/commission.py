"""`levid commission`: guided, force-limited first contact with the hardware of a rig."""

from __future__ import annotations

import json
import math
import sys
import threading
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..config.command_line import command_line
from .output_folder_check import writable_folder
from .path_types import RIG, YAML
from .progress import progress, say

if TYPE_CHECKING:
    from ..config.rig import RigConfig
    from ..daemon.commissioning.commission import Ask, Commissioned
    from ..daemon.commissioning.device_session import DeviceSession
    from ..daemon.commissioning.encoder_scales import Axis

_COILS_A_WEIGHT = 14.0
"""Weight over the force of one coil: a corner is lifted only by half of the weight."""


@click.command("commission")
@click.argument("rig", type=RIG)
@click.option(
    "--out",
    required=True,
    type=YAML,
    help="Path of the corrected RIG.yaml, a new file. Beside it: a copy with tight limits for the "
    "first lift, and a page.",
)
@click.option(
    "--stroke-mm",
    metavar="MM",
    type=click.FloatRange(0.1, 20.0),
    default=1.8,
    help="Travel of the platform in mm, from its lower to its upper stops. Default: 1.8.",
)
@click.option(
    "--stops-mm",
    metavar="X Y",
    type=click.FloatRange(1.0, 1000.0),
    nargs=2,
    help="Half the distance in mm between the stops along x, and along y. Default: that of the "
    "outermost coils.",
)
@click.option(
    "--force-n",
    metavar="N",
    type=click.FloatRange(0.01, 100.0),
    help="Force in N with which one coil at a time pushes. Default: a fourteenth of the "
    "platform's weight.",
)
@click.option(
    "--beam-mm",
    metavar="MM",
    type=click.FloatRange(0.0, 500.0),
    default=20.0,
    help="Distance in mm that the beam moves, slowly, to find its direction; 0: it does not "
    "move. Default: 20.",
)
@click.option(
    "--measure",
    is_flag=True,
    help="Move beam and rotor and ask how far they went: measure with a ruler and a protractor.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of text.")
def command(
    rig: Path,
    out: Path,
    stroke_mm: float,
    stops_mm: tuple[float, float] | None,
    force_n: float | None,
    beam_mm: float,
    measure: bool,
    as_json: bool,
) -> int:
    """Find order, sign and scale of the channels of RIG.yaml, and write a corrected copy.

    The daemon must not run. The platform rests on its lower stops. You lift it by hand as a whole
    and at two sides, as the command asks; then each coil alone pushes with a small force, which
    cannot lift. Dead, swapped, reversed and weak channels are named. Nothing flies.

    On the simulator a simulated hand lifts; on `levid electronics` type the command that is asked
    for into it.

    \b
    Examples:
      levid commission my-rig.yaml --out my-rig-commissioned.yaml
      levid commission my-rig.yaml --out new.yaml --stroke-mm 2.0 --stops-mm 110 110
    """
    from ..config.base import parse_text
    from ..config.rig import RigConfig, load_rig
    from ..daemon.api.socket_paths import listens, own_socket
    from ..daemon.commissioning.commission import Stops, commission
    from ..daemon.commissioning.corrections import (
        check_text,
        corrected_text,
        corrections,
        first_lift_text,
        problems,
        write_corrected,
    )
    from ..daemon.commissioning.device_session import DeviceSession
    from ..daemon.commissioning.errors import CommissionError
    from ..drivers.base import Context
    from ..report.commissioning.commissioning_page import commissioning_report

    config = load_rig(rig)
    if listens(own_socket(config)):
        raise CommissionError("a daemon is running on this rig: end it first (levid run, Ctrl-C)")
    text = rig.read_bytes().decode("utf-8")
    folder = out.with_name(f"{out.stem}-commissioning")
    # All that can go wrong later is asked before anybody lifts anything.
    first = out.with_stem(f"{out.stem}-first-lift")
    for new in (out, first):
        if new.exists():
            raise CommissionError(f"{new}: exists; levid overwrites no rig: give another path")
    if out.absolute().parent.resolve() != rig.absolute().parent.resolve():
        raise CommissionError(
            f"--out {out}: expected a file beside {rig}: the copy keeps its relative paths"
        )
    check_text(text, str(rig))
    writable_folder(folder, ("index.html",), ("figures",))
    weight_n = _weight_n(config)
    parse_text(first_lift_text(text, config, weight_n), RigConfig, f"{rig}, with tighter limits")
    push_n = _push_n(config, weight_n, force_n)
    _check_beam(config, beam_mm)
    geometry = config.geometry
    half = (
        (1e-3 * stops_mm[0], 1e-3 * stops_mm[1])
        if stops_mm
        else (max(map(abs, geometry.coil_x_m)), max(map(abs, geometry.coil_y_m)))
    )
    stops = Stops(half, 1e-3 * stroke_mm)
    context = Context(config, 1.0 / config.rate_hz, rig.parent)
    say(
        f"commissioning {config.name}: coils push with {push_n:.3g} N at most, one at a time; the "
        f"platform weighs {weight_n:.3g} N"
    )
    with DeviceSession(context, push_n, push_n) as session, progress("commissioning") as report:
        measured = _measured if measure else None
        found = commission(
            session, config, stops, push_n, _asker(session), report, 1e-3 * beam_mm, measured
        )
    wrong, corrected = problems(found), corrections(found)
    written = None if wrong else out
    page = commissioning_report(found, config, written, folder)
    if written is not None:
        corrected_rig = corrected_text(text, found, config)
        write_corrected(out, corrected_rig)
        write_corrected(first, first_lift_text(corrected_rig, config, weight_n))
        load_rig(out)
        load_rig(first)
    if as_json:
        summary = {**_as_json(found, config, wrong, corrected, written), "report": str(page)}
        click.echo(json.dumps(summary))
    else:
        _print(found, config, wrong, corrected, written)
        click.echo(f"report: {page}")
    return 1 if wrong else 0


def _weight_n(rig: RigConfig) -> float:
    """Return the platform's weight in N as the feed-forward carries it at the working point."""
    import numpy as np

    from ..daemon.control.feed_forward import feed_forward

    law = feed_forward(rig, 1.0 / rig.rate_hz)
    return float(abs(law.wrench(np.zeros((1, 3)))[0, 2]))


def _push_n(rig: RigConfig, weight_n: float, force_n: float | None) -> float:
    """Return the force of one coil at a time in N; raises CommissionError if it could lift."""
    from ..daemon.commissioning.errors import CommissionError

    push_n = min(force_n or weight_n / _COILS_A_WEIGHT, rig.limits.coil_n)
    if push_n > 0.25 * weight_n:
        raise CommissionError(
            f"--force-n: expected at most a quarter of the weight, {0.25 * weight_n:.3g} N: more "
            f"could lift a corner; found {push_n:g} N"
        )
    return push_n


def _check_beam(rig: RigConfig, beam_mm: float) -> None:
    from ..daemon.commissioning.errors import CommissionError

    most_mm = 1e3 * rig.limits.beam_m
    if beam_mm > most_mm:
        raise CommissionError(
            f"--beam-mm: expected at most {most_mm:g} mm (limits.beam_m), found {beam_mm:g} mm"
        )


def _asker(session: DeviceSession) -> Ask:
    from ..daemon.commissioning.commission import PROMPTS, Hold
    from ..drivers.loopback import LoopbackBackend

    def ask(hold: Hold) -> None:
        (backend, *_) = session.devices.backends
        if isinstance(backend, LoopbackBackend):
            backend.lift(hold)
            return
        say(PROMPTS[hold])
        if session.emulated:
            say(f"  (emulated electronics: type `lift {hold}` into `levid electronics`)")

    return ask


def _measured(axis: Axis, way: float) -> Future[float | None]:
    """Ask how far an axis moved; a line without a number is None. The devices go on meanwhile."""
    answer: Future[float | None] = Future()
    factor, unit, where = (
        (1e-3, "mm", "towards positive x")
        if axis == "beam"
        else (math.pi / 180.0, "degrees", "counter-clockwise, seen from above,")
    )

    def read() -> None:
        try:
            answer.set_result(factor * float(sys.stdin.readline().strip()))
        except (ValueError, OSError):
            answer.set_result(None)

    say(
        f"The encoder reports that the {axis} moved by {way / factor:g} {unit}. Measure how far it "
        f"moved {where} in {unit} (negative: the other way) and type the number, or press Enter to "
        "skip."
    )
    threading.Thread(target=read, daemon=True).start()
    return answer


def _print(
    found: Commissioned,
    rig: RigConfig,
    wrong: list[str],
    corrected: list[str],
    written: Path | None,
) -> None:
    from ..daemon.commissioning.corrections import remarks

    at_rest = found.resting
    sd = 1e6 * at_rest.sd_m[~at_rest.clipped]
    if sd.size:
        click.echo(f"noise of the sensors at rest: {sd.min():.3g} to {sd.max():.3g} um")
    if at_rest.mains_m.any():
        click.echo(
            f"mains pick-up at {at_rest.mains_hz:g} Hz: up to {1e6 * at_rest.mains_m.max():.3g} um"
        )
    if found.delay_cycles >= 0:
        click.echo(f"the amplifiers report a force {found.delay_cycles} cycles after its command")
    late = found.height_delay
    click.echo(
        "the heights follow a coil's command after "
        f"{1e3 * late.mean_s:.3g} +- {2e3 * late.sd_s:.2g} ms"
    )
    if found.beam_delay is not None:
        click.echo(f"the beam follows its setpoint after {1e3 * found.beam_delay.mean_s:.3g} ms")
    click.echo(f"largest force of a coil: {found.largest_n:.3g} N")
    if found.beam is not None:
        sure = f"{found.beam.ratio:.2f} +- {2 * found.beam.sd:.2f}"
        click.echo(f"tilt by the beam's weight, over the expected one: {sure} (1 is right)")
    for line in corrected:
        click.echo(f"corrected: {line}" if written else f"found: {line}")
    if not corrected and not wrong:
        click.echo("all channels are as RIG.yaml says")
    for line in wrong:
        click.echo(f"problem: {line}")
    for line in remarks(found, rig):
        click.echo(f"remark: {line}")
    if written is None:
        say("No RIG.yaml was written: repair these channels, and commission again.")
        return
    click.echo(f"{written}: written")
    first = written.with_stem(f"{written.stem}-first-lift")
    click.echo(f"{first}: written, with tight limits for the first lift")
    say(f"next: {command_line('check', written)}")
    say(f"then, each in its own terminal: {command_line('run', first)}")
    say(f"                                {command_line('levitate', rig=first)}")


def _as_json(
    found: Commissioned,
    rig: RigConfig,
    wrong: list[str],
    corrected: list[str],
    written: Path | None,
) -> dict[str, object]:
    from ..daemon.commissioning.corrections import coil_scale, remarks, sensor_scale

    return {
        "problems": wrong,
        "corrections": corrected,
        "written": None if written is None else str(written),
        "sensors": {
            "place": found.sensors.place.tolist(),
            "scale": sensor_scale(found),
            "measured": found.sensors.scale.tolist(),
            "noise_m": found.resting.sd_m.tolist(),
            "mains_m": found.resting.mains_m.tolist(),
        },
        "coils": {
            "place": found.coils.place.tolist(),
            "scale": coil_scale(found),
            "measured": found.coils.gain.tolist(),
        },
        "remarks": remarks(found, rig),
        "readback": found.readback.tolist(),
        "delay_cycles": found.delay_cycles,
        "height_delay_s": {"mean": found.height_delay.mean_s, "sd": found.height_delay.sd_s},
        "beam_delay_s": None if found.beam_delay is None else found.beam_delay.mean_s,
        "beam": None if found.beam is None else {"ratio": found.beam.ratio, "sd": found.beam.sd},
        "encoders": {encoder.axis: encoder.scale for encoder in found.encoders},
        "largest_n": found.largest_n,
    }
