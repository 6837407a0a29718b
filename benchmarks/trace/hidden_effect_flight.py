"""Fly a plant with hidden effects and trace its logs; the trace gets nothing but the logs."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from levid.benchmarks.harness.inaccurate_model import off_by_a_tenth
from levid.benchmarks.harness.virtual_flight import RIG, fly_session
from levid.config.base import ConfigError, read_mapping
from levid.config.shipped import shipped
from levid.daemon.control.faults import FlightFault
from levid.identification.trace.found_effects_summary import summary
from levid.identification.trace.run_trace import trace
from levid.identification.trace.traced_model import model_after
from levid.identification.trace.worker_pool import Alone
from levid.log.reader import read_log
from levid.model.effects.candidate_effects import all_effects

SESSION = shipped("sessions/trace-short.yaml")
HIGHEST_GAP_M = 0.85e-3
"""Beyond, a corner touches its stop at 0.9 mm or leaves the sensors' range."""
_WITHOUT_LIMITS = ("total_n", "coil_rms_n", "gap_m_s", "tilt_rad")
"""A stuck reading jumps faster than any platform moves; the result must not depend on a fault."""

Entries = Sequence[Mapping[str, Any]]


class CannotFlyError(Exception):
    """With these effects and this seed the plant reaches its stops or a fault."""


@dataclass(frozen=True)
class Found:
    """What `levid trace` reports of a plant.

    summary: the output of `--json`. placed: effects of the model it ends with. sensor_sd_m: the
    unit of the summary's errors.
    """

    summary: dict[str, Any]
    placed: list[dict[str, Any]]
    sensor_sd_m: float


def fly_and_trace(effects: Entries, seed: int) -> Found:
    """Fly the nominal plant with `effects` (entries of a SIM.yaml) and trace its logs.

    The declared model is 10 % off. Raises CannotFlyError.
    """
    config = off_by_a_tenth(seed)
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        found = trace(
            fly(effects, seed, Path(folder)), config, all_effects, Alone(config), lambda *_: None
        )
        placed = [effect.model_dump() for effect in model_after(found).effects]
        sd_m = found.found.point.disturbance.sensor_sd
        return Found(summary(found), placed, sd_m)


def rig() -> dict[str, Any]:
    """Return the rig that plants are flown on.

    Its feed-forward has no model: effects were sized where the beam's acceleration moves theta.
    """
    plain = {key: value for key, value in read_mapping(RIG).items() if key != "model"}
    limits = {k: v for k, v in plain["limits"].items() if k not in _WITHOUT_LIMITS}
    carried = {"mass_kg": 7.0, "beam_mass_kg": 1.4, "rods_n_m": 2600}
    return {**plain, "feedforward": carried, "limits": limits}


def fly(effects: Entries, seed: int, folder: Path) -> list[Path]:
    """Fly trace-short.yaml into `folder`; return the records' logs. Raises CannotFlyError."""
    session = {**read_mapping(SESSION), "then": [], "seed": seed}
    try:
        logs = list(fly_session(session, folder, effects, rig()))
    except (FlightFault, ConfigError) as error:
        raise CannotFlyError(str(error)) from None
    highest = max(float(np.abs(read_log(path).field("gap_m")).max()) for path in logs)
    if highest > HIGHEST_GAP_M:
        raise CannotFlyError(f"a corner moves {1e3 * highest:.2f} mm")
    return logs
