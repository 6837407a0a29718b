"""`levid trace`: find the physical effects that a model lacks, from logs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..config.command_line import command_line
from ..identification.value_with_interval import told_from_zero, value_with_interval
from .full_option import full_option
from .output_folder_check import claimed_folder, naming_options
from .path_types import FOLDER, LOG, MODEL
from .progress import progress, say
from .report_errors import exit_code_of_report, report_or_error

if TYPE_CHECKING:
    from ..api.trace import Trace
    from ..identification.trace.run_trace import Trace as RigTrace
    from ..identification.trace.trace_outcome import FoundEffect, Outcome


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
@full_option
def command(
    logs: tuple[Path, ...],
    model: Path | None,
    out: Path,
    as_json: bool,
    workers: int | None,
    dask: str | None,
    full: bool,
) -> int:
    """Find the physical effects that LOGS show and the declared model lacks.

    The model is fitted to the records and its residual is compared with a table of effects. An
    effect is accepted if it lowers the error on rows that did not fit it by more than chance.
    Imported records may come from an unknown controller, and from an unstable plant.
    On a rig's records the search ends after ten minutes; a note says so.
    OUT/model.yaml is the refitted model with the accepted effects; identify, trace and the
    simulator read it. Prints the effects, their evidence, the next command and the report's path.

    \b
    Examples:
      levid excite trace --virtual --out out/trace
      levid trace out/trace/*.mcap --out out/trace/found
      levid trace out/trace/*.mcap --model out/trace/found/model.yaml --out out/again --json
      levid trace out/trace/*.mcap --dask tcp://127.0.0.1:8786 --out out/found
      levid trace drive.mcap --model drive.yaml --out out/drive
    """
    if workers is not None and dask is not None:
        raise click.UsageError("expected --workers or --dask, found both")
    if dask is not None and find_spec("distributed") is None:
        raise click.UsageError("--dask needs the package distributed: pip install 'levid[cluster]'")
    if dask is not None:
        say(f"tracing on the cluster at {dask}")
    from ..report.plotting.min_max_bins import all_samples

    with all_samples(full):
        traced = trace_logs(logs, model, out, workers, dask)
    found = traced.found
    if as_json:
        click.echo(json.dumps(found.to_json()))
    else:
        _print(found, logs, out)
    return exit_code_of_report(traced.undrawn)


def _print(found: Trace, logs: Sequence[Path], out: Path) -> None:
    for line in words(found):
        click.echo(line)
    if found.model_file is not None:
        click.echo(f"model: {found.model_file}")
    if found.page is not None or _is_imported(found):
        click.echo(f"next: {_next(found, logs, out)}")
    if found.page is not None:
        click.echo(f"report: {found.page}")


@dataclass(frozen=True)
class Traced:
    """Result of a trace, and the error if model.yaml or the report could not be written."""

    found: Trace
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
    from ..api.result_file import REPORT_FILES, REPORT_FOLDERS
    from ..api.session import Session
    from ..api.trace import trace

    claim = claimed_folder(out, REPORT_FILES, REPORT_FOLDERS)
    with naming_options(), claim, progress("tracing") as report:
        found = trace(
            Session(logs),
            model,
            workers,
            dask,
            lambda what, share: report(what, 0.9 * share),
            say,
        )
        report("report", 0.95)
        command = command_line("trace", logs=logs, model=model, out=out)
        return Traced(found, report_or_error(lambda: found.report(out, command)))


def words(found: Trace) -> list[str]:
    """Return the results as lines of text; +- is a 95 % interval."""
    from ..identification.trace.run_trace import Trace as RigTrace
    from .trace_imported import words_of

    results = found.results
    return _words(results) if isinstance(results, RigTrace) else words_of(results)


def _words(found: RigTrace) -> list[str]:
    from ..identification.records.record import OTHER_STEP
    from ..identification.trace.found_effects_summary import outcome
    from ..identification.trace.residual.free_run_error import percent_of_pose
    from ..identification.trace.trace_outcome import NO_STILL, PERHAPS_A_PART
    from ..report.trace.answer import rig_answer

    result = outcome(found)
    if result.noise_measured:
        before, after = result.before / result.floor, result.after / result.floor
        lines = [
            f"error on held-out records: {before:.3g} times the noise before, {after:.3g} after"
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
    lines[:0] = [rig_answer(result)]
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
    from ..identification.trace.trace_outcome import telling

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
    lines.append(f"    {share}{data} it (by {why.statistic:.0f} standard errors)")
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
        + ("" if told_from_zero(p.value, p.se) else " (not told from 0)")
        for name, p in found.parameters().items()
        if p.value != 0.0 or p.se
    )


def _next(found: Trace, logs: Sequence[Path], out: Path) -> str:
    """Return the recommended next command or experiment."""
    from ..identification.trace.found_effects_summary import outcome
    from ..identification.trace.run_trace import Trace as RigTrace

    results = found.results
    if isinstance(results, RigTrace):
        return _next_of_rig(outcome(results), logs, out)
    if results.exchange is not None:
        return "compare columns and units in the signals files with the rig, import and trace again"
    return _identify_with(logs, out)


def _is_imported(found: Trace) -> bool:
    from ..identification.trace.run_trace import Trace as RigTrace

    return not isinstance(found.results, RigTrace)


def _identify_with(logs: Sequence[Path], out: Path) -> str:
    model, where = out / "model.yaml", out / "identification"
    return command_line("identify", logs=logs, model=model, out=where)


def _next_of_rig(result: Outcome, logs: Sequence[Path], out: Path) -> str:
    from ..identification.trace.trace_outcome import telling

    rivals = [f for f in result.effects if f.evidence is not None and f.evidence.alternatives]
    if rivals:
        name, how = rivals[0].effect.name, telling(rivals[0]) or "another excitation"
        return f"to distinguish {name} from its alternatives, fly: {how}"
    if result.shaken and not result.effects:
        return "find the source of the random force, which limits the model's accuracy"
    if result.significant:
        return f"see the report ({out / 'index.html'}) for the signals that the residual depends on"
    if result.effects:
        return _identify_with(logs, out)
    if result.overrated:
        return "record or import data at a higher rate: the noise cannot be determined at this one"
    return "no further step: these records show no error above the noise"
