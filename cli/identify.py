"""`levid identify`: from logs to the plant, with a report."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import click

from ..config.base import load_yaml
from ..config.model import ModelConfig, load_model
from ..config.shipped import shipped
from ..config.sim import SimConfig
from ..identification.data import IdentificationError
from ..identification.export import write_mat
from ..identification.greybox.result import to_yaml
from ..identification.options import Options
from ..identification.study import Study, study
from ..identification.summary import study_summary
from ..log.reader import Log
from ..report.closed_loop import Truth
from ..report.flown import read_session
from ..report.identification import identification_report
from ..sim.truth import frequency_response
from .progress import progress


@click.command("identify")
@click.argument("logs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--model",
    type=click.Path(path_type=Path),
    help="Declared model to fit; config/models/rig.yaml for logs of the rig, none for others.",
)
@click.option(
    "--truth",
    type=click.Path(path_type=Path),
    help="SIM.yaml that flew the logs: its true response is drawn beneath, and never used.",
)
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path),
    help="Folder of the report, index.html.",
)
@click.option("--mat", is_flag=True, help="Write identified.mat for MATLAB and Octave too.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as one JSON object.")
def command(
    logs: tuple[Path, ...],
    model: Path | None,
    truth: Path | None,
    out: Path,
    mat: bool,
    as_json: bool,
) -> int:
    """Identify the plant from LOGS: all records at all beam positions, from nothing but the logs.

    White noise gives Markov parameters, Ho-Kalman and the sensitivity; orthogonal multisines the
    best linear approximation with noise and distortion apart; all records together a fit of the
    declared model, written to OUT/model.yaml with standard errors.

    \b
    Examples:
      levid identify out/first/*.mcap --out out/first/identification
      levid identify out/first/*.mcap out/beam/*.mcap --out out/all --mat
      levid identify arm.mcap --out out/arm --json
    """
    found, page = identify_logs(logs, model, truth, out)
    if mat:
        if found.points is None:
            raise IdentificationError("--mat: expected records of white noise, found none")
        write_mat(out / "identified.mat", found.points)
    if as_json:
        click.echo(json.dumps({**study_summary(found), "report": str(page)}))
        return 0
    for line in words(found):
        click.echo(line)
    click.echo(f"report: {page}")
    return 0


def identify_logs(
    logs: Sequence[Path], model: Path | None, truth: Path | None, out: Path
) -> tuple[Study, Path]:
    """Identify logs, write report and model.yaml; return what was found and the page's path."""
    declared = None if model is None else load_model(model)
    flown = False

    def model_of(log: Log) -> ModelConfig | None:
        nonlocal flown
        flown = "rig.yaml" in log.attachments
        return load_model(shipped("models/rig.yaml")) if flown and not declared else declared

    with progress("identifying") as report:
        found = study(logs, model_of, Options(), lambda what, share: report(what, 0.85 * share))
        report("report", 0.85)
        page = identification_report(
            found.points,
            read_session(logs) if flown else None,
            out,
            _truth(truth, found),
            found.grey,
            found.multisine,
        )
    if found.grey is not None:
        (out / "model.yaml").write_text(to_yaml(found.grey.fitted))
    return found, page


def words(found: Study) -> list[str]:
    """Return what was found, a line an operating point or a parameter."""
    plain = study_summary(found)
    lines = []
    for point in plain.get("points", []):
        beam = point["beam_m"]
        where = "all records" if beam is None else f"beam at {1e3 * beam:+.1f} mm"
        gap = f", gap {point['order_gap']:.1f}" if "order_gap" in point else ""
        fits = [fit for h in point["holdout"] for fit in h["simulated_fit_percent"] if fit]
        best = f", fit on held-out rows up to {max(fits):.2f} %" if fits else ""
        lines.append(f"{where}: {len(point['records'])} records, order {point['order']}{gap}{best}")
    for bla in plain.get("multisine", []):
        lines.append(
            f"beam at {1e3 * (bla['beam_m'] or 0.0):+.1f} mm: multisine, {bla['lines']} lines"
        )
    grey = plain.get("grey_box")
    if grey:
        for name, p in grey["parameters"].items():
            if p["se"] is not None:
                lines.append(f"{name:>12} = {p['value']:.7g} +- {p['se']:.2g} {p['unit']}")
        lines += grey["unidentifiable"]
    return lines


def _truth(path: Path | None, found: Study) -> Truth | None:
    if path is None:
        return None
    config = load_yaml(path, SimConfig)
    points = found.points.points if found.points is not None else ()
    if any(point.beam_m is None for point in points):
        raise IdentificationError("--truth: expected logs of the rig, found records without a beam")
    rate_hz = 1.0 / (found.points.signals.Ts_s if found.points else found.multisine[0].Ts_s)
    return lambda beam_m, freq_hz: frequency_response(config, beam_m or 0.0, freq_hz, rate_hz)
