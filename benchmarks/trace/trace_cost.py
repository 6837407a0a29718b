"""A trace from logs to proof: how long it takes, how that grows with the data, and its memory.

Flies twelve records of 60 s at 1 kHz (three of 24 s with --quick) of a plant with two effects that
nobody declared, and traces a quarter of them, half of them and all of them, with a process a core;
the declared model is 10 % off. Measured data stand beside them, where the Silverbox's are at hand:
its linear model is traced on the part to train on, and judged on the part to test on, with and
without what the trace names (not with --quick).
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from levid.benchmarks.harness import silverbox as silverbox_data
from levid.benchmarks.harness.declared_model import off_by_a_tenth
from levid.benchmarks.harness.isolated import Outcome, measure_apart
from levid.benchmarks.harness.table import Figure, Target, run
from levid.benchmarks.harness.virtual_flight import fly_session
from levid.config.base import read_mapping
from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.trace.linearised.working_point import WorkingPoint
from levid.identification.trace.records.trace_record import trace_record
from levid.identification.trace.residual.error_metric import pooled
from levid.identification.trace.residual.free_run_with_effects import free_run
from levid.identification.trace.result import model_after
from levid.identification.trace.study import refit, trace
from levid.identification.trace.worker_pool import local_workers
from levid.log.reader import read_log
from levid.model.effects.table import all_effects

EFFECTS = (
    {"use": "levid.sim.effects.stiffness:CubicRods", "dof": "z", "k3_n_m3": 5e8},
    {"use": "levid.sim.effects.coils:CoilGain", "coil": 3, "excess": 0.05},
)
FLOWN = ("rod_stiffness.cubic@z", "coil_gain@coil:3")
"""What these are in the table of effects."""
MEMORY_BYTES, TIMEOUT_S = 16_000_000_000, 1800.0
WRENCH = ["psi", "theta", "z"]
COILS = [f"coil-{i}" for i in range(9)]
SECONDS = Target(most=120.0)
"""For all twelve records."""
GROWTH = Target(most=1.15)
"""In proportion to the data is 1; the rest is for clocks of a machine that is not alone."""
CUBIC_MV, TRACED_MV, NAMED = Target(most=0.65), Target(most=0.40), Target(least=1.0)


@dataclass(frozen=True)
class Traced:
    """A trace in short: rounds, what it placed (identities), errors before and after, floor."""

    rounds: int
    placed: tuple[str, ...]
    before: float
    after: float
    floor: float


@dataclass(frozen=True)
class OnSilverbox:
    """What a trace of the Silverbox placed (keys), and free-running errors, test part, V rms.

    linear: of the declared model refitted; cubic: with a cube alone, refitted, None where no cube
    was named; traced: with all that was placed. The test part's first 5 s give its state and its
    offset and do not count.
    """

    placed: tuple[str, ...]
    linear: float
    cubic: float | None
    traced: float


def measure(quick: bool) -> Sequence[Figure]:
    duration_s = 24.0 if quick else 60.0
    with tempfile.TemporaryDirectory() as folder:
        logs = fly_session(_session(duration_s, quick), Path(folder), EFFECTS)
        sets = {"all": logs}
        if not quick:
            sets = {"quarter": logs[:3], "half": logs[:6], "all": logs}
        found = {name: _apart(to_effects, some) for name, some in sets.items()}
    figures = [Figure("cores", os.cpu_count() or 1, "", "cores, and processes of a trace")]
    for name, outcome in found.items():
        traced: Traced = outcome.value
        there = sum(flown in traced.placed for flown in FLOWN)
        what = f"{len(sets[name])} records of {duration_s:g} s"
        before, after = traced.before / traced.floor, traced.after / traced.floor
        figures += [
            Figure(
                f"{name}_s",
                outcome.seconds,
                "s",
                f"trace of {what}",
                target=SECONDS if name == "all" and not quick else None,
            ),
            Figure(f"{name}_flown", there, "", f"of {len(FLOWN)} effects flown are found"),
            Figure(f"{name}_others", len(traced.placed) - there, "", "effects found beside them"),
            Figure(f"{name}_rounds", traced.rounds, "", "rounds of the search"),
            Figure(f"{name}_before", before, "x floor", "error of the declared model"),
            Figure(f"{name}_after", after, "x floor", "error of the model with effects"),
            Figure(f"{name}_gb", outcome.peak_bytes / 1e9, "GB", "largest process"),
        ]
    if not quick:
        growth = exponent({len(sets[name]): outcome.seconds for name, outcome in found.items()})
        label = "time grows with the data to the power of"
        figures.append(Figure("growth", growth, "", label, target=GROWTH))
        figures += silverbox()
    return figures


def exponent(seconds: Mapping[int, float]) -> float:
    """Return the power of the number of records that seconds go with: a line in logarithms."""
    line = np.polyfit(*(np.log(list(some)) for some in (seconds.keys(), seconds.values())), 1)
    return float(line[0])


def silverbox() -> list[Figure]:
    """Return what a trace makes of measured data; figures are None where they are not there."""
    outcome = _apart(on_silverbox) if silverbox_data.SOURCE.exists() else None
    on: OnSilverbox | None = None if outcome is None else outcome.value
    seconds = None if outcome is None else outcome.seconds
    told = "effects named" if on is None else "\n".join(on.placed) or "nothing"
    linear = "silverbox_linear_mv"
    given = "(first 5 s give state and offset)"

    def named(key: str) -> float | None:
        return None if on is None else float(f"stiffness.{key}" in on.placed)

    return [
        Figure("silverbox_s", seconds, "s", "Silverbox: trace of the part to train on"),
        Figure(linear, on and 1e3 * on.linear, "mV", f"test error of the linear model {given}"),
        Figure(
            "silverbox_traced_mv",
            on and 1e3 * on.traced,
            "mV",
            f"with what the trace names {given}",
            linear,
            TRACED_MV,
        ),
        Figure(
            "silverbox_cubic_mv",
            None if on is None or on.cubic is None else 1e3 * on.cubic,
            "mV",
            f"with its cube alone {given}",
            linear,
            CUBIC_MV,
        ),
        Figure("silverbox_effects", on and len(on.placed), "", told),
        Figure("silverbox_cubic", named("cubic"), "", "cubic named", target=NAMED),
        Figure("silverbox_asymmetric", named("asymmetric"), "", "asymmetric named"),
    ]


def to_effects(logs: Sequence[Path]) -> Traced:
    """Return what a trace of these logs finds.

    Its progress is not told: what is measured is what `levid trace` does before its report.
    """
    config = off_by_a_tenth(1)  # the shipped model is the simulator's own
    with local_workers(config) as workers:
        found = trace(logs, config, all_effects, workers, lambda *_: None)
    (before, _), (after, floor) = pooled(found.before), pooled(found.after)
    placed = tuple(p.effect.identity for p in found.found.point.placed)
    return Traced(len(found.found.rounds), placed, before, after, floor)


def on_silverbox() -> OnSilverbox:
    """Return what a trace of the Silverbox's part to train on finds, and what that is worth."""
    config = load_model(silverbox_data.MODEL)
    with tempfile.TemporaryDirectory() as folder, local_workers(config) as workers:
        log = silverbox_data.imported(silverbox_data.TRAIN, Path(folder))
        found = trace([log], config, all_effects, workers, lambda *_: None)
        unseen = silverbox_data.imported(silverbox_data.TEST, Path(folder))
        record = trace_record(read_log(unseen), config)
        after = model_after(found)
        alone = tuple(e for e in after.effects if e.effect == "stiffness.cubic")
        cubic = None
        if alone:
            cubic, _ = refit([log], after.model_copy(update={"effects": alone}), workers, _quietly)

    def error(point: WorkingPoint) -> float:
        run = free_run(point, record)
        # What is before is copied from the measured record.
        return float(np.sqrt(np.mean((record.gap - run.gap)[run.counts_from :] ** 2)))

    point = found.found.point
    keys = tuple(p.effect.key for p in point.placed)
    with_cube = None if cubic is None else error(cubic)
    return OnSilverbox(keys, error(found.declared), with_cube, error(point))


def _quietly(*_: object) -> None:
    return


def _apart(call: Callable[..., object], *arguments: object) -> Outcome:
    outcome = measure_apart(call, *arguments, timeout_s=TIMEOUT_S, memory_bytes=MEMORY_BYTES)
    if outcome.failed:
        raise SystemExit(f"failed: {outcome.failed}")
    return outcome


def _session(duration_s: float, quick: bool) -> dict[str, object]:
    """Return a session of records of one length, every kind of record in either half."""
    each_s = duration_s / 3
    back_and_forth = [
        {"to_m": to_m, "velocity_m_s": speed, "acceleration_m_s2": 2.0, "dwell_s": 0.5}
        for speed in (0.05, 0.1, 0.2, 0.3)
        for to_m in (0.1, -0.1)
    ]
    moving = {"duration_s": duration_s, "beam": back_and_forth}

    def wrench(name: str, beam_m: float, scale: float) -> list[dict[str, object]]:
        record = {"name": name, "excite": WRENCH, "each_s": each_s, "scale": scale}
        return [{"move": {"beam_m": beam_m}}, {"record": record}]

    def coils(name: str, some: Sequence[str], scale: float) -> dict[str, object]:
        # Whole periods of 4 s: 60 s are 15, five coils have three each.
        return {"record": {"name": name, "excite": list(some), "each_s": 12.0, "scale": scale}}

    still = {"record": {"name": "still", "duration_s": duration_s}}
    if quick:
        steps = [still, *wrench("left", -0.1, 1.0), *wrench("middle", 0.0, 0.5)]
    else:
        steps = [
            still,
            *wrench("left-full", -0.1, 1.0),
            *wrench("middle-half", 0.0, 0.5),
            {"record": {"name": "sweep", **moving}},
            coils("coils-a-full", COILS[:5], 1.0),
            coils("coils-b-half", COILS[4:], 0.5),
            *wrench("right-half", 0.1, 0.5),
            *wrench("middle-full", 0.0, 1.0),
            {"record": {"name": "sweep-excited", "excite": WRENCH, "scale": 0.5, **moving}},
            coils("coils-b-full", COILS[4:], 1.0),
            coils("coils-a-half", COILS[:5], 0.5),
            *wrench("left-half", -0.1, 0.5),
        ]
    return {
        **read_mapping(shipped("sessions/trace.yaml")),
        "name": "trace-time",
        "seed": 1,
        "steps": [{"levitate": {}}, *steps, {"move": {"beam_m": 0.0}}, {"land": {}}],
        "then": [],
    }


if __name__ == "__main__":
    run("Trace", measure)
