"""`levid trace`: find the physical effects that a model lacks, from logs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .model_file_errors import naming_the_file
from .output_folder_check import claimed_folder, quoted, same_logs
from .path_types import FOLDER, LOG, MODEL
from .progress import progress, say
from .value_with_interval import value_with_interval

if TYPE_CHECKING:
    from ..config.model import ModelConfig
    from ..identification.trace.found_effects_summary import FoundEffect, Outcome
    from ..identification.trace.run_trace import Trace
    from ..identification.trace.worker_pool import Workers


@click.command("trace")
@click.argument("logs", nargs=-1, required=True, type=LOG)
@click.option(
    "--model",
    type=MODEL,
    help="MODEL.yaml to start from. Default: the model of the rig in the logs.",
)
@click.option("--out", required=True, type=FOLDER, help="Folder of the report.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as one JSON object.")
@click.option(
    "--workers",
    metavar="N",
    type=click.IntRange(min=1),
    help="Number of worker processes. Default: one per processor; imported records need none.",
)
@click.option(
    "--dask",
    metavar="tcp://HOST:PORT",
    help="Scheduler of a dask.distributed cluster to use instead of local processes; its workers "
    "must be able to read the logs.",
)
def command(
    logs: tuple[Path, ...],
    model: Path | None,
    out: Path,
    as_json: bool,
    workers: int | None,
    dask: str | None,
) -> int:
    """Find the physical effects that LOGS show and the declared model lacks.

    The model is fitted to the records and its residual is compared with a table of effects. An
    effect is accepted if it lowers the error on rows that did not fit it by more than chance.
    Imported records may come from an unknown controller, and from an unstable plant.
    OUT/model.yaml is the refitted model with the accepted effects; identify, trace and the
    simulator read it. Prints the effects, their evidence, the next command and the report's path.

    \b
    Examples:
      levid excite config/sessions/trace.yaml --virtual --out out/trace
      levid trace out/trace/*.mcap --out out/trace/found
      levid trace out/trace/*.mcap --model out/trace/found/model.yaml --out out/again --json
      levid trace out/trace/*.mcap --dask tcp://127.0.0.1:8786 --out out/found
      levid trace drive.mcap --model drive.yaml --out out/drive
    """
    if workers is not None and dask is not None:
        raise click.UsageError("expected --workers or --dask, found both")
    from ..identification.trace.found_effects_summary import outcome, summary
    from .trace_imported import is_imported, print_imported

    if is_imported(logs, model):
        return print_imported(logs, model, out, as_json)
    traced = trace_logs(logs, model, out, workers, dask)
    found, page = traced.found, traced.page
    if as_json:
        paths = {"model": traced.model, "report": page}
        written = {name: None if path is None else str(path) for name, path in paths.items()}
        click.echo(json.dumps({**summary(found), **written, "notes": list(found.notes)}))
    else:
        for line in words(found):
            click.echo(line)
        if traced.model is not None:
            click.echo(f"model: {traced.model}")
        if page is not None:
            click.echo(f"next: {_next(outcome(found), logs, out)}")
            click.echo(f"report: {page}")
    if traced.undrawn is not None:
        say("the report could not be written:")
        raise traced.undrawn
    return 0


@dataclass(frozen=True)
class Traced:
    """Result of a trace, paths of model.yaml and the report, and the error if one is missing."""

    found: Trace
    model: Path | None = None
    page: Path | None = None
    undrawn: Exception | None = None


def trace_logs(
    logs: Sequence[Path],
    model: Path | None,
    out: Path,
    workers: int | None = None,
    dask: str | None = None,
) -> Traced:
    """Trace logs and write model.yaml and the report to `out`.

    An error while writing them is returned in `Traced.undrawn`, so that the results are not lost.

    Raises:
        ConfigError: `out` cannot be written, or the model file is wrong.
        IdentificationError: the logs cannot be traced.
    """
    from ..identification.greybox.identify_greybox import to_yaml
    from ..identification.trace.figure_data import views
    from ..identification.trace.found_effects_summary import model_after
    from ..identification.trace.run_trace import trace
    from ..model.effects.candidate_effects import all_effects
    from ..report.plotting.atomic_write import replace_text
    from ..report.trace.trace_page import trace_report

    config = _model(model, logs)
    claim = claimed_folder(out, ("model.yaml", "index.html"), ("figures",))
    with claim, progress("tracing") as report, _workers(config, workers, dask) as spread:
        with naming_the_file(model):
            found = trace(
                logs, config, all_effects, spread, lambda what, share: report(what, 0.9 * share)
            )
        # Save the model first: the results of a long search survive an error in the report.
        written = None
        try:
            replace_text(out / "model.yaml", to_yaml(model_after(found)))
            written = out / "model.yaml"
            report("residual", 0.92)
            residual_views = views(found, spread)
            report("report", 0.97)
            page = trace_report(found, residual_views, out)
        except Exception as error:  # noqa: BLE001 - raised after the results are printed
            return Traced(found, written, None, error)
    return Traced(found, written, page)


def words(found: Trace) -> list[str]:
    """Return the results as lines of text; +- is a 95 % interval."""
    from ..identification.records.record import OTHER_STEP
    from ..identification.trace.found_effects_summary import NO_STILL, PERHAPS_A_PART, outcome
    from ..identification.trace.residual.free_run_error import percent_of_pose

    result = outcome(found)
    if result.noise_measured:
        lines = [
            f"error on held-out records over sensor noise: {result.before:.3g} before, "
            f"{result.after:.3g} after, noise floor {result.floor:.3g}"
        ]
    else:
        pairs = zip(
            found.places.dof,
            percent_of_pose(found.before),
            percent_of_pose(found.after),
            strict=True,
        )
        parts = [f"{name} {b:.3g} % before, {a:.3g} % after" for name, b, a in pairs]
        lines = [f"free-run error on held-out records, over the output: {'; '.join(parts)}"]
    lines.append(result.verdict)
    if result.doubt:
        lines.append(f"unreliable: {result.doubt}. The cause may be an effect that the table lacks")
    for effect in result.effects:
        lines += _effect(effect)
        if result.perhaps_part_of(effect):
            lines.append(f"    {PERHAPS_A_PART}")
        elif effect.evidence and result.in_doubt(effect):
            left = f"{100 * effect.evidence.left_share:.2g} %"
            lines.append(
                f"    in doubt: of the squared prediction error without it, {left} is left"
            )
    for force in result.shaken:
        s = force.shaking
        lines += [
            f"  {force.name}: {value_with_interval(s.rms, s.se)} {force.unit} RMS (95 %)",
            "    also in still records: random, so no model can predict it",
        ]
    lines += [f"{f.effect.name}, declared: {_values(f)}" for f in result.declared]
    lines += [f"removed: {name}, other effects explain the same error" for name in result.gone]
    lines += [
        f"record {name}: the simulation with effects did not converge; its error is unreliable"
        for name in result.unsettled
    ]
    if not result.noise_measured:
        lines.append(f"note: {NO_STILL}")
    # Omit notes on skipped steps (levitate, move, land): they are harmless.
    lines += [f"note: {note}" for note in found.notes if OTHER_STEP not in note]
    return lines


def _effect(found: FoundEffect) -> list[str]:
    from ..identification.trace.found_effects_summary import telling

    effect, why = found.effect, found.evidence
    # The coefficients of a free-form term have no physical meaning.
    values = "" if found.unknown else f": {_values(found)} (95 %)"
    lines = [f"  {effect.name}{values}", f"    {effect.equation}"]
    if why is None:
        return lines
    share = (
        "" if why.share is None else f"explains {100 * why.share:.3g} % of the remaining error; "
    )
    data = "held-out records confirm" if why.held else "cross-validation confirms"
    lines.append(f"    {share}{data} it (z = {why.statistic:.0f})")
    if why.alternatives:
        names = ", ".join(other.name for other in why.alternatives)
        lines.append(f"    these records do not distinguish it from: {names}")
        if telling(found):
            lines.append(f"    to distinguish them: {telling(found)}")
    return lines


def _values(found: FoundEffect) -> str:
    """Return the effect's parameters with 95 % intervals; omit parameters fixed at zero."""
    return ", ".join(
        f"{name} = {value_with_interval(p.value, p.se)}"
        + ("" if p.unit in ("", "1") else f" {p.unit}")
        for name, p in found.parameters().items()
        if p.value != 0.0 or p.se
    )


def _next(result: Outcome, logs: Sequence[Path], out: Path) -> str:
    """Return the recommended next command or experiment."""
    from ..identification.trace.found_effects_summary import telling

    rivals = [f for f in result.effects if f.evidence is not None and f.evidence.alternatives]
    if rivals:
        name, how = rivals[0].effect.name, telling(rivals[0]) or "another excitation"
        return f"to distinguish {name} from its alternatives, fly: {how}"
    if result.shaken and not result.effects:
        return "find the source of the random force, which limits the model's accuracy"
    if result.significant:
        return f"see the report ({out / 'index.html'}) for the signals that the residual depends on"
    if result.effects:
        model, where = out / "model.yaml", out / "identification"
        return f"levid identify {same_logs(logs)} --model {quoted(model)} --out {quoted(where)}"
    if result.overrated:
        return "record or import data at a higher rate: the noise cannot be determined at this one"
    return "no further step: these records show no error above the noise"


def _model(path: Path | None, logs: Sequence[Path]) -> ModelConfig:
    """Return the model in `path`; default: the model of the rig that flew the first log."""
    from ..config.model import load_model
    from ..identification.records.from_log import rig_model
    from ..identification.records.record import IdentificationError
    from ..log.reader import read_log

    if path is not None:
        return load_model(path)
    model = rig_model(read_log(logs[0]))
    if model is None:
        raise IdentificationError(
            f"expected --model MODEL.yaml for {logs[0]}, which is not a log of the rig; found none"
        )
    return model


def _workers(
    config: ModelConfig, processes: int | None, dask: str | None
) -> AbstractContextManager[Workers]:
    from ..identification.trace.worker_pool import cluster_workers, local_workers

    if dask is None:
        return local_workers(config, processes, say)
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise click.UsageError(
            "--dask needs the package distributed: pip install 'levid[cluster]'"
        ) from None
    say(f"tracing on the cluster at {dask}")
    return cluster_workers(config, dask, say)
