"""`levid compare`: compare two results of identify or trace."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .output_folder_check import claimed_folder
from .path_types import FOLDER, RESULT
from .text_table import text_table

if TYPE_CHECKING:
    from ..identification.comparison.compare_results import Comparison
    from ..identification.comparison.response_differences import ResponseComparison


@click.command("compare")
@click.argument("a", type=RESULT)
@click.argument("b", type=RESULT)
@click.option(
    "--at",
    multiple=True,
    metavar="NAME=VALUE",
    help="Scheduling variable at which responses are compared, such as x_b=0.05; "
    "default: as declared in the model.",
)
@click.option("--out", type=FOLDER, help="Folder of a page with Bode plots.")
@click.option("--json", "as_json", is_flag=True, help="Print the comparison as one JSON object.")
def command(a: Path, b: Path, at: tuple[str, ...], out: Path | None, as_json: bool) -> int:
    """Compare the results A and B: folders of identify or trace, or model files.

    Prints which parameters differ by more than their standard errors explain, how far the frequency
    responses of the two models are apart, and which effects only one of them has. The tests take
    the two results as independent: they must not use the same logs.

    \b
    Examples:
      levid compare out/monday/identification out/friday/identification
      levid compare out/a/model.yaml out/b/model.yaml --at x_b=0.05 --out out/compared
      levid compare out/a/trace out/b/trace --json
    """
    from ..identification.comparison.compare_results import compare, comparison_summary
    from ..identification.comparison.saved_result import load_result

    one, other = load_result(a), load_result(b)
    schedule = _schedule(at, set(one.model.scheduling) & set(other.model.scheduling))
    found = compare(one, other, schedule)
    page = None
    if out is not None:
        from ..report.comparison.comparison_page import comparison_page

        with claimed_folder(out, ("index.html",), ("figures",)):
            page = comparison_page(found, out)
    if as_json:
        plain = {**comparison_summary(found), "report": None if page is None else str(page)}
        click.echo(json.dumps(plain))
        return 0
    for line in words(found):
        click.echo(line)
    if page is not None:
        click.echo(f"report: {page}")
    return 0


def _schedule(texts: tuple[str, ...], known: set[str]) -> dict[str, float]:
    found = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name not in known:
            there = ", ".join(sorted(known)) or "none"
            raise click.UsageError(
                f"--at {text}: expected a scheduling variable of both models ({there})"
            )
        try:
            found[name] = float(value)
        except ValueError:
            raise click.UsageError(f"--at {text}: expected {name}=NUMBER") from None
    return found


def words(found: Comparison) -> list[str]:
    """Return the comparison as lines of text, the answer first; +- is a 95 % interval."""
    from ..report.comparison.comparison_page import name_of, value_cells

    lines = [found.verdict, f"A: {found.a.path}", f"B: {found.b.path}"]
    lines += [f"note: {note}" for note in found.notes]
    rows = []
    for d in sorted(found.parameters, key=lambda d: -abs(d.in_errors or 0.0)):
        cells = [cell.replace("±", "+-").replace("−", "-") for cell in value_cells(d)]
        rows.append(
            (
                name_of(d),
                *cells,
                "" if d.in_errors is None else f"{d.in_errors:+.1f}",
                "" if d.p_value is None else _chance(d.p_value),
                "differs" if d.significant else "",
            )
        )
    if rows:
        head = ("parameter", "A", "B", "B - A", "unit", "std errors", "p (Holm)", "")
        lines += ["", *text_table(head, rows, right=(1, 2, 3, 5, 6))]
    if found.whole is not None:
        value, count, p = found.whole
        lines += [
            "",
            f"all {count} parameters together: chi-square {value:.4g}; chance alone makes it as "
            f"large with probability {p:.2g}",
        ]
    if found.response is not None:
        lines += ["", *_response_lines(found.response)]
    for side, effects in (("A", found.only_a), ("B", found.only_b)):
        for effect in effects:
            values = ", ".join(f"{name} = {value}" for name, value in effect.values.items())
            lines.append(f"only in {side}: {effect.name}: {values}")
    return lines


def _response_lines(response: ResponseComparison) -> list[str]:
    at = ", ".join(f"{name} = {value:g}" for name, value in response.schedule.items())
    low, high = response.freq_hz[0], response.freq_hz[-1]
    lines = [f"largest deviation of B from A, {low:.3g} to {high:.3g} Hz{f', {at}' if at else ''}:"]
    rows = [
        (
            f"{p.input} to {p.output}",
            f"{p.decibel:+.2g} dB at {p.decibel_at_hz:.3g} Hz",
            f"{p.degree:+.2g} deg at {p.degree_at_hz:.3g} Hz",
            f"{p.in_errors:.1f} at {p.in_errors_at_hz:.3g} Hz",
            _chance(p.p_value),
        )
        if p.determined
        else (f"{p.input} to {p.output}", "not determined", "", "", "")
        for p in response.paths
    ]
    head = ("path", "magnitude", "phase", "std errors", "p, all frequencies")
    return lines + [f"  {line}" for line in text_table(head, rows)]


def _chance(p_value: float) -> str:
    from ..report.plotting.number_format import chance

    return chance(p_value).replace("10⁻⁴", "1e-4").replace("—", "")
