"""What rounds of the loop and of cyclictest come to, as figures with their targets."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Any

from levid.benchmarks.daemon.timing_rounds import Turn
from levid.benchmarks.harness.ratio_of_shares import MOST_RATIO, Round, ratio_figures
from levid.benchmarks.harness.table import Figure, Met, Target
from levid.benchmarks.harness.trend import trend

MOST_MEDIAN = 1.2
MOST_P99_US, MOST_P999_US = 25.0, 100.0
QUIET_P999_US = 70.0
"""What cyclictest's own p99.9 has to stay below for the loop's to be asked about, at 10 kHz."""
MOST_RECORDER = 0.15
MOST_LAG_S_MIN = 0.1
"""At that ten minutes take a second of the ring's fifteen: whoever keeps up does not fall back."""
_LEAST_TREND_S = 300.0
_NONE = Target(most=0)


def slowest(written: Sequence[tuple[float, float]], looks: int) -> float | None:
    """Return the least MiB/s over so many looks at the time in s and the MiB that were down."""
    pairs = zip(written, written[looks:], strict=False)
    return min(((b - a) / (to_s - at_s) for (at_s, a), (to_s, b) in pairs), default=None)


def pairs(lines: Sequence[dict[str, Any]]) -> list[Round]:
    """Return the late cycles of the rounds in which both had their turn."""
    return [
        Round(*(line[who][key] for who in ("loop", "cyclictest") for key in ("late", "cycles")))
        for line in lines
        if "loop" in line and "cyclictest" in line
    ]


def rate_figures(name: str, lines: Sequence[dict[str, Any]]) -> list[Figure]:
    """Return what the loop was like in a section, beside cyclictest if that was run."""
    at = where(name)
    levid = Turn.together(Turn.from_plain(line["loop"]) for line in lines if "loop" in line)
    peer = Turn.together(
        Turn.from_plain(line["cyclictest"]) for line in lines if "cyclictest" in line
    )
    failed = sum("failed" in line for line in lines)
    figures = [Figure(f"rounds_{name}", len(lines), "", f"{name}: rounds")]
    figures.append(Figure(f"failed_rounds_{name}", failed, "", "that failed", None, _NONE))
    for key, share in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999)):
        ours, theirs = levid.lateness.quantile(share), peer.lateness.quantile(share)
        versus = f"cyclictest_{key}_us_{name}"
        figures += [
            Figure(versus, theirs, "us", f"cyclictest {at}: wake-up, {key}"),
            Figure(
                f"lateness_{key}_us_{name}", ours, "us",
                f"loop {at}: lateness after its spin, {key}", versus,
                tail_target(name, key, peer),
            ),
        ]  # fmt: skip
    ours, theirs = levid.woken.quantile(0.5), peer.lateness.quantile(0.5)
    medians = ours / theirs if ours is not None and theirs else None
    late = f"cyclictest_late_share_{name}"
    figures += [
        Figure(
            f"wake_up_p50_us_{name}", ours, "us", f"loop {at}: wake-up, before its spin, p50",
            f"cyclictest_p50_us_{name}",
        ),
        Figure(
            f"median_ratio_{name}", medians, "", "wake-up over cyclictest's: medians", None,
            Target(most=MOST_MEDIAN),
        ),
        Figure(late, _share(peer), "", f"cyclictest {at}: woken up a period late"),
        Figure(f"late_share_{name}", _share(levid), "", f"loop {at}: ended late", late),
    ]  # fmt: skip
    low, high, who = f"late_ratio_low_{name}", f"late_ratio_{name}", f"loop {at}, cyclictest"
    if turns := pairs(lines):
        figures += ratio_figures(turns, low, high, who)
    else:
        label = f"{who}: ratio of the shares, 95 % bounds"
        target = Target(most=MOST_RATIO, met=Met.NOT_ASKED)
        figures += [Figure(low, None, "", label), Figure(high, None, "", label, None, target)]
    return [*figures, *recorder_figures(name, levid)]


def tail_target(name: str, key: str, peer: Turn) -> Target | None:
    """Return what a tail at 10 kHz should be, asked where cyclictest's own is short enough."""
    most = {"p99": MOST_P99_US, "p999": MOST_P999_US}.get(key)
    if name != "10khz" or most is None:
        return None
    theirs = peer.lateness.quantile(0.999)
    quiet = theirs is not None and theirs < QUIET_P999_US
    return Target(most=most, met=None if quiet else Met.NOT_ASKED)


def recorder_figures(name: str, levid: Turn) -> list[Figure]:
    """Return what a cycle took, and how the recorder kept up with it."""
    used = levid.recorder_s / levid.seconds if levid.seconds else None
    wrong = levid.found.wrong - levid.found.missing
    p50, p99 = (levid.execution.quantile(share) for share in (0.5, 0.99))
    asked = None if levid.cycles else Met.NOT_ASKED
    none = Target(most=0, met=asked)
    return [
        Figure(f"execution_p50_us_{name}", p50, "us", f"loop {where(name)}: a cycle takes, p50"),
        Figure(f"execution_p99_us_{name}", p99, "us", "p99"),
        Figure(f"lost_rows_{name}", levid.found.missing, "", "flown rows in no log", None, none),
        Figure(f"wrong_rows_{name}", wrong, "", "twice, strange, cut logs", None, none),
        Figure(
            f"recorder_cpu_{name}", used, "", "recorder: share of a processor", None,
            Target(most=MOST_RECORDER),
        ),
    ]  # fmt: skip


def busy_figures(lines: Sequence[dict[str, Any]]) -> list[Figure]:
    """Return how the recorder fared in one flight at 10 kHz beside a busy disk."""
    (line,) = (line for line in lines if "lag_rows" not in line)
    levid = Turn.from_plain(line["loop"]) if "loop" in line else Turn()
    peer = Turn.from_plain(line["cyclictest"]) if "cyclictest" in line else Turn()
    written = line.get("written", [])
    rows = [lag.rows for lag in levid.lags]
    grows = trend([lag.at_s for lag in levid.lags], rows)
    long = levid.seconds >= _LEAST_TREND_S
    keeps_up = Target(most=MOST_LAG_S_MIN, met=None if long else Met.NOT_ASKED)
    second = 10_000.0
    late = "cyclictest_late_share_busy"
    failed = int("failed" in line)
    return [
        Figure("failed_busy", failed, "", "busy disk: flights that failed", None, _NONE),
        Figure("flight_s_busy", levid.seconds, "s", "one flight at 10 kHz, the disk busy"),
        Figure(
            "written_mib_s_busy", slowest(written, max(len(written) - 1, 1)), "MiB/s",
            "written and synced beside it",
        ),
        Figure("slowest_mib_s_busy", slowest(written, 10), "MiB/s", "in its slowest ten seconds"),
        *recorder_figures("busy", levid),
        Figure("ring_s_busy", levid.ring_s, "s", "what the ring holds"),
        Figure("lag_s_busy", max(rows) / second if rows else None, "s", "recorder: largest lag"),
        Figure("lag_median_s_busy", median(rows) / second if rows else None, "s", "median lag"),
        Figure(
            "lag_trend_busy", 60 * grows.slope / second if grows else None, "s/min",
            "the lag grows by", None, keeps_up,
        ),
        Figure(
            "lag_trend_error_busy", 60 * grows.error / second if grows else None, "s/min",
            "standard error of that",
        ),
        Figure(late, _share(peer), "", "cyclictest before and after it: a period late"),
        Figure("late_share_busy", _share(levid), "", "loop: ended late", late),
    ]  # fmt: skip


def _share(turn: Turn) -> float | None:
    return turn.late / turn.cycles if turn.cycles else None


def where(section: str) -> str:
    """Return where a section's contenders were, for the table."""
    return {"together": "at 10khz, both at once", "busy": "beside a busy disk"}.get(
        section, f"at {section}"
    )
