"""A status as the daemon gives it, of a rig with any number of coils and sensors in flight."""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml

from levid.config.base import parse_text
from levid.config.rig import RigConfig
from levid.config.shipped import shipped
from levid.daemon.supervision.live_readings import last_cycle, live_readings, recent_rows
from levid.log.signals import cycle_dtype

QUANTILES = {"p50": 12.0, "p99": 45.0, "p99.9": 80.0, "max": 230.0}


def rig_with(coils: int = 9, sensors: int = 9) -> RigConfig:
    """Return the loopback rig with coils and sensors on a circle."""
    plain = yaml.safe_load(shipped("rigs/loopback.yaml").read_text())
    geometry = {}
    for what, n in (("coil", coils), ("sensor", sensors)):
        angle = 2 * np.pi * np.arange(n) / n
        geometry[f"{what}_x_m"] = (0.12 * np.cos(angle)).tolist()
        geometry[f"{what}_y_m"] = (0.12 * np.sin(angle)).tolist()
    plain["geometry"] = geometry
    return parse_text(yaml.safe_dump(plain), RigConfig, "rig.yaml")


def rows_in_flight(rig: RigConfig, noise_m: float = 1e-7) -> np.ndarray:
    """Return rows of a platform 12.3 um above the working point, with white noise before."""
    coils, sensors = len(rig.geometry.coil_x_m), len(rig.geometry.sensors_x_m)
    rows = np.zeros(recent_rows(rig), cycle_dtype(coils, sensors))
    draw = np.random.default_rng(7).normal
    rows["gap_m"] = 12.3e-6 + draw(0, noise_m, rows["gap_m"].shape)
    rows["z_m"] = 12.3e-6 + draw(0, noise_m, len(rows))
    rows["psi_rad"] = -45e-6 + draw(0, 3e-7, len(rows))
    rows["z_m"][-1], rows["psi_rad"][-1] = 12.3e-6, -45e-6  # the newest, which is shown
    rows["coil_n"] = 7.63
    rows["beam_m"] = 0.05
    rows["lateness_s"], rows["execution_s"] = 17e-6, 131e-6
    return rows


def status_in_flight(rig: RigConfig | None = None, **more: Any) -> dict[str, Any]:
    """Return the status of a session in flight; `more` replaces keys."""
    rig = rig or rig_with()
    rows = rows_in_flight(rig)
    heat = np.full(len(rig.geometry.coil_x_m), 49.0)
    timing = {f"{name}_us": QUANTILES for name in ("lateness", "execution")}
    return {
        "rig": rig.name,
        "rate_hz": rig.rate_hz,
        "state": "EXCITING",
        "cycle": 12345,
        "late": 3,
        "stale": 0,
        "lost": 0,
        "fault": "NONE",
        "detail": "",
        "fault_log": "",
        "session": "white-noise",
        "step": "tilt",
        "share": 0.25,
        "left_s": 72.0,
        "recording": "",
        "log_lost": "",
        "log": "/data/today/01-tilt.mcap",
        "log_folder": "/data/today",
        "recorder_restarts": 0,
        "clients_gone": 0,
        "flooded_s": 0.0,
        "memory_stalled_s": 0.0,
        "stolen_s": 0.0,
        "z_m": 12.3e-6,
        "beam_m": 0.05,
        **live_readings(rows, heat, rig),
        "events": [{"time_s": 1.0, "text": "loopback at 1000 Hz"}],
        "preflight": [],
        "timing": {
            **timing,
            "late_by": {"wake_up": 3, "drivers": 0, "control": 0},
            "last": last_cycle(rows),
        },
        **more,
    }
