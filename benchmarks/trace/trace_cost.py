"""The cost of a trace: time, its growth with the data, memory; and a trace of measured data.

Twelve records of 60 s at 1 kHz (three of 24 s with --quick) of a plant with two undeclared effects
are traced: a quarter, half and all of them, with a process per core; the declared model is 10 %
off. If the Silverbox data are at hand, its linear model is traced on the training part and judged
on the test part, with and without the effects found (not with --quick).
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
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
from levid.identification.trace.trace_logs import refit, trace
from levid.identification.trace.worker_pool import local_workers
from levid.log.reader import read_log
from levid.model.effects.candidate_effects import all_effects

EFFECTS = {
    "rod_stiffness.cubic@z": {
        "use": "levid.sim.effects.stiffness:CubicRods", "dof": "z", "k3_n_m3": 5e8
    },
    "coil_gain@coil:3": {"use": "levid.sim.effects.coils:CoilGain", "coil": 3, "excess": 0.05},
}  # fmt: skip
"""The undeclared effects by their identity in the table of effects."""
MEMORY_BYTES, TIMEOUT_S = 16_000_000_000, 1800.0
WRENCH = ["psi", "theta", "z"]
COILS = [f"coil-{i}" for i in range(9)]
SECONDS, GROWTH = Target(most=120.0), Target(most=1.15)
"""For all twelve records. In proportion to the data is 1; the rest allows for a busy machine."""
CUBIC_MV, TRACED_MV, NAMED = Target(most=0.65), Target(most=0.40), Target(least=1.0)


def measure(quick: bool) -> Iterator[Figure]:
    yield Figure("cores", os.cpu_count() or 1, "", "cores, and processes of a trace")
    duration_s, seconds = 24.0 if quick else 60.0, {}
    with tempfile.TemporaryDirectory() as folder:
        logs = fly_session(_session(duration_s, quick), Path(folder), list(EFFECTS.values()))
        parts = {"all": 1} if quick else {"quarter": 4, "half": 2, "all": 1}
        for name, part in parts.items():
            some = logs[: len(logs) // part]
            outcome = _apart(found_in, some)
            seconds[len(some)] = outcome.seconds
            target = SECONDS if name == "all" and not quick else None
            label = f"trace of {len(some)} records of {duration_s:g} s"
            yield Figure(f"{name}_s", outcome.seconds, "s", label, target=target)
            yield Figure(f"{name}_gb", outcome.peak_bytes / 1e9, "GB", "largest process")
            yield from _found(name, *outcome.value)
    if not quick:
        # The exponent of the number of records that the time is proportional to.
        growth = np.polyfit(np.log(list(seconds)), np.log(list(seconds.values())), 1)[0]
        label = "time grows with the data to the power of"
        yield Figure("growth", float(growth), "", label, target=GROWTH)
        yield from silverbox()


def _found(name: str, placed: Sequence[str], before: float, after: float) -> Iterator[Figure]:
    flown = len({*placed} & {*EFFECTS})
    yield Figure(f"{name}_flown", flown, "", f"of {len(EFFECTS)} effects flown are found")
    yield Figure(f"{name}_others", len(placed) - flown, "", "effects found beside them")
    yield Figure(f"{name}_before", before, "x floor", "error of the declared model")
    yield Figure(f"{name}_after", after, "x floor", "error of the model with effects")


def found_in(logs: Sequence[Path]) -> tuple[tuple[str, ...], float, float]:
    """Return the effects that a trace finds, and the error over the floor before and after."""
    config = off_by_a_tenth(1)
    with local_workers(config) as workers:
        found = trace(logs, config, all_effects, workers, _silent)
    (before, _), (after, floor) = pooled(found.before), pooled(found.after)
    placed = tuple(p.effect.identity for p in found.found.point.placed)
    return placed, before / floor, after / floor


def silverbox() -> Iterator[Figure]:
    """Yield the figures of measured data; their values are None without the data."""
    outcome = _apart(errors_on_silverbox) if silverbox_data.SOURCE.exists() else None
    placed, mv = (None, {}) if outcome is None else outcome.value
    seconds = None if outcome is None else outcome.seconds
    yield Figure("silverbox_s", seconds, "s", "Silverbox: trace of the training part")
    for name, label, target in (
        ("linear", "test error of the linear model", None),
        ("traced", "with the effects found", TRACED_MV),
        ("cubic", "with the cubic stiffness alone, refitted", CUBIC_MV),
    ):
        # The first 5 s of the test part estimate state and offset.
        versus = "silverbox_linear_mv" if target else None
        yield Figure(f"silverbox_{name}_mv", mv.get(name), "mV", label, versus, target)
    for name, target in (("cubic", NAMED), ("asymmetric", None)):
        named = None if placed is None else float(f"stiffness.{name}" in placed)
        yield Figure(f"silverbox_{name}", named, "", f"{name} stiffness named", target=target)
    count = None if placed is None else len(placed)
    yield Figure("silverbox_effects", count, "", "effects named")


def errors_on_silverbox() -> tuple[tuple[str, ...], dict[str, float]]:
    """Return the effects that a trace of the training part finds, and test errors in mV rms.

    linear: of the declared model, refitted. cubic: with the cubic stiffness alone, refitted; absent
    if it was not found. traced: with all effects found.
    """
    config = load_model(silverbox_data.MODEL)
    with tempfile.TemporaryDirectory() as folder, local_workers(config) as workers:
        log = silverbox_data.imported(silverbox_data.TRAIN, Path(folder))
        found = trace([log], config, all_effects, workers, _silent)
        test = silverbox_data.imported(silverbox_data.TEST, Path(folder))
        record = trace_record(read_log(test), config)
        points = {"linear": found.declared, "traced": found.found.point}
        after = model_after(found)
        cube = tuple(e for e in after.effects if e.effect == "stiffness.cubic")
        if cube:
            only_cube = after.model_copy(update={"effects": cube})
            points["cubic"], _ = refit([log], only_cube, workers, _silent)

    def error(point: WorkingPoint) -> float:
        free = free_run(point, record)
        return 1e3 * float(np.sqrt(np.mean((record.gap - free.gap)[free.counts_from :] ** 2)))

    keys = tuple(p.effect.key for p in found.found.point.placed)
    return keys, {name: error(point) for name, point in points.items()}


def _silent(*_: object) -> None:
    return


def _apart(call: Callable[..., object], *arguments: object) -> Outcome:
    outcome = measure_apart(call, *arguments, timeout_s=TIMEOUT_S, memory_bytes=MEMORY_BYTES)
    if outcome.failed:
        raise SystemExit(f"failed: {outcome.failed}")
    return outcome


def _session(duration_s: float, quick: bool) -> dict[str, object]:
    """Return a session of records of one length, with each kind of record in both halves."""
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
    run("The cost of a trace", measure)
