"""Records of the nominal rig under white noise, flown for a benchmark in virtual time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import yaml

from levid.config.base import parse, read_mapping
from levid.config.rig import load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.config.sim import SimConfig
from levid.daemon.virtual import fly_virtually

SIM = shipped("sims/nominal.yaml")
RIG = shipped("rigs/loopback.yaml")
SESSIONS = {
    1_000: shipped("sessions/white-noise-1khz.yaml"),
    10_000: shipped("sessions/white-noise-10khz.yaml"),
}
"""The shipped sessions by rate in Hz; their excitation has the same density at either."""


def truth() -> SimConfig:
    """Return the simulated rig that `fly` flies."""
    return parse(read_mapping(SIM), SimConfig, str(SIM))


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
    out.mkdir(parents=True, exist_ok=True)
    sim_file = out / "sim.yaml"
    sim_file.write_text(yaml.safe_dump({**read_mapping(SIM), "seed": seed}))
    flown = fly_virtually(
        load_rig(RIG).model_copy(update={"sim": str(sim_file)}),
        RIG,
        parse(session, SessionConfig, "white-noise session"),
        yaml.safe_dump(session).encode(),
        out,
        lambda *_: None,
    )
    sim_file.unlink()
    return tuple(flown.records)
