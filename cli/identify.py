"""`levid identify`: from logs to the plant, with a report."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import click

from ..config.base import load_yaml
from ..config.model import load_model
from ..config.shipped import shipped
from ..config.sim import SimConfig
from ..identification.data import IdentificationError, Record
from ..identification.declared import declared_model
from ..identification.from_log import NotARecordError, from_log
from ..identification.identify import identify
from ..identification.options import Options
from ..identification.results import IdentificationResult
from ..identification.summary import summary
from ..log.reader import read_log
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
    help="Declared model, whose known lag is used; config/models/rig.yaml for logs of the rig.",
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
@click.option("--json", "as_json", is_flag=True, help="Print the result as one JSON object.")
def command(
    logs: tuple[Path, ...], model: Path | None, truth: Path | None, out: Path, as_json: bool
) -> int:
    """Identify the plant from LOGS: all records at all beam positions, from nothing but the logs.

    Logs of a session that are no records (rising, moving, landing) are drawn but not identified.

    \b
    Examples:
      levid identify out/first/*.mcap --out out/first/identification
      levid identify arm.mcap --out out/arm --json
    """
    result, page = identify_logs(logs, model, truth, out)
    if as_json:
        click.echo(json.dumps({**summary(result), "report": str(page)}))
        return 0
    for line in words(result):
        click.echo(line)
    click.echo(f"report: {page}")
    return 0


def identify_logs(
    logs: Sequence[Path], model: Path | None, truth: Path | None, out: Path
) -> tuple[IdentificationResult, Path]:
    """Identify logs and write the report; return the result and the page's path."""
    with progress("identifying") as report:
        records: list[Record] = []
        skipped: list[str] = []
        for number, path in enumerate(logs):
            report(path.name, 0.2 * number / len(logs))
            try:
                records.append(from_log(read_log(path)))
            except NotARecordError as error:
                skipped.append(str(error))
        result = identify(
            records,
            Options(lag_s=_lag_s(records, model)),
            lambda what, share: report(what, 0.2 + 0.6 * share),
            skipped,
        )
        report("report", 0.8)
        flown = None if records[0].controller is None else read_session(logs)
        page = identification_report(result, flown, out, _truth(truth, result))
    return result, page


def words(result: IdentificationResult) -> list[str]:
    """Return what was found, a line an operating point."""
    lines = []
    for point in summary(result)["points"]:
        beam = point["beam_m"]
        where = "all records" if beam is None else f"beam at {1e3 * beam:+.1f} mm"
        gap = f", gap {point['order_gap']:.1f}" if "order_gap" in point else ""
        fits = [fit for h in point["holdout"] for fit in h["simulated_fit_percent"] if fit]
        best = f", fit on held-out rows up to {max(fits):.2f} %" if fits else ""
        lines.append(f"{where}: {len(point['records'])} records, order {point['order']}{gap}{best}")
    return lines


def _lag_s(records: Sequence[Record], model: Path | None) -> float:
    if model is None:
        if not records or records[0].controller is None:
            return 0.0
        model = shipped("models/rig.yaml")
    return declared_model(load_model(model)).at().lag_s


def _truth(path: Path | None, result: IdentificationResult) -> Truth | None:
    if path is None:
        return None
    config, rate_hz = load_yaml(path, SimConfig), 1.0 / result.signals.Ts_s
    if any(point.beam_m is None for point in result.points):
        raise IdentificationError("--truth: expected logs of the rig, found records without a beam")
    return lambda beam_m, freq_hz: frequency_response(config, beam_m or 0.0, freq_hz, rate_hz)
