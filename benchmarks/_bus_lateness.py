"""How punctual 1 kHz is on each backend: whole loops against an empty one, in turns.

A loop is the devices' part of a cycle, readings in and zero force out, without control and
recording; those of the whole daemon are in _bus_flights. It runs for a minute without a pause, as
in the daemon without the garbage collector, then the empty one does, in the next round the other
way round. Two things are called late: a cycle that begins a period after its time or more, and one
that has not ended by then. Loops and electronics run at real-time priority where that may be had,
the empty one too; what carries udp's frames has none, nor can it be given.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from typing import NamedTuple

import _real_time
import numpy as np
from _bus_cycles import MOST_STALE
from _bus_rigs import LABELS, RATE_HZ, TIMED, cycle_of, electronics_on, opened, rig_on, rig_text
from _kept import Parts
from _shares import MOST_RATIO, Round, ratio_figures
from _table import Figure, Met, Target

from levid.config.service import Realtime
from levid.daemon.clock import RealClock
from levid.daemon.realtime import be_punctual, no_collections
from levid.drivers.base import DriverError

_WARM_UP = 200
"""Cycles of each stretch that do not count: devices that were left alone have to be enabled."""
_TRIES = 3
_ANOTHER_HOST = 1000
"""After such a jump of the cycle electronics do not catch up with what they missed."""


class Stretch(NamedTuple):
    """Cycles run, of them late in either sense and with a stale reading; and the last one's.

    real_time: whether it ran first in, first out.
    """

    cycles: int
    begun_late: int
    ended_late: int
    stale: int
    last: int
    real_time: bool = False


def lateness_figures(seconds: float, rounds: int, kept: Parts) -> list[Figure]:
    """Return the shares of late cycles of each backend and of the empty loop in turns with it.

    Also the 95 % intervals of their ratios, and the share of cycles with a stale reading.
    """
    figures: list[Figure] = []
    for name in TIMED:
        found = [
            kept.part(
                f"lateness {name} {number}",
                lambda name=name, number=number: until_whole(name, seconds, number),
            )
            for number in range(rounds)
        ]
        turns = [{w: Stretch(*counts) for w, counts in turn.items()} for turn, _ in found if turn]
        broken = sum(broken for _, broken in found)
        what = "stretches that a lost bus or too many stale readings ended"
        figures.append(Figure(f"{name}_broken_off", broken, "", f"{LABELS[name]}: {what}"))
        if turns:
            figures += figures_of(name, turns)
        else:
            figures += nothing_of(name)
    return figures


def until_whole(name: str, seconds: float, number: int) -> tuple[dict[str, Stretch], int]:
    """Return a round, and how many before it broke off; none after _TRIES."""
    for broken in range(_TRIES):
        try:
            return one_round(name, seconds, number), broken
        except DriverError as error:
            print(f"{LABELS[name]}, round {number}: {error}", file=sys.stderr)
    return {}, _TRIES


def one_round(name: str, seconds: float, number: int) -> dict[str, Stretch]:
    """Run both loops for so long each; which of them is first changes from round to round.

    Raises DriverError where the devices do not last.
    """
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        path = folder / "rig.yaml"
        path.write_text(rig_text(name, folder))
        with (
            electronics_on(path) as electronics,
            opened(rig_on(name, folder), folder) as devices,
        ):
            loops: dict[str, Callable[[int], bool]] = {
                "empty": lambda _: True,
                "bus": cycle_of(devices),
            }
            try:
                _real_time.hurry(_real_time.ELECTRONICS, electronics.pid)
                _real_time.hurry(_real_time.LOOP)
                turn: dict[str, Stretch] = {}
                begin = 0
                for which in sorted(loops, reverse=bool(number % 2)):
                    turn[which] = _timed(loops[which], seconds, begin)
                    begin = turn[which].last + _ANOTHER_HOST + 1
                return turn
            finally:
                _real_time.relax()


def figures_of(name: str, turns: list[dict[str, Stretch]]) -> list[Figure]:
    """Return the shares over all rounds, late by either definition, and their ratios."""
    who = LABELS[name]
    loops, empties = [turn["bus"] for turn in turns], [turn["empty"] for turn in turns]
    n = sum(loop.cycles for loop in loops)
    figures = []
    for which, what in (
        ("begun", "begins a period late or more"),
        ("ended", "has not ended a period after its time"),
    ):
        rounds = [
            Round(
                getattr(loop, f"{which}_late"),
                loop.cycles,
                getattr(empty, f"{which}_late"),
                empty.cycles,
            )
            for loop, empty in zip(loops, empties, strict=True)
        ]
        others = sum(one.others for one in rounds)
        key, empty_key = f"{name}_{which}_late", f"{name}_empty_{which}_late"
        figures += [
            Figure(f"{empty_key}_share", others / n, "", f"empty loop beside it: {what}"),
            Figure(
                f"{key}_share",
                sum(one.some for one in rounds) / n,
                "",
                f"{who}: {what}",
                f"{empty_key}_share" if others else None,
            ),
            *ratio_figures(rounds, f"{key}_ratio_low", f"{key}_ratio_95", f"{who}, {which} late"),
        ]
    stale = sum(loop.stale for loop in loops)
    return [
        *figures,
        Figure(
            f"{name}_stale_share",
            stale / n,
            "",
            f"{who}: cycles with a stale reading",
            target=Target(most=MOST_STALE),
        ),
        Figure(f"{name}_cycles", n, "", f"{who}: cycles, as many of the empty loop"),
        Figure(
            f"{name}_real_time",
            float(np.mean([one.real_time for one in (*loops, *empties)])),
            "",
            f"{who}, and the empty loop: stretches at real-time priority",
        ),
        Figure(f"{name}_stretch_s", loops[0].cycles / RATE_HZ, "s", f"{who}: in one piece"),
    ]


def nothing_of(name: str) -> list[Figure]:
    """Return the ratios of a backend that did not last for one round: what is asked is not met."""
    target = Target(most=MOST_RATIO, met=Met.NO)
    return [
        Figure(f"{name}_{which}_late_ratio_95", None, "", f"{LABELS[name]}: no round", None, target)
        for which in ("begun", "ended")
    ]


def _timed(loop: Callable[[int], bool], seconds: float, begin: int) -> Stretch:
    """Run `loop`, which says whether its readings are fresh, at 1 kHz from cycle `begin` on."""
    be_punctual(Realtime(priority=0, lock_memory=False, cpu_latency_us=None))
    period_s, n = 1 / RATE_HZ, int(seconds * RATE_HZ)
    clock = RealClock(period_s)
    cycle, begun, ended, stale = begin, 0, 0, 0
    with no_collections():
        clock.start()
        for k in range(-_WARM_UP, n):
            late_s = clock.wait()
            began_s = monotonic()
            cycle += 1 + clock.skipped
            fresh = loop(cycle)
            if k >= 0:
                begun += clock.skipped > 0
                ended += late_s + monotonic() - began_s >= period_s
                stale += not fresh
    real_time = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    return Stretch(n, begun, ended, stale, cycle, real_time)
