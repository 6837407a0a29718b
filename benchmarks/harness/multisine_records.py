"""Records of the nominal rig under orthogonal multisines, as long as white noise would take."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from levid.benchmarks.harness.virtual_flight import fly_session
from levid.config.base import read_mapping
from levid.config.shipped import shipped

SESSION = shipped("sessions/multisine-1khz.yaml")
PERIODS, PERIOD_S = 4, 5.0
"""Of each experiment; the first period is lost to the transient. Three of these make a minute."""


def fly_multisines(
    out: Path, beams_m: Sequence[float], duration_s: float, seed: int
) -> tuple[Path, ...]:
    """Fly multisines at all inputs for `duration_s` an input at each position; return the logs.

    As many realisations as the time allows, at least one. `seed` decides phases, lines and noise.
    """
    shipped_session = read_mapping(SESSION)
    excitations = {
        name: {**excitation, "period_s": PERIOD_S}
        for name, excitation in shipped_session["excitations"].items()
    }
    realisations = max(int(duration_s / (PERIODS * PERIOD_S)), 1)
    record = {
        "excite": ["psi", "theta", "z"],
        "orthogonal": {"realisations": realisations, "periods": PERIODS},
    }
    steps: list[dict[str, object]] = [{"levitate": {}}]
    for beam_m in beams_m:
        steps.append({"move": {"beam_m": beam_m}})
        steps.append({"record": {"name": f"multisines-at-{1e3 * beam_m:.0f}mm", **record}})
    steps += [{"move": {"beam_m": 0.0}}, {"land": {}}]
    session = {**shipped_session, "seed": seed, "excitations": excitations, "steps": steps}
    return fly_session(session, out)
