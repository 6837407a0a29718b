"""`levid identify`: identify the plant from logs and write a report."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..config.command_line import command_line
from .full_option import full_option
from .output_folder_check import claimed_folder, naming_options, older_results
from .path_types import FOLDER, LOG, MODEL, SIM
from .progress import progress, say
from .report_errors import exit_code_of_report, report_or_error

if TYPE_CHECKING:
    from ..api.identification import Identification
    from ..identification.run_identification import Study


_REAL = 1.0 - 1e-9
"""Damping ratio of a real pole, up to rounding."""
_RESULTS = ("model.yaml", "identified.mat", "multisine.mat")


@click.command("identify")
@click.argument("logs", nargs=-1, required=True, type=LOG)
@click.option(
    "--model",
    type=MODEL,
    help="MODEL.yaml to fit. Default: the model of the rig in the logs; imported data have none.",
)
@click.option(
    "--truth",
    type=SIM,
    help="SIM.yaml of the simulated flight: the report draws its true response for comparison; "
    "the identification does not use it.",
)
@click.option(
    "--order",
    metavar="N",
    type=click.IntRange(1, 50),
    help="Number of states; default: chosen from the data.",
)
@click.option(
    "--impulse-s",
    metavar="S",
    type=click.FloatRange(min=0.0, min_open=True),
    help="Length of the impulse response in s; default: chosen from the data.",
)
@click.option(
    "--markov",
    type=click.Choice(["least_squares", "correlation"]),
    default="least_squares",
    show_default=True,
    help="Estimator of the impulse response; see docs/correlation.md.",
)
@click.option(
    "--band",
    nargs=2,
    metavar="LOW HIGH",
    type=click.FloatRange(min=0.0),
    help="Frequencies in Hz that the fit of the declared model to a rig's records uses; default: "
    "as far as the excitation shows.",
)
@click.option("--out", required=True, type=FOLDER, help="Folder of the report.")
@click.option("--mat", is_flag=True, help="Also write OUT/identified.mat for MATLAB and Octave.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as one JSON object.")
@full_option
def command(
    logs: tuple[Path, ...],
    model: Path | None,
    truth: Path | None,
    order: int | None,
    impulse_s: float | None,
    markov: str,
    band: tuple[float, float] | None,
    out: Path,
    mat: bool,
    as_json: bool,
    full: bool,
) -> int:
    """Identify the plant from the records in LOGS, at all beam positions.

    White noise gives Markov parameters, the sensitivity and a Ho-Kalman state-space model.
    Orthogonal multisines give the best linear approximation, with noise and nonlinear distortion
    separated. The declared model is fitted to all records and written to OUT/model.yaml with
    standard errors. Prints the results and the path of the report.

    \b
    Examples:
      levid identify out/first/*.mcap --out out/first/identification
      levid identify out/first/*.mcap out/beam/*.mcap --out out/all --mat
      levid identify arm.mcap --out out/arm --json
      levid identify arm.mcap --order 6 --impulse-s 0.4 --out out/arm-6
      levid identify out/first/*.mcap --band 1 40 --out out/first/low
    """
    from ..report.plotting.min_max_bins import all_samples

    began = time.time()
    with all_samples(full):
        found, undrawn = identify_logs(logs, model, truth, out, order, impulse_s, markov, band)
    if mat:
        found.write_mat(out)
    for old in older_results(out, _RESULTS, began):
        say(f"warning: {old} is from an earlier run; this run has no such result")
    if as_json:
        click.echo(json.dumps(found.to_json()))
        return exit_code_of_report(undrawn)
    for line in words(found):
        click.echo(line)
    if found.page is not None:
        click.echo(f"report: {found.page}")
    return exit_code_of_report(undrawn)


def identify_logs(
    logs: Sequence[Path],
    model: Path | None,
    truth: Path | None,
    out: Path,
    order: int | None = None,
    impulse_s: float | None = None,
    markov: str = "least_squares",
    band: tuple[float, float] | None = None,
) -> tuple[Identification, Exception | None]:
    """Identify the plant from logs and write the report and model.yaml to `out`.

    Returns the results, and the error if the report could not be written.

    Remarks that are known before the fits are printed on stderr at once.

    Raises:
        ConfigError: `out` cannot be written, or a model or simulator file is wrong.
        IdentificationError: the logs cannot be identified.
    """
    from ..api.identify import identify
    from ..api.result_file import REPORT_FILES, REPORT_FOLDERS
    from ..api.session import Session
    from ..identification.options import Options

    options = Options(markov=markov, order=order, impulse_s=impulse_s, band_hz=band)
    claim = claimed_folder(out, REPORT_FILES, REPORT_FOLDERS)
    with naming_options(), claim, progress("identifying") as report:
        found = identify(
            Session(logs),
            model,
            options,
            truth,
            lambda what, share: report(what, 0.85 * share),
            lambda remark: say(f"warning: {remark}"),
        )
        report("report", 0.85)
        given: dict[str, object] = {"model": model, "truth": truth, "order": order}
        given["impulse_s"], given["band"] = impulse_s, band
        if markov != "least_squares":
            given["markov"] = markov
        command = command_line("identify", logs=logs, **given, out=out)
        undrawn = report_or_error(lambda: found.report(out, command))
    return found, undrawn


def words(identified: Identification) -> list[str]:
    """Return the results as lines of text, the answer first; +- is a 95 % interval."""
    from ..identification.records.record import OTHER_STEP
    from ..identification.results_to_json import study_summary
    from ..identification.subspace.response_uncertainty import SURE_95

    found, answer = identified.results, identified.answer
    plain = study_summary(found)
    names = [output["name"] for output in plain.get("outputs", [])]
    lines = [answer]
    lines += [line for point in plain.get("points", []) for line in _point(point, names, answer)]
    lines += _multisine(plain.get("multisine", []))
    grey = plain.get("grey_box")
    if grey:
        lines += [
            f"{name:>12} = {p['value']:.7g} +- {SURE_95 * p['se']:.2g} {p['unit']}"
            + (" (at its bound)" if name in grey["at_bound"] else "")
            for name, p in grey["parameters"].items()
            if p["se"] is not None
        ]
        lines += grey["unidentifiable"]
        lines += _modes(grey["loop"]["modes"] if grey["loop"] else [])
        if any(point["kind"] == "open loop" for point in plain.get("points", [])):
            lines += _errors(grey["validation"], names)
    # Omit notes on skipped steps (harmless) and notes already printed as warnings.
    # Omit what the answer says, too.
    warned = _contradictions(found)
    lines += [
        f"note: {note}"
        for note in plain["notes"]
        if OTHER_STEP not in note and note not in warned and note.split(": ", 1)[-1] not in answer
    ]
    return lines


def _multisine(blas: Sequence[dict[str, Any]]) -> list[str]:
    """Return a line per position and level: number of lines, and whether outputs are distorted.

    p-values are multiplied by the number of tests (Bonferroni), as in the report.
    """
    from ..report.identification.significance import SIGNIFICANT

    def least(test: str) -> list[float]:
        found = [[p for p in b["tests"][test]["p_value"] if p is not None] for b in blas]
        tests = sum(map(len, found))
        return [tests * min(own) if own else math.nan for own in found]

    chances = {test: least(test) for test in ("distortion", "even", "odd")}
    texts = []
    places = [_where(bla["beam_m"]) for bla in blas]
    for k, (bla, place) in enumerate(zip(blas, places, strict=True)):
        if any(of_all[k] < SIGNIFICANT for of_all in chances.values()):
            result = "found"
        elif math.isnan(chances["distortion"][k]):
            result = "not testable with one realisation"
        else:
            result = "not found"
        of = f" of {', '.join(bla['records'])}" if places.count(place) > 1 else ""
        texts.append(f"{place}: multisine{of}, {bla['lines']} lines, distortion {result}")
    return texts


def _point(point: dict[str, Any], names: list[str], answer: str) -> list[str]:
    ratio = ""
    in_loop = point["kind"] == "closed loop"
    if in_loop and point["subspace"] is not None:
        others = point["subspace"]["doubtful_orders"]
        ratio = f", {point['subspace']['order']} states of the plant by subspace"
        if others:
            ratio += f" ({' or '.join(map(str, others))} are nearly as likely)"
    elif not in_loop and point["markov"]:
        ratio = f", impulse response of {_impulse(point['impulse'])}"
    count = len(point["records"])
    line = f"{_where(point['beam_m'])}: {count} record{'s' * (count != 1)}, order {point['order']}"
    lines = [f"{line}{ratio}"]
    lines += [f"  unreliable: {doubt}" for doubt in point["doubts"] if doubt not in answer]
    of_records = tuple(f"{record}: " for record in point["records"])
    lines += [f"  note: {text}" for text in point["remarks"] if not text.startswith(of_records)]
    if in_loop:
        return lines
    lines += _modes(point["model"]["modes"])
    for held in point["holdout"]:
        for kind, fits in (
            ("simulated", held["simulated_fit_percent"] if point["stable"] else None),
            ("one step ahead", held["predicted_fit_percent"]),
        ):
            texts = [
                f"{name} constant" if fit is None else f"{name} {fit:.1f} %"
                for name, fit in zip(names, fits or [], strict=False)
            ]
            if texts:
                lines.append(f"  {held['rows']} held-out rows, {kind}: {', '.join(texts)}")
    return lines


def _impulse(impulse: dict[str, Any]) -> str:
    chosen_by = impulse["chosen_by"]
    if chosen_by == "validation":
        tried = sorted(map(int, impulse["validation_error"]))
        chosen_by = f"of {', '.join(map(str, tried))} by validation"
    return f"{impulse['length_s']:.3g} s ({impulse['taps']} rows, {chosen_by})"


def _modes(modes: Sequence[dict[str, Any]]) -> list[str]:
    """Return a line for each mode with an interval; +- is a 95 % interval."""
    from ..identification.subspace.response_uncertainty import SURE_95

    lines = []
    for m in modes:
        if m["frequency_se_hz"] is None or m["damping_se"] is None:
            continue
        f, f_half = m["frequency_hz"], SURE_95 * m["frequency_se_hz"]
        if abs(m["damping"]) > _REAL:
            pole, half = -2 * math.pi * f * math.copysign(1.0, m["damping"]), 2 * math.pi * f_half
            lines.append(f"  pole: {pole:.4g} +- {half:.2g} 1/s")
            continue
        damping = f"{m['damping']:.3g} +- {SURE_95 * m['damping_se']:.2g}"
        lines.append(f"  mode: {f:.5g} +- {f_half:.2g} Hz, damping ratio {damping}")
    return lines


def _errors(validation: Sequence[dict[str, Any]], names: Sequence[str]) -> list[str]:
    """Return a line for each record of imported data: errors in per cent of output and force."""
    lines = []
    for v in validation:
        metric = "free run"
        if v["metric"] == "prediction":
            metric = f"predicted {v['horizon_s']:.2g} s ahead"
        of = [f"{n} {p:.2g} %" for n, p in zip(names, v["percent"], strict=False) if p is not None]
        force = [f"{p:.3g} %" for p in v["force_percent"] if p is not None]
        text = f"{v['record']}: error over output, {metric}: {', '.join(of)}"
        lines.append(
            text + (f"; residual force over input force: {', '.join(force)}" if force else "")
        )
    return lines


def _where(beam_m: float | None) -> str:
    return "all records" if beam_m is None else f"beam at {1e3 * beam_m:+.1f} mm"


def _contradictions(found: Study) -> tuple[str, ...]:
    return () if found.grey is None else found.grey.remarks
