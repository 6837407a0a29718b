"""One plant of the zoo: flown with its effects, and its logs traced, blind to what they are."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from threadpoolctl import threadpool_limits

from levid.benchmarks.harness import declared_model
from levid.benchmarks.harness.code_version import FLYING, canonical
from levid.benchmarks.harness.code_version import code_version as digest_of
from levid.benchmarks.harness.declared_model import off_by_a_tenth
from levid.benchmarks.trace.zoo_cases import wherever
from levid.config.base import ConfigError, parse, read_mapping
from levid.config.rig import RigConfig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.daemon.control.faults import FlightFault
from levid.daemon.loop.virtual_session import fly_virtually
from levid.identification.trace.residual.error_metric import pooled
from levid.identification.trace.result import model_after, summary
from levid.identification.trace.study import refit, trace
from levid.identification.trace.worker_pool import Alone
from levid.log.reader import read_log
from levid.model.effects.table import all_effects

RIG = shipped("rigs/loopback.yaml")
SIM = shipped("sims/nominal.yaml")
MODEL = shipped("models/rig.yaml")
SESSION = shipped("sessions/trace-short.yaml")
HIGHEST_GAP_M = 0.85e-3
"""Beyond, a corner would touch its stop at 0.9 mm or leave what the sensors read."""
_FREE_OF = ("total_n", "coil_rms_n", "gap_m_s", "tilt_rad")
"""Limits that plants are flown without: a reading that was stuck and jumps is faster than any
platform, and what becomes of a plant is not to hang on where a lab would end its flight."""
PARTS = (1.0, 0.8, 0.64, 0.51, 0.36, 0.25)
"""Of the size that was asked for, as much as can be flown."""

_TRACING = (
    *FLYING, "log/reader.py", "identification/trace/study.py", "identification/trace/result.py",
    "identification/trace/worker_pool.py", "model/effects/table.py",
)  # fmt: skip
"""What decides how a plant moves, and what is found in its logs."""

Entries = Sequence[dict[str, Any]]


class TooLargeError(Exception):
    """The plant cannot be flown with effects of this size: it meets its stops, or shuts down."""


@dataclass(frozen=True)
class Found:
    """What `levid trace` says of a plant, and the seconds of processor time it all took.

    `summary` is the object that `--json` prints, `placed` the effects of the model it ends with,
    `sensor_sd_m` the noise of a sensor that the summary's errors are in.
    """

    summary: dict[str, Any]
    placed: list[dict[str, Any]]
    sensor_sd_m: float
    highest_gap_m: float
    flight_s: float
    trace_s: float


def fly_and_trace(effects: Entries, seed: int, flights: Path | None = None) -> Found:
    """Fly the nominal plant with `effects` (entries of a SIM.yaml) and trace its logs.

    The declared model is 10 % off. Logs stay in `flights`, if given; the same code does not fly
    them again. Raises TooLargeError.
    """
    config = off_by_a_tenth(seed)
    # One process is one core; it works on one plant.
    with _folder(effects, seed, flights) as folder, threadpool_limits(1):
        begin = time.process_time()
        logs, highest_gap_m = _flown(effects, seed, folder)
        flown = time.process_time()
        found = trace(logs, config, all_effects, Alone(config), lambda *_: None)
        placed = [effect.model_dump() for effect in model_after(found).effects]
        end = time.process_time()
        sd_m = found.found.point.disturbance.sensor_sd
        return Found(summary(found), placed, sd_m, highest_gap_m, flown - begin, end - flown)


def fly_and_refit(effects: Entries, seed: int) -> tuple[float, float]:
    """Fly the same; return the error of the declared model, refitted, and the noise floor, m.

    Both are rms over rows and sensors; the error is infinite where the refitted model runs away.
    Raises TooLargeError.
    """
    config = off_by_a_tenth(seed)
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        logs, _ = fly(effects, seed, Path(folder))
        point, errors = refit(logs, config, Alone(config), lambda *_: None)
    error, floor = pooled(errors)
    sd_m = point.disturbance.sensor_sd
    return (error * sd_m if math.isfinite(error) else math.inf), floor * sd_m


def flies_empty(seed: int) -> bool:
    """Return whether a plant that holds nothing flies what this seed draws, off its stops."""
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        try:
            fly([], seed, Path(folder))
        except TooLargeError:
            return False
    return True


def fly(effects: Entries, seed: int, folder: Path) -> tuple[list[Path], float]:
    """Fly into `folder`; return the records' logs, and how far a corner moved, m.

    Raises TooLargeError.
    """
    sim = folder / "sim.yaml"
    sim.write_text(
        yaml.safe_dump({**read_mapping(SIM), "seed": seed, "effects": list(effects)}), "utf-8"
    )
    session = {**read_mapping(SESSION), "then": [], "seed": seed}
    try:
        flown = fly_virtually(
            parse(rig_plain(), RigConfig, str(RIG)).model_copy(update={"sim": str(sim)}),
            RIG,
            parse(session, SessionConfig, str(SESSION)),
            yaml.safe_dump(session).encode(),
            folder / "logs",
            lambda *_: None,
        )
    except (FlightFault, ConfigError) as error:
        raise TooLargeError(str(error)) from None
    highest = max(float(np.abs(read_log(path).field("gap_m")).max()) for path in flown.records)
    if highest > HIGHEST_GAP_M:
        raise TooLargeError(f"a corner moves {1e3 * highest:.2f} mm")
    return list(flown.records), highest


def rig_plain() -> dict[str, Any]:
    """Return the rig that plants are flown on.

    Its feed-forward has no model: effects were sized where the beam's acceleration moves theta.
    """
    plain = {key: value for key, value in read_mapping(RIG).items() if key != "model"}
    limits = {k: v for k, v in plain["limits"].items() if k not in _FREE_OF}
    carried = {"mass_kg": 7.0, "beam_mass_kg": 1.4, "rods_n_m": 2600}
    return {**plain, "feedforward": carried, "limits": limits}


def code_version(roots: Sequence[str] = _TRACING) -> str:
    """Return a digest of the code that roots need, and of the plant, the model and the session."""
    here = [Path(__file__), Path(declared_model.__file__)]
    return digest_of(roots, here, [RIG, SIM, MODEL, SESSION])


@contextmanager
def _folder(effects: Entries, seed: int, flights: Path | None) -> Iterator[Path]:
    if flights is None:
        with tempfile.TemporaryDirectory() as name:
            yield Path(name)
    else:
        text = canonical([[wherever(entry) for entry in effects], seed, code_version(FLYING)])
        yield flights / hashlib.sha256(text.encode()).hexdigest()[:16]


def _flown(effects: Entries, seed: int, folder: Path) -> tuple[list[Path], float]:
    """Return what `fly` returns, from a flight that ended here before, or a new one."""
    done = folder / "flown.json"
    if done.exists():
        told = json.loads(done.read_text(encoding="utf-8"))
        return [folder / "logs" / name for name in told["records"]], told["highest_gap_m"]
    shutil.rmtree(folder / "logs", ignore_errors=True)  # of a flight that was cut off
    folder.mkdir(parents=True, exist_ok=True)
    records, highest_gap_m = fly(effects, seed, folder)
    told = {"records": [path.name for path in records], "highest_gap_m": highest_gap_m}
    done.write_text(json.dumps(told), encoding="utf-8")
    return records, highest_gap_m
