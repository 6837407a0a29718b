"""Fly a session on the nominal rig in virtual time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml

from levid.config.base import parse, read_mapping
from levid.config.rig import RigConfig, load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.config.sim import SimConfig
from levid.daemon.loop.virtual_session import fly_virtually

SIM = shipped("sims/nominal.yaml")
RIG = shipped("rigs/loopback.yaml")


def truth() -> SimConfig:
    """Return the simulated rig that `fly_session` flies."""
    return parse(read_mapping(SIM), SimConfig, str(SIM))


def fly_session(
    session: Mapping[str, object],
    out: Path,
    effects: Sequence[Mapping[str, object]] = (),
    rig: Mapping[str, object] | None = None,
    sim: Path = SIM,
) -> tuple[Path, ...]:
    """Fly a session, its seed the plant's too; return the records' logs.

    `effects` as in a SIM.yaml; `rig` as in a RIG.yaml, the shipped loopback rig by default; `sim`:
    SIM.yaml. `out` then contains the logs only.
    """
    out.mkdir(parents=True, exist_ok=True)
    sim_file = out / "sim.yaml"
    plant = {**read_mapping(sim), "seed": session["seed"], "effects": [dict(e) for e in effects]}
    sim_file.write_text(yaml.safe_dump(plant))
    flown_rig = load_rig(RIG) if rig is None else parse(rig, RigConfig, str(RIG))
    flown = fly_virtually(
        flown_rig.model_copy(update={"sim": str(sim_file)}),
        RIG,
        parse(dict(session), SessionConfig, f"session '{session['name']}'"),
        yaml.safe_dump(dict(session)).encode(),
        out,
        lambda *_: None,
    )
    sim_file.unlink()
    return tuple(flown.records)
