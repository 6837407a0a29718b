"""How punctual 1 kHz is on each backend: whole loops against an empty one, in turns and beside it.

A loop is the devices' part of a cycle, readings in and zero force out, without control and
recording; those of the whole daemon are in _bus_flights. It runs for a minute without a pause, with
all that the daemon's loop asks of a machine of its own, while another empty one with a higher
priority runs on the same processor; then an empty one runs alone, in the next round the other way
round. A host takes its processors from a machine that uses them, and more often than from one that
sleeps: what the one beside it is late by is not of the loop's making, and of a machine of one's own
both ratios say the same. Two things are called late: a cycle that begins a period after its time or
more, and one that has not ended by then. Electronics have the other processors, as on a rig, and a
priority of their own; what carries udp's frames has none, nor can it be given.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from levid.benchmarks.bus.bus_rigs import (
    LABELS,
    RATE_HZ,
    cycle_of,
    electronics_on,
    opened,
    rig_on,
    rig_text,
)
from levid.benchmarks.bus.cycle_cost import MOST_STALE
from levid.benchmarks.harness import real_time
from levid.benchmarks.harness.empty_loop import Stretch, beside, processors, timed
from levid.benchmarks.harness.kept_results import Parts
from levid.benchmarks.harness.ratio_of_shares import MOST_RATIO, Round, ratio_figures
from levid.benchmarks.harness.table import Figure, Met, Target
from levid.drivers.base import DriverError

_ATTEMPTS = 3
_ANOTHER_HOST = 1000
"""After such a jump of the cycle electronics do not catch up with what they missed."""
_AGAINST = (
    ("beside", "", "empty loop beside it"),
    ("empty", "_alone", "empty loop alone"),
)
"""Whom a loop is compared with, what that adds to a key, and what it is called."""


def lateness_figures(seconds: float, rounds: Mapping[str, int], kept: Parts) -> list[Figure]:
    """Return the shares of late cycles of each backend, in so many rounds with empty loops.

    Also the 95 % intervals of their ratios, and the share of cycles with a stale reading.
    """
    figures: list[Figure] = []
    for name, count in rounds.items():
        found = [
            kept.part(
                f"lateness {name} {number}",
                lambda name=name, number=number: until_whole(name, seconds, number),
            )
            for number in range(count)
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
    """Return a round, and how many before it broke off; none after _ATTEMPTS."""
    for broken in range(_ATTEMPTS):
        try:
            return one_round(name, seconds, number), broken
        except DriverError as error:
            print(f"{LABELS[name]}, round {number}: {error}", file=sys.stderr)
    return {}, _ATTEMPTS


def one_round(name: str, seconds: float, number: int) -> dict[str, Stretch]:
    """Run the loop, one beside it, and one alone for so long each.

    Which comes first changes from round to round. Raises DriverError where the devices do not last.
    """
    n = int(seconds * RATE_HZ)
    ours, others = processors()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        path = folder / "rig.yaml"
        path.write_text(rig_text(name, folder))
        electronics = stack.enter_context(electronics_on(path))
        devices = stack.enter_context(opened(rig_on(name, folder), folder))
        stack.callback(os.sched_setaffinity, 0, os.sched_getaffinity(0))
        stack.callback(real_time.relax)
        real_time.stay(others, electronics.pid)
        real_time.hurry(real_time.ELECTRONICS, electronics.pid)
        real_time.stay(ours)
        real_time.hurry(real_time.LOOP)
        turn: dict[str, Stretch] = {}

        def bus(begin: int) -> int:
            with beside(RATE_HZ, n) as witness:
                turn["bus"] = timed(cycle_of(devices), RATE_HZ, n, begin)
                turn["beside"] = witness()
            return turn["bus"].last

        def empty(begin: int) -> int:
            turn["empty"] = timed(lambda _: True, RATE_HZ, n, begin)
            return turn["empty"].last

        begin = 0
        loops: tuple[Callable[[int], int], ...] = (bus, empty)
        for loop in loops[:: -1 if number % 2 else 1]:
            begin = loop(begin) + _ANOTHER_HOST + 1
        return turn


def figures_of(name: str, turns: list[dict[str, Stretch]]) -> list[Figure]:
    """Return the shares over all rounds, late by either definition, and their ratios."""
    who = LABELS[name]
    loops = [turn["bus"] for turn in turns]
    n = sum(loop.cycles for loop in loops)
    figures = []
    for which, what in (
        ("begun", "begins a period late or more"),
        ("ended", "has not ended a period after its time"),
    ):
        key, late = f"{name}_{which}_late", f"{which}_late"
        share = sum(getattr(loop, late) for loop in loops) / n
        figures.append(Figure(f"{key}_share", share, "", f"{who}: {what}"))
        for against, added, whom in _AGAINST:
            peers = [turn[against] for turn in turns]
            rounds = [
                Round(getattr(loop, late), loop.cycles, getattr(peer, late), peer.cycles)
                for loop, peer in zip(loops, peers, strict=True)
            ]
            share = sum(one.others for one in rounds) / sum(one.of_others for one in rounds)
            figures += [
                Figure(f"{key}{added}_empty_share", share, "", f"{whom}: {what}"),
                *ratio_figures(
                    rounds,
                    f"{key}{added}_ratio_low",
                    f"{key}{added}_ratio_95",
                    f"{who}, {which} late, {whom}",
                ),
            ]
    stale = sum(loop.stale for loop in loops)
    every = [stretch for turn in turns for stretch in turn.values()]
    return [
        *figures,
        Figure(
            f"{name}_stale_share",
            stale / n,
            "",
            f"{who}: cycles with a stale reading",
            target=Target(most=MOST_STALE),
        ),
        Figure(f"{name}_cycles", n, "", f"{who}: cycles, as many of each empty loop"),
        Figure(
            f"{name}_real_time",
            float(np.mean([one.real_time for one in every])),
            "",
            f"{who}, and the empty loops: stretches at real-time priority",
        ),
        Figure(f"{name}_stretch_s", loops[0].cycles / RATE_HZ, "s", f"{who}: in one piece"),
    ]


def nothing_of(name: str) -> list[Figure]:
    """Return the ratios of a backend that did not last for one round: what is asked is not met."""
    target = Target(most=MOST_RATIO, met=Met.NO)
    return [
        Figure(
            f"{name}_{which}_late{added}_ratio_95",
            None,
            "",
            f"{LABELS[name]}: no round",
            None,
            target,
        )
        for which in ("begun", "ended")
        for _, added, _ in _AGAINST
    ]
