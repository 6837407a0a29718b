"""Measure how far theta strays while the beam moves, with and without the feed-forward's model.

Flies `config/sessions/beam.yaml` in virtual time. The m_b of one rig's model is 10 % too small: the
feed-forward is as good as the model.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from levid.benchmarks.harness.benchmark_runner import Figure, Target, run
from levid.benchmarks.harness.virtual_flight import RIG, fly_session
from levid.config.base import read_mapping
from levid.config.shipped import shipped
from levid.log.reader import read_log

SETTLED_S = 3.0
"""Time after the start of a record that does not count: the beam accelerates from rest."""
NUMBERS = {"mass_kg": 7.0, "beam_mass_kg": 1.4, "rods_n_m": 2600}
"""`feedforward` of the rigs that were shipped before a rig could name its model."""


def measure(quick: bool) -> Iterator[Figure]:
    """Yield the RMS of theta in µrad, at rest and in the sweep; `quick` on one simulator."""
    model = read_mapping(shipped("models/rig.yaml"))
    shipped_rig = read_mapping(RIG)
    without_model = {key: value for key, value in shipped_rig.items() if key != "model"}
    rigs: tuple[Mapping[str, Any], ...] = (
        {**shipped_rig, "model": model},
        {**without_model, "feedforward": NUMBERS},
        {**shipped_rig, "model": _scaled(model, "m_b", 0.9)},
    )
    for sim in ("nominal",) if quick else ("nominal", "rig"):
        found = [theta_urad(rig, shipped(f"sims/{sim}.yaml")) for rig in rigs]
        (rest, theta), (_, numbers), (_, light) = found
        yield Figure(f"still_{sim}", rest, "urad", f"theta at rest, {sim} simulator")
        yield Figure(f"numbers_{sim}", numbers, "urad", f"in the sweep, rig without a model, {sim}")
        label, most = f"in the sweep, rig with its model, {sim}", Target(most=0.1 * numbers)
        yield Figure(f"model_{sim}", theta, "urad", label, target=most)
        yield Figure(f"light_beam_{sim}", light, "urad", f"the same, m_b 10 % too small, {sim}")


def theta_urad(rig: Mapping[str, Any], sim: Path) -> tuple[float, float]:
    """Return the RMS deviation of theta from its reference in µrad: still record, sweep."""
    session = {**read_mapping(shipped("sessions/beam.yaml")), "then": [], "seed": 1}
    with tempfile.TemporaryDirectory() as folder:
        logs = [read_log(path) for path in fly_session(session, Path(folder), rig=rig, sim=sim)]
        still, sweep = (_rms_urad(log.rows) for log in logs)
    return still, sweep


def _rms_urad(rows: np.ndarray[Any, np.dtype[np.void]]) -> float:
    late = rows["time_s"] >= rows["time_s"][0] + SETTLED_S
    error = (rows["theta_rad"] - rows["theta_ref_rad"])[late].astype(float)
    return float(1e6 * np.sqrt(np.mean(error**2)))


def _scaled(model: Mapping[str, Any], name: str, factor: float) -> dict[str, Any]:
    parameters = {key: dict(value) for key, value in model["parameters"].items()}
    parameters[name]["value"] *= factor
    return {**model, "parameters": parameters}


if __name__ == "__main__":
    run("Feed-forward", measure)
