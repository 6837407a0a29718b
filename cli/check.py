"""`levid check`: validate configuration and log files as the daemon does, without a device."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .path_types import FOLDER, RIG, YAML_OR_LOG
from .progress import counted_progress

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..config.model import ModelConfig
    from ..config.rig import RigConfig
    from ..config.session import SessionConfig
    from ..config.sim import SimConfig
    from ..daemon.planning.rig_plausibility import Problem
    from ..model.effects.base import Places


_LEAST_REPORTED = 1e-3
"""Nonlinear share of the feed-forward above which it is reported."""


@click.command("check")
@click.argument("files", nargs=-1, required=True, type=YAML_OR_LOG)
@click.option(
    "--rig",
    "rig_path",
    type=RIG,
    help="RIG.yaml to check sessions against. Default: the rig among FILES, else the shipped "
    "loopback rig.",
)
@click.option(
    "--preflight",
    "before_flight",
    is_flag=True,
    help="Run the checks that the daemon runs before lift-off: of --rig, of this machine and of "
    "each session.",
)
@click.option(
    "--out",
    type=FOLDER,
    help="With --preflight, the folder for the logs. Default: this folder.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of text.")
def command(
    files: tuple[Path, ...],
    rig_path: Path | None,
    before_flight: bool,
    out: Path | None,
    as_json: bool,
) -> int:
    """Check FILES: rigs, simulators, sessions, models, signals, and logs (.mcap).

    Prints one line a file. Each mistake is reported on its own line: file, key, what was expected
    and what was found. No device is accessed. Exit code 0 if all files can be used (a truncated
    log can), else 1.

    \b
    Examples:
      levid check loopback beam
      levid check out/first/*.mcap
      levid check --preflight my-rig.yaml my-session.yaml --out /data/today
      levid check --json *.yaml
    """
    from ..config.base import ConfigError
    from ..log.errors import LogError

    if before_flight:
        return _preflight(files, rig_path, out, as_json)
    if rig_path is None:
        rig_path = _only_rig(files)
    results = []
    for path in files:
        try:
            found, usable = _check(path, rig_path), True
            if not as_json:
                click.echo(f"{path}: {found}")
        except (ConfigError, LogError, OSError) as error:
            found, usable = str(error), False
            if isinstance(error, OSError):
                found = f"{path}: {error.strerror or error}"
            if not as_json:
                click.echo(found, err=True)
        results.append({"file": str(path), "usable": usable, "found": found})
    if as_json:
        click.echo(json.dumps({"files": results}))
    return 0 if all(result["usable"] for result in results) else 1


def _preflight(
    files: tuple[Path, ...], rig_path: Path | None, out: Path | None, as_json: bool
) -> int:
    from ..config.load_any_kind import load_any
    from ..config.rig import RigConfig
    from ..config.session import SessionConfig
    from ..config.shipped import shipped
    from .preflight import preflight

    rigs, sessions = [], []
    for path in files:
        loaded = load_any(path, {})
        if isinstance(loaded, RigConfig):
            rigs.append(path)
        elif isinstance(loaded, SessionConfig):
            sessions.append(path)
        else:
            raise click.UsageError(f"--preflight: expected rigs and sessions, found {path}")
    if rig_path is not None:
        rigs.append(rig_path)
    if len(rigs) > 1:
        raise click.UsageError(f"--preflight: expected one rig, found {len(rigs)}")
    rig = rigs[0] if rigs else shipped("rigs/loopback.yaml")
    return preflight(rig, sessions, out, as_json)


def _only_rig(files: Sequence[Path]) -> Path | None:
    """Return the rig among files if there is just one; other mistakes are reported later."""
    from ..config.base import ConfigError, read_mapping

    rigs = []
    for path in files if len(files) > 1 else ():
        if path.suffix != ".mcap":
            with contextlib.suppress(ConfigError):
                rigs += [path] if read_mapping(path).get("levid") == "rig" else []
    return rigs[0] if len(rigs) == 1 else None


def _check(path: Path, rig_path: Path | None) -> str:
    if path.suffix == ".mcap":
        return _log(path)
    from ..config.load_any_kind import load_any
    from ..config.model import ModelConfig
    from ..config.rig import RigConfig
    from ..config.session import SessionConfig
    from ..config.sim import SimConfig
    from ..log.importing.signals_yaml import SignalsFile

    summary = "ok"
    match load_any(path, {"signals": SignalsFile}):
        case RigConfig() as rig:
            summary = _rig(rig, path)
        case SessionConfig() as session:
            summary = _session(session, path, rig_path)
        case ModelConfig() as model:
            summary = _model(model, path)
        case SimConfig() as sim:
            summary = _sim(sim, path)
        case SignalsFile() as signals:
            rate = "the rate of its time" if signals.rate_hz is None else f"{signals.rate_hz:g} Hz"
            summary = f"signals, {len(signals.columns)} columns at {rate}"
    return summary


def _log(path: Path) -> str:
    from ..log.reader import read_log

    log = read_log(path)
    n = len(log.rows)
    # Skipped periods have no row but count as time.
    seconds = (_periods(log.rows) or n) / log.rate_hz
    ending = "" if log.complete else f"; truncated, these rows can be read: {log.problem}"
    return f"log, {n} rows at {log.rate_hz:g} Hz ({seconds:.1f} s){ending}"


def _periods(rows: NDArray[np.void]) -> int:
    """Return the number of periods from first to last row; 0 for logs without a cycle counter."""
    if "cycle" not in (rows.dtype.names or ()) or not rows.size:
        return 0
    cycle = rows["cycle"]
    if cycle.ndim != 1 or cycle.dtype.kind not in "iu":
        return 0
    return max(int(cycle[-1]) - int(cycle[0]) + 1, 0)


def _rig(rig: RigConfig, path: Path) -> str:
    from ..config.base import ConfigError, load_yaml
    from ..config.rig import with_model
    from ..config.sim import SimConfig
    from ..daemon.control.sensor_limits import standing_text, standing_warning, undetectable
    from ..daemon.control.watchdog_times import expiry_warning
    from ..daemon.control.zero_force import NOT_READ_BACK
    from ..daemon.planning.rig_plausibility import rig_problems
    from ..drivers.base import Context
    from ..drivers.open_backends import check_backends, gap_step_m, reads_back
    from ..model.geometry import GeometryError, decoupling_matrix

    try:
        decoupling_matrix(rig.geometry.coil_x_m, rig.geometry.coil_y_m)
        decoupling_matrix(rig.geometry.sensors_x_m, rig.geometry.sensors_y_m)
    except GeometryError as error:
        raise ConfigError(f"{path}: geometry: {error}") from None
    try:
        context = Context(rig, 1 / rig.rate_hz, path.parent)
        budget, step_m = check_backends(context), gap_step_m(context)
    except ConfigError as error:
        names_file = str(error).startswith(f"{path}: ")
        raise ConfigError(f"{'' if names_file else f'{path}: '}{error}") from None
    if not reads_back(Context(rig, 1 / rig.rate_hz, path.parent)):
        warning = f"{NOT_READ_BACK}: a coil that keeps a force or gives none is not detected"
        click.echo(f"{path}: warning: amplifiers: {warning}", err=True)
    if warning := expiry_warning(rig):
        click.echo(f"{path}: warning: {warning}", err=True)
    bus_rate = f"; bus rate limit {1 / budget.cycle_s:.0f} Hz" if budget.buses else ""
    coils = f"{len(rig.geometry.coil_x_m)} coils"
    whole = with_model(rig, path)
    _warn_of_coil_check(whole, path)
    forces, margin = _feed_forward(whole, path), _loop(whole, path)
    sim = None if rig.sim is None else path.parent / rig.sim
    simulator = load_yaml(sim, SimConfig) if sim is not None and sim.exists() else None
    _report(rig_problems(whole, simulator), str(path))
    loopback = simulator if rig.sensors.backend == "loopback" else None
    noise_m = None if loopback is None else loopback.sensors.noise_m
    noisy = standing_warning(whole, context.period_s, step_m, noise_m)
    for warning in filter(None, (*undetectable(rig), noisy)):
        click.echo(f"{path}: warning: {warning}", err=True)
    stands = standing_text(whole, context.period_s, step_m)
    return f"rig, {coils}, {rig.rate_hz:g} Hz{bus_rate}; {forces}{margin}; {stands}"


def _warn_of_coil_check(rig: RigConfig, path: Path) -> None:
    """Print why the daemon cannot check the coils of this rig after lift-off, if it cannot."""
    from ..config.base import ConfigError
    from ..config.session import CoilCheck, Levitate, Step
    from ..daemon.planning.plan import plan_steps

    try:
        plan_steps([Step(levitate=Levitate())], "levitate", rig, 0.0, 0.0, CoilCheck())
    except ConfigError as error:
        click.echo(f"{path}: warning: no coil check after lift-off: {error}", err=True)


def _report(problems: Sequence[Problem], where: str) -> None:
    """Print what is implausible; raise ConfigError if it cannot fly."""
    from ..config.base import ConfigError

    for problem in problems:
        if not problem.fatal:
            click.echo(f"{where}: warning: {problem}", err=True)
    if fatal := [f"{where}: {problem}" for problem in problems if problem.fatal]:
        raise ConfigError("\n".join(fatal))


def _loop(rig: RigConfig, path: Path) -> str:
    """Return the margin of the control loop in words; empty for a rig without a model."""
    from ..config.base import ConfigError
    from ..daemon.control.loop_stability import USUAL_GAIN_FACTOR, loop_stability

    found = loop_stability(rig, 1 / rig.rate_hz)
    if found is None:
        return ""
    if math.isfinite(found.growth_s):
        stable = f"at {found.gain_factor:.2g} times these gains" if found.gain_factor else "at none"
        raise ConfigError(
            f"{path}: control: expected gains with which the loop is stable on the declared model, "
            f"found a deviation that grows by a factor of 2.7 in {found.growth_s:.2g} s; of "
            f"smaller gains, the loop is stable {stable}"
        )
    if found.gain_factor < USUAL_GAIN_FACTOR:
        click.echo(
            f"{path}: warning: control: on the declared model the loop becomes unstable at "
            f"{found.gain_factor:.2g} times these gains; expected {USUAL_GAIN_FACTOR:g} times or "
            "more: lower the gains",
            err=True,
        )
    return f"; stable up to {found.gain_factor:.2g} times the gains"


def _feed_forward(rig: RigConfig, path: Path) -> str:
    """Return the largest coil force of the feed-forward in words, with the linearisation error."""
    from ..config.base import ConfigError
    from ..daemon.control.feed_forward import beam_at_limits, feed_forward, largest_coil_n

    try:
        law = feed_forward(rig, 1 / rig.rate_hz)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    most_n = largest_coil_n(rig, law.wrench(beam_at_limits(rig)))
    text = f"feed-forward up to {most_n:.3g} N a coil"
    left_n = largest_coil_n(rig, law.left_over[None])
    if left_n > _LEAST_REPORTED * most_n:
        text += f" (linear; it differs from the model's force by up to {left_n:.2g} N)"
    return text


def _session(config: SessionConfig, path: Path, rig_path: Path | None) -> str:
    from ..config.base import ConfigError
    from ..config.rig import load_rig
    from ..config.shipped import shipped
    from ..daemon.planning.plan import MOST_CYCLES, plan_session
    from ..daemon.planning.planner import least_cycles
    from ..daemon.planning.session_plausibility import session_problems

    rig = load_rig(rig_path or shipped("rigs/loopback.yaml"))
    rate_hz = config.rate_hz or rig.rate_hz
    least = least_cycles(config, rate_hz)  # before it is planned, which would take hours
    if least > MOST_CYCLES:
        raise ConfigError(
            f"{path}: steps: expected a total of at most {MOST_CYCLES / rate_hz:g} s at "
            f"{rate_hz:g} Hz, found {least / rate_hz:g} s; fly several sessions"
        )
    # The session is computed twice: its peak, then its motion.
    with counted_progress(f"checking {path.name}", 2 * least) as report:
        plan = plan_session(config, rig, source=str(path), report=report)
        problems = session_problems(config, rig, plan, report)
    _report(problems, f"{path}: on rig {rig.name}")
    records = sum(step.kind == "record" for step in plan.steps)
    untraced = "trace" in config.then and rig.model is None
    return (
        f"session, {len(plan.steps)} steps, {records} record{'s' * (records != 1)}, "
        f"{plan.cycles / plan.rate_hz:.0f} s at {plan.rate_hz:g} Hz"
        + ("; then: trace needs a model, and the rig names none" if untraced else "")
    )


def _model(config: ModelConfig, path: Path) -> str:
    import numpy as np

    from ..config.base import ConfigError
    from ..identification.greybox.declared_model_from_config import declared_model
    from ..model.declared_model import ModelError
    from ..model.effects.effect_serialization import placed_effects

    try:
        model = declared_model(config)
        M = model.at().M
        # Equations that are scaled differently have an M without symmetry, which says nothing.
        if np.allclose(M, M.T) and np.linalg.eigvalsh(M).min() <= 0.0:
            raise ConfigError(
                f"{path}: M: expected positive masses and moments of inertia in every direction "
                f"(a positive definite matrix), found eigenvalues {np.linalg.eigvalsh(M)}"
            )
        placed_effects(config.effects, _places(config))
    except ModelError as error:
        raise ConfigError(f"{path}: {error}") from None
    count = len(config.effects)
    effects = f", {count} effect{'s' * (count != 1)}" if count else ""
    return f"model, {len(model.dof)} DOF, {len(model.values)} parameters{effects}"


def _places(config: ModelConfig) -> Places:
    """Return the valid locations of the model's effects; a model in psi, theta, z is the rig's."""
    from ..config.rig import load_rig
    from ..config.shipped import shipped
    from ..identification.trace.records.record_from_log import imported_places, rig_places

    if {q.name for q in config.dof} == {"psi", "theta", "z"}:
        return rig_places(load_rig(shipped("rigs/loopback.yaml")).geometry, config)
    return imported_places(config)


def _sim(config: SimConfig, path: Path) -> str:
    from ..sim.effects.check_effect_source import check_effects

    read = check_effects(config.effects, path)
    count = len(config.effects)
    summary = f"simulator, plant {config.plant}, {count or 'no'} effect{'s' * (count != 1)}"
    files = ", ".join(dict.fromkeys(file.name for file in read))
    return f"{summary}; {files} read, not run" if files else summary
