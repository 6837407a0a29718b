"""`levid electronics`: emulate amplifiers, ADC and drives on a rig's buses."""

from __future__ import annotations

import json
import signal
import sys
import threading
from pathlib import Path

import click

from .path_types import RIG
from .progress import say


@click.command("electronics")
@click.argument("rig", type=RIG)
def command(rig: Path) -> int:
    """Emulate the electronics of RIG.yaml on its buses, in real time, with its simulated plant.

    Type a command to inject a fault: `trip 3` trips coil 3, `help` lists all faults, `clear`
    removes them, `status` prints JSON. Each command prints one line. Ctrl-C or SIGTERM ends it; the
    end of standard input does not.

    \b
    Examples:
      levid electronics serial
      levid run serial       # in another terminal
    """
    from ..config.rig import load_rig
    from ..sim.electronics.emulated_rig import Electronics

    config = load_rig(rig)
    electronics = Electronics(config, rig.parent)
    done = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: done.set())
    with electronics:
        say(f"emulating the electronics of {config.name}; Ctrl-C ends it")
        threading.Thread(target=_run_commands, args=(electronics,), daemon=True).start()
        while not done.wait(0.2):
            pass
    return 0


def _run_commands(electronics: object) -> None:
    from ..sim.electronics.emulated_rig import Electronics
    from ..sim.electronics.faults import FAULTS, InjectionError

    assert isinstance(electronics, Electronics)
    for line in sys.stdin:
        match line.split():
            case []:
                continue
            case ["help"]:
                answer = "; ".join(
                    f"{name}{f' {kind.argument.upper()}' if kind.argument else ''}: {kind.does}"
                    for name, kind in FAULTS.items()
                )
            case ["status"]:
                answer = json.dumps(electronics.status())
            case _:
                try:
                    answer = electronics.injector.command(line.strip())
                except InjectionError as error:
                    answer = f"error: {error}"
        click.echo(answer)
