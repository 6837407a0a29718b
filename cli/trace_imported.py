"""Trace imported records for `levid trace`: call, print the effects, write model and report."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .output_folder_check import claimed_folder, quoted, same_logs
from .progress import progress, say
from .value_with_interval import value_with_interval

if TYPE_CHECKING:
    from ..config.model import EffectParameter
    from ..identification.trace.force_regression.force_trace_summary import FoundLaw
    from ..identification.trace.force_regression.trace_imported import ForceTrace


def is_imported(logs: Sequence[Path], model: Path | None) -> bool:
    """Return whether the first log was imported, and the model has no scheduling variable.

    Along a schedule the missing force has no spectrum; the prediction errors serve for it.
    """
    from ..config.model import load_model
    from ..log.reader import read_log

    if "signals.yaml" not in read_log(logs[0]).attachments:
        return False
    return model is None or not load_model(model).scheduling


def print_imported(logs: Sequence[Path], model: Path | None, out: Path, as_json: bool) -> int:
    """Trace imported logs, write model.yaml and the report to `out`, and print the result.

    Raises:
        ConfigError: `out` cannot be written, or the model file is wrong.
        IdentificationError: the logs cannot be traced.
    """
    from ..config.model import load_model
    from ..identification.greybox.identify_greybox import to_yaml
    from ..identification.records.record import IdentificationError
    from ..identification.trace.force_regression.force_trace_summary import (
        force_summary,
        model_with_effects,
    )
    from ..identification.trace.force_regression.trace_imported import trace_imported
    from ..model.effects.candidate_effects import all_effects
    from ..report.plotting.atomic_write import replace_text
    from ..report.trace.imported_page import imported_report

    if model is None:
        raise IdentificationError(
            f"expected --model MODEL.yaml for {logs[0]}, which is not a log of the rig; found none"
        )
    config = load_model(model)
    undrawn: Exception | None = None
    page = None
    claim = claimed_folder(out, ("model.yaml", "index.html"), ("figures",))
    with claim, progress("tracing") as report:
        found = trace_imported(logs, config, all_effects, lambda what, x: report(what, 0.9 * x))
        written = out / "model.yaml"
        replace_text(written, to_yaml(model_with_effects(found)))
        report("report", 0.95)
        try:
            page = imported_report(found, out)
        except Exception as error:  # noqa: BLE001 - raised after the results are printed
            undrawn = error
    if as_json:
        paths = {"model": str(written), "report": None if page is None else str(page)}
        click.echo(json.dumps({**force_summary(found), **paths, "notes": list(found.notes)}))
    else:
        for line in words_of(found):
            click.echo(line)
        click.echo(f"model: {written}")
        target = out / "identification"
        click.echo(
            f"next: levid identify {same_logs(logs)} --model {quoted(written)} "
            f"--out {quoted(target)}"
        )
        if page is not None:
            click.echo(f"report: {page}")
    if undrawn is not None:
        say("the report could not be written:")
        raise undrawn
    return 0


def words_of(found: ForceTrace) -> list[str]:
    """Return the results as lines of text; +- is a 95 % interval."""
    from ..identification.trace.force_regression.force_trace_summary import (
        declared_effects,
        force_outcome,
        model_with_effects,
    )

    result = force_outcome(found)
    lines = []
    for i, name in enumerate(result.dof):
        force = f"{result.before.force_percent[i]:.3g} % before"
        force += f", {result.after.force_percent[i]:.3g} % after"
        lines.append(f"missing force at {name}, over the force of the inputs: {force}")
        if result.metric == "free_run":
            before, after = result.before.percent[i], result.after.percent[i]
            lines.append(
                f"free-run error of {name}, over the output: {before:.3g} % before, "
                f"{after:.3g} % after"
            )
    lines.append(result.verdict)
    for law in result.laws:
        lines += _law(law)
    for effect, parameters in declared_effects(found):
        lines.append(f"{effect.name}, declared: {_values(parameters)} (95 %)")
    names = found.found.point.parameters.names
    values = [
        f"{name} = {value_with_interval(p.value, p.se)} {p.unit}"
        for name, p in model_with_effects(found).parameters.items()
        if name in names
    ]
    lines.append(f"model: {', '.join(values)}")
    lines += [
        f"record {e.record}: the simulation with effects did not converge; its error is unreliable"
        for e in found.after
        if not e.settled
    ]
    if result.floor is None:
        lines.append(
            "note: no record separates noise from model error: the model may lack more than this"
        )
    return lines + [f"note: {note}" for note in found.notes]


def _law(law: FoundLaw) -> list[str]:
    effect, rated = law.placed.effect, law.rated
    values = _values(law.parameters)
    lines = [f"  {law.name}" + ("" if law.free else f": {values} (95 %)"), f"    {effect.equation}"]
    lines.append(
        f"    explains {100 * rated.share:.3g} % of the squared missing force in held-out blocks "
        f"(z = {rated.gain.statistic:.1f})"
    )
    if law.alternatives:
        how = effect.told_apart_by or "another excitation"
        lines.append(
            f"    these records do not distinguish its members; to distinguish them: {how}"
        )
    if law.doubtful:
        lines.append(f"    in doubt: {'; '.join(law.doubts)}")
    if law.inexact:
        lines.append(f"    not exact: {law.inexact}")
    if law.laws:
        names = ", ".join(r.placed.effect.title for r in law.laws)
        lines.append(f"    other laws for it fit as well: {names}")
    return lines


def _values(parameters: Mapping[str, EffectParameter]) -> str:
    return ", ".join(
        f"{name} = {value_with_interval(p.value, p.se)}"
        + ("" if p.unit in ("", "1") else f" {p.unit}")
        for name, p in parameters.items()
    )
