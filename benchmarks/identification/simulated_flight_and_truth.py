"""Fly the nominal rig for identification, and compare a response with that of its known plant."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from levid.benchmarks.harness.virtual_flight import RIG, fly_session, truth
from levid.config.base import read_mapping
from levid.config.shipped import shipped
from levid.sim.true_response import frequency_response

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

BAND_HZ = (1.0, 64.0)
LAG_S = 0.3e-3
"""Of the current loops, as config/models/rig.yaml declares it."""
_NOISE = {
    1_000: shipped("sessions/white-noise-1khz.yaml"),
    10_000: shipped("sessions/white-noise-10khz.yaml"),
}
"""By rate in Hz; the excitation has the same density at either."""


def fly_white_noise(
    out: Path,
    rate_hz: int,
    beams_m: Sequence[float],
    duration_s: float,
    seed: int,
    sweep_s: float = 0.0,
) -> tuple[Path, ...]:
    """Fly white noise at psi, theta and z in turn at each beam position; return the records' logs.

    `duration_s` for each input; a beam sweep of `sweep_s` follows, if that is above 0.
    """
    steps: list[dict[str, object]] = []
    for beam_m in beams_m:
        steps.append({"move": {"beam_m": beam_m}})
        for axis in ("psi", "theta", "z"):
            name = f"{axis}-at-{1e3 * beam_m:.0f}mm"
            steps.append({"record": {"name": name, "duration_s": duration_s, "excite": [axis]}})
    if sweep_s:
        way = [{"to_m": to_m, "dwell_s": 0.5} for to_m in (0.08, -0.08)]
        steps.append({"record": {"name": "sweep", "duration_s": sweep_s, "beam": way}})
    steps = [{"levitate": {}}, *steps, {"move": {"beam_m": 0.0}}, {"land": {}}]
    session = {**read_mapping(_NOISE[rate_hz]), "seed": seed, "steps": steps, "then": []}
    rig = {**read_mapping(RIG), "model": read_mapping(shipped("models/rig.yaml"))}
    return fly_session(session, out, rig=rig)


def true_response(beam_m: float, freq_hz: Array, rate_hz: float) -> Complex:
    """Return the known plant P (F, 3, 3) at freq_hz (F,)."""
    return frequency_response(truth(), beam_m, freq_hz, rate_hz)


def diagonal_ratio(P: Complex, true: Complex) -> Complex:
    """Return the diagonals (F, 3) of P over those of the truth."""
    return np.asarray(np.einsum("fii->fi", P) / np.einsum("fii->fi", true))


def worst(ratios: Sequence[Complex]) -> tuple[float, float]:
    """Return the largest error of these ratios, in dB and degrees; nan where one is not finite."""
    every = np.concatenate([np.ravel(ratio) for ratio in ratios])
    if not np.all(np.isfinite(every)):
        return np.nan, np.nan
    dB = np.abs(20 * np.log10(np.abs(every))).max()
    return float(dB), float(np.abs(np.angle(every, deg=True)).max())
