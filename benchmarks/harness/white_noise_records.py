"""Records of the nominal rig under white noise, flown for a benchmark in virtual time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from levid.benchmarks.harness.virtual_flight import fly_session
from levid.config.base import read_mapping
from levid.config.shipped import shipped

SESSIONS = {
    1_000: shipped("sessions/white-noise-1khz.yaml"),
    10_000: shipped("sessions/white-noise-10khz.yaml"),
}
"""The shipped sessions by rate in Hz; their excitation has the same density at either."""


def fly(
    out: Path, rate_hz: int, beams_m: Sequence[float], duration_s: float, seed: int
) -> tuple[Path, ...]:
    """Fly psi, theta and z for `duration_s` each at each beam position; return the records' logs.

    `seed` decides excitation and noise. The logs go into `out`, and nothing else does.
    """
    shipped_session = read_mapping(SESSIONS[rate_hz])
    steps: list[dict[str, object]] = [{"levitate": {}}]
    for beam_m in beams_m:
        steps.append({"move": {"beam_m": beam_m}})
        for axis in ("psi", "theta", "z"):
            name = f"{axis}-at-{1e3 * beam_m:.0f}mm"
            steps.append({"record": {"name": name, "duration_s": duration_s, "excite": [axis]}})
    steps += [{"move": {"beam_m": 0.0}}, {"land": {}}]
    session = {**shipped_session, "name": "white-noise", "seed": seed, "steps": steps, "then": []}
    return fly_session(session, out)
