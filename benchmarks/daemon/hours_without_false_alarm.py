"""Hover for hours in virtual time and count false alarms of every check of the loop.

Nothing is wrong with the simulated rig, so each fault is a false alarm. Half of the time is flown
on `nominal`, half on `rig`, with its nonlinear plant and small imperfections; a hundredth of it
besides on a platform that bends. Ten seconds of each minute are excited; the beam moves there and
back within each ten minutes. After a fault the flight begins anew. Rows are not logged. 8 hours
take 10 to 20 minutes; --quick flies 4 minutes.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure, Target
from levid.config.base import parse_text
from levid.config.rig import RigConfig, load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.daemon.control.faults import Fault
from levid.daemon.control.flight_segment import Segment
from levid.daemon.control.states import State
from levid.daemon.loop.clock import VirtualClock
from levid.daemon.loop.virtual_flight import Flight
from levid.daemon.planning.plan import plan_session

RIG_FILE = shipped("rigs/loopback.yaml")
SIMS = ("nominal", "rig")
HOURS, QUICK_HOURS = 8.0, 4.0 / 60.0
BENDING_SHARE = 0.01
"""Effects of a SIM.yaml are Python, and as slow as real time."""
BENDING = """effects:
- use: levid.sim.effects.flexible:FlexibleMode
  freq_hz: 95
  damping: 0.01
  mass_kg: 1
  shape: [1, -0.4, 0.7, 0.02, 0.9, 0.1, -0.8, 0.3, -0.2]
"""
"""A mode that the decoupling does not remove, with a node near sensor 3."""
_SESSION = """
levid: session
name: hours
excitations:
  z: {input: z, rms_n: 1.0}
  psi: {input: psi, rms_n_m: 0.07}
  theta: {input: theta, rms_n_m: 0.07}
steps:
  - levitate: {}
  - record: {name: excited, duration_s: 10, settle_s: 0, excite: [z, psi, theta]}
  - move: {beam_m: 0.08}
  - move: {beam_m: 0.0}
  - land: {}
"""
_HOVER_S = 50.0
_MOVE_EVERY = 10


def measure(quick: bool) -> Iterator[Figure]:
    """Hover on each simulated rig; yield the false alarms, in all and by their names."""
    alarms: Counter[str] = Counter()
    flown_s = 0.0
    all_s = 3600.0 * (QUICK_HOURS if quick else HOURS)
    with tempfile.TemporaryDirectory() as folder:
        times_s = {shipped(f"sims/{sim}.yaml"): all_s / len(SIMS) for sim in SIMS}
        times_s[bending_sim(Path(folder))] = BENDING_SHARE * all_s
        for sim, asked_s in times_s.items():
            due_s = asked_s
            rig = load_rig(RIG_FILE).model_copy(update={"sim": str(sim)})
            while due_s > 0.0:
                passed_s, fault, text = hover(rig, due_s)
                due_s, flown_s = due_s - passed_s, flown_s + passed_s
                if fault:
                    alarms[fault.name] += 1
                    after = f"{sim.stem}: {fault.name} after {passed_s:.1f} s"
                    print(f"{after}: {text}", file=sys.stderr)
    yield Figure("hours", flown_s / 3600.0, "h", "hours flown in virtual time")
    total = sum(alarms.values())
    yield Figure("false_alarms", total, "", "false alarms", target=Target(most=0))
    for name, count in alarms.items():
        yield Figure(f"false_alarms_{name}", count, "", name)


def bending_sim(folder: Path, text: str = "") -> Path:
    """Write a SIM.yaml of a platform that bends, from that of a rigid one; default: nominal."""
    text = text or shipped("sims/nominal.yaml").read_text()
    file = folder / "bending.yaml"
    file.write_text(text.replace("effects: []\n", BENDING))
    return file


def hover(rig: RigConfig, seconds: float) -> tuple[float, Fault, str]:
    """Fly for at least so many seconds or to a fault; return the time in s, the fault, its text."""
    plan = plan_session(parse_text(_SESSION, SessionConfig, "hours"), rig)
    lift, excited, there, back, land = (list(step.segments()) for step in plan.steps)
    hold = replace(
        lift[-1],
        state=State.LEVITATING,
        cycles=round(_HOVER_S * rig.rate_hz),
        blend=np.ones((1, 3)),
        engages=False,
    )
    with Flight(rig, RIG_FILE.parent, rig.rate_hz, VirtualClock()) as flight:

        def flown(segments: list[Segment]) -> Fault:
            for segment in segments:
                if fault := flight.loop.fly(segment):
                    return fault
            return Fault.NONE

        fault, minutes = flown(lift), 0
        while not fault and flight.loop.cycle < seconds * rig.rate_hz:
            minutes += 1
            moves = [*there, *back] if minutes % _MOVE_EVERY == 0 else []
            fault = flown([hold, *excited, *moves])
        fault = fault or flown(land)
        return flight.loop.cycle / rig.rate_hz, fault, flight._detail(fault)


if __name__ == "__main__":
    benchmark_runner.run("Hours without a false alarm", measure)
