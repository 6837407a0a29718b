"""The figures of fault trials: shares of what was asked, and in words what went wrong."""

from __future__ import annotations

import statistics
import sys
from collections import Counter
from collections.abc import Iterable, Sequence

from levid.benchmarks.daemon.fault_list import BUSES, LAST, SOON, kinds, untested
from levid.benchmarks.daemon.fault_logs import LAST_S
from levid.benchmarks.daemon.fault_rig import RATE_HZ, STALE_CYCLES
from levid.benchmarks.daemon.fault_trial import Trial
from levid.benchmarks.harness.table import Figure, Target

ALL, NONE = Target(least=1.0), Target(most=0)


def figures(trials: Sequence[Trial], asked: int, interrupted: int) -> list[Figure]:
    """Return the figures; `trials` are all attempts, `asked` the faults that were to be injected.

    A fault that was injected counts in all that was asked of it, whatever became of the trial;
    one that was not counts among those not injected, and in nothing else.
    """
    tried = [trial for trial in trials if not trial.skipped]
    injected = [trial for trial in tried if trial.injected]
    stops = [trial for trial in injected if trial.must_stop]
    others = [trial for trial in injected if trial.must_not_disturb]
    return [
        Figure("rate_hz", RATE_HZ, "Hz", "flown at"),
        Figure("stale_cycles", STALE_CYCLES, "", "cycles without a reading that are bridged"),
        Figure("asked", asked, "", "faults asked for, in flight"),
        Figure(
            "faults", len(injected), "", "faults injected in flight", target=Target(least=asked)
        ),
        Figure("not_injected", _in_vain(tried), "", "attempts in vain, tried again"),
        Figure("interrupted", interrupted, "", "attempts cut by the end of a run"),
        Figure("skipped", len(trials) - len(tried), "", "left out: no right to them"),
        Figure("untested", len(untested()), "", "names of faults without a trial"),
        *_stopping(stops),
        *_telling(stops, others),
        Figure("flew", _share(t.flew for t in tried), "", "lift-offs that succeeded"),
        Figure(
            "usable",
            _share(t.rested and t.clears <= 1 for t in stops),
            "",
            "usable after one clear",
            target=ALL,
        ),
        Figure(
            "most_clears", max((t.clears for t in tried), default=0), "", "most clears that it took"
        ),
        Figure(
            "slowest_clear",
            max((t.clear_s for t in tried), default=0.0),
            "s",
            "slowest until idle again",
        ),
        Figure(
            "failed", sum(bool(t.failed) for t in tried), "", "trials that did not end", target=NONE
        ),
        *_logs(injected),
        *_strength(others),
    ]


def _in_vain(trials: Sequence[Trial]) -> int:
    return sum(not trial.injected and trial.fault != LAST for trial in trials)


def _stopping(stops: Sequence[Trial]) -> list[Figure]:
    own = [trial for trial in stops if not trial.kind.own_timeout]
    slowest = max((t.cycles for t in stops if t.cycles is not None), default=0)
    of_each = {name: [t for t in own if t.fault == name] for name in _names()}
    return [
        Figure(
            "stopped", _share(t.cycles is not None for t in stops), "", "must stop: did", target=ALL
        ),
        Figure(
            "came_back",
            sum(t.came_back > 0 for t in stops),
            "",
            "must stop: force acted again",
            target=NONE,
        ),
        Figure(
            "within_3",
            _share(map(_soon, own)),
            "",
            f"loop can end it: zero within {SOON} cycles of {1e3 / RATE_HZ:g} ms from its showing",
            target=ALL,
        ),
        *(
            Figure(f"within_3_{_key(name)}", _share(map(_soon, of)), "", f"within {SOON}: {name}")
            for name, of in of_each.items()
            if of
        ),
        Figure("within_all", _share(map(_soon, stops)), "", f"all: zero within {SOON}"),
        Figure(
            "within_promise",
            _share(map(_promised, stops)),
            "",
            "all: in time, or its own timeout",
            target=ALL,
        ),
        Figure("slowest_stop", slowest, "cycles", "slowest to zero force"),
        Figure(
            "shows_late",
            sum(t.kind.shows > 0 for t in stops),
            "",
            "of these show after a while: counted from the last moment that they may",
        ),
    ]


def _telling(stops: Sequence[Trial], others: Sequence[Trial]) -> list[Figure]:
    told = [trial.told for trial in others if trial.told is not None]
    right = [*(t.named for t in stops), *(bool(t.told) for t in others)]
    return [
        Figure(
            "right_name",
            _share(right),
            "",
            "all: named rightly, or told",
            target=Target(least=0.99),
        ),
        Figure(
            "named",
            _share(t.named for t in stops),
            "",
            "must stop: named rightly",
            target=Target(least=0.99),
        ),
        Figure(
            "recorded",
            _share(t.recorded for t in stops),
            "",
            "must stop: recorded as that",
            target=Target(least=0.99),
        ),
        Figure(
            "undisturbed",
            _share(t.undisturbed for t in others),
            "",
            "must not disturb: flew on",
            target=ALL,
        ),
        Figure("told", _share(told), "", "must not disturb: status says so", target=ALL),
        Figure(
            "not_named",
            len(others) - len(told),
            "",
            "must not disturb: no word for it",
            target=NONE,
        ),
    ]


def _logs(injected: Sequence[Trial]) -> list[Figure]:
    tail_s = max((trial.look.tail_s for trial in injected), default=0.0)
    return [
        Figure("logs", sum(t.look.logs for t in injected), "", "logs of flights read"),
        Figure(
            "without_log",
            sum(not t.look.logs for t in injected),
            "",
            "flights without one",
            target=NONE,
        ),
        Figure(
            "unreadable",
            sum(t.look.unreadable for t in injected),
            "",
            "logs that do not open",
            target=NONE,
        ),
        Figure(
            "rowless", sum(t.look.rowless for t in injected), "", "logs cut before a row was due"
        ),
        Figure(
            "incomplete",
            sum(t.look.incomplete for t in injected),
            "",
            "logs not whole, though not cut",
            target=NONE,
        ),
        Figure(
            "missing",
            sum(t.look.missing for t in injected),
            "",
            "rows missing within flights",
            target=NONE,
        ),
        Figure(
            "longest_tail",
            tail_s,
            "s",
            "most missing at a log's end",
            target=Target(most=LAST_S),
        ),
        Figure(
            "unclosed",
            sum(not t.closed for t in injected),
            "",
            "flights whose log stayed open",
            target=NONE,
        ),
    ]


def _strength(others: Sequence[Trial]) -> list[Figure]:
    """Return how hard floods and pressure were, and whether floods made the loop late."""
    floods = [trial for trial in others if trial.fault == "socket flooded"]
    calm = [trial for trial in others if trial.fault.startswith("client gone")]
    rates = [trial.answers / trial.asked_s for trial in floods if trial.asked_s]
    stalls = [1e-3 * t.stalled_us for t in others if t.fault == "memory pressure"]
    return [
        Figure("flood", statistics.median(rates or [0.0]), "/s", "flood: requests answered"),
        Figure("late_flooded", _late(floods), "", "flood: late cycles, share", "late_calm"),
        Figure("late_calm", _late(calm), "", "no flood: late cycles, share"),
        Figure(
            "stalled", statistics.median(stalls or [0.0]), "ms", "memory pressure: waits for it"
        ),
    ]


def _late(trials: Sequence[Trial]) -> float:
    return sum(trial.look.late for trial in trials) / max(
        sum(trial.look.rows for trial in trials), 1
    )


def _soon(trial: Trial) -> bool:
    return trial.cycles is not None and trial.cycles <= trial.kind.shows + SOON


def _promised(trial: Trial) -> bool:
    return trial.cycles is not None and trial.cycles <= trial.kind.most_cycles


def _share(true: Iterable[object]) -> float:
    counted = [bool(one) for one in true]
    return sum(counted) / max(len(counted), 1)


def _names() -> list[str]:
    return sorted({name for bus in BUSES for name in kinds(bus)})


def _key(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name)


def tell(trials: Sequence[Trial]) -> None:
    """Say what went wrong, how long each fault took at most, and what each was called."""
    wrong = Counter(f"{t.bus}: {t.fault}: {what}" for t in trials for what in t.wrong)
    wrong.update(f"{t.bus}: {t.fault}: not injected: {t.why_not}" for t in trials if t.why_not)
    wrong.update(f"{t.bus}: {t.fault}: left out: {t.skipped}" for t in trials if t.skipped)
    for text, count in wrong.most_common():
        print(f"{count} x {text}", file=sys.stderr)
    injected = [trial for trial in trials if trial.injected]
    for name in _names():
        those = [trial for trial in injected if trial.fault == name]
        if those and those[0].must_stop:
            names = Counter(trial.found for trial in those).most_common()
            longest = max(trial.cycles or 0 for trial in those)
            called = ", ".join(f"{count} {found}" for found, count in names)
            print(f"{name}: at most {longest} cycles; {called}", file=sys.stderr)
        elif those:
            word = "no word for it" if those[0].told is None else "the status says so"
            print(f"{name}: {len(those)}; {word}", file=sys.stderr)
    print(f"without a trial: {', '.join(untested())}", file=sys.stderr)
