"""`levid check`: read files as strictly as the daemon would, touch no device."""

from __future__ import annotations

from pathlib import Path

import click

from ..config.base import ConfigError, Strict
from ..config.kinds import load_any
from ..config.model import ModelConfig
from ..config.rig import RigConfig, load_rig
from ..config.session import SessionConfig
from ..config.shipped import shipped
from ..config.sim import SimConfig
from ..daemon.plan import plan_session
from ..drivers.base import Context
from ..drivers.registry import check_backends
from ..identification.declared import declared_model
from ..log.errors import LogError
from ..log.reader import read_log
from ..model.declared import ModelError
from ..model.geometry import GeometryError, decoupling_matrix


@click.command("check")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--rig",
    "rig_path",
    type=click.Path(path_type=Path),
    help="Rig that sessions are checked against; the shipped loopback rig unless given.",
)
def command(files: tuple[Path, ...], rig_path: Path | None) -> int:
    """Check FILES: rigs, simulators, sessions, models, signals, and logs (.mcap).

    Every problem is one line that names file, key, what was expected and what came. No device is
    touched. Exit code 0 when all is well, 1 otherwise.

    \b
    Examples:
      levid check config/rigs/loopback.yaml config/sessions/beam.yaml
      levid check out/first/*.mcap
    """
    bad = 0
    for path in files:
        try:
            click.echo(f"{path}: {_check(path, rig_path)}")
        except (ConfigError, LogError) as error:
            click.echo(f"{error}", err=True)
            bad += 1
    return 1 if bad else 0


def _check(path: Path, rig_path: Path | None) -> str:
    if path.suffix == ".mcap":
        log = read_log(path)
        seconds = len(log.rows) / log.rate_hz
        ending = "" if log.complete else "; cut off, this is what is left"
        return f"log, {len(log.rows)} records at {log.rate_hz:g} Hz ({seconds:.1f} s){ending}"
    config = load_any(path, _more_kinds())
    match config:
        case RigConfig():
            return _rig(config, path)
        case SessionConfig():
            rig = load_rig(rig_path or shipped("rigs/loopback.yaml"))
            plan = plan_session(config, rig)
            records = sum(step.kind == "record" for step in plan.steps)
            return (
                f"session, {len(plan.steps)} steps, {records} records, "
                f"{plan.cycles / plan.rate_hz:.0f} s at {plan.rate_hz:g} Hz"
            )
        case ModelConfig():
            return _model(config, path)
        case SimConfig():
            effects = len(config.effects)
            return f"simulator, plant {config.plant}, {effects or 'no'} effects"
    return str(getattr(config, "levid", "ok"))


def _rig(rig: RigConfig, path: Path) -> str:
    try:
        decoupling_matrix(rig.geometry.coil_x_m, rig.geometry.coil_y_m)
        decoupling_matrix(rig.geometry.sensors_x_m, rig.geometry.sensors_y_m)
    except GeometryError as error:
        raise ConfigError(f"{path}: geometry: {error}") from None
    try:
        check_backends(Context(rig, 1 / rig.rate_hz, path.parent))
    except ConfigError as error:
        named = str(error).startswith(str(path.parent))
        raise ConfigError(f"{'' if named else f'{path}: '}{error}") from None
    return f"rig, {len(rig.geometry.coil_x_m)} coils, {rig.rate_hz:g} Hz"


def _model(config: ModelConfig, path: Path) -> str:
    try:
        model = declared_model(config)
        model.at()
    except ModelError as error:
        raise ConfigError(f"{path}: {error}") from None
    return f"model, {len(model.dof)} DOF, {len(model.values)} parameters"


def _more_kinds() -> dict[str, type[Strict]]:
    from ..log.signals_file import SignalsFile

    return {"signals": SignalsFile}
