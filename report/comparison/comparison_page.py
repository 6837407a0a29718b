"""Write the page of `levid compare`: verdict, parameters, responses of both models."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...identification.comparison.compare_results import Comparison, OneSided
from ...identification.comparison.parameter_differences import Difference
from ...identification.comparison.response_differences import (
    ModelResponse,
    PathDeviation,
    ResponseComparison,
)
from ...identification.subspace.response_uncertainty import SURE_95
from ...identification.value_with_interval import interval_decimals
from ..figures.bode import bode_magnitude, bode_phase
from ..plotting.figure_to_svg import Picture, to_svg
from ..plotting.html_page import Figures, Number, Part, Section, Table, Text, write_report
from ..plotting.labelled_frequency_responses import Curve, Range, SignalLabels, symbol
from ..plotting.number_format import chance, unit_text
from ..plotting.style import line_of
from .deviation_figure import deviation_figure

Array = NDArray[np.float64]


def comparison_page(found: Comparison, out: Path) -> Path:
    """Write the page into the folder `out`, and return its path; raises OSError."""
    sections = [Section("Answer", tuple(_answer(found)))]
    if found.parameters:
        sections.append(Section("Parameters", tuple(_parameters(found))))
    if found.only_a or found.only_b:
        sections.append(Section("Effects in one result only", (_one_sided(found),)))
    if found.response is not None:
        sections.append(Section("Frequency responses", tuple(_responses(found, found.response))))
    sections.append(Section("Method", tuple(_method(found))))
    return write_report(out, "Comparison of two results", sections)


def _answer(found: Comparison) -> list[Part]:
    count = len(found.significant)
    numbers = [
        Number(
            f"{count} of {found.tested}",
            "parameters differ by more than chance",
            "none" if count else "good",
        )
    ]
    if found.whole is not None:
        p = found.whole[2]
        numbers.append(
            Number(chance(p), "probability that chance alone makes the models differ as much")
        )
    paths = _main_paths(found)
    if paths:
        level = max(paths, key=lambda p: abs(p.decibel))
        numbers.append(
            Number(
                f"{abs(level.decibel):.2g} dB",
                f"largest deviation of the response from {symbol(level.input)} to "
                f"{symbol(level.output)}, at {level.decibel_at_hz:.3g} Hz",
            )
        )
    return [
        Text(f"{found.verdict[:1].upper()}{found.verdict[1:]}.", "lead"),
        Text(f"A is {found.a.path}. B is {found.b.path}."),
        Figures(tuple(numbers)),
        *(Text(f"{note[:1].upper()}{note[1:]}.", "note") for note in found.notes),
    ]


def _parameters(found: Comparison) -> list[Part]:
    order = sorted(found.parameters, key=lambda d: -abs(d.in_errors or 0.0))
    rows = tuple(
        (
            f"{name_of(d)} [{_unit_words(unit)}]" if unit else name_of(d),
            *values,
            "" if d.in_errors is None else f"{d.in_errors:+.1f}".replace("-", "−"),
            "" if d.p_value is None else "yes" if d.significant else "no",
        )
        for d in order
        for *values, unit in (value_cells(d),)
    )
    head = ("parameter", "A", "B", "B − A", "std. errors", "differs")
    caption = (
        "Values with 95 % intervals, the most different first; B − A also over its standard error"
    )
    return [Table(caption, head, rows)]


def _unit_words(unit: str) -> str:
    """Return a unit with its power of ten as a reader writes it: 10⁻³ kg m²."""
    return unit_text(re.sub(r"^1e(-?\d+)", r"10^\1", unit))


def name_of(d: Difference) -> str:
    """Return the name of a parameter, with its effect if it is of one."""
    return f"{d.name} ({d.effect})" if d.effect else d.name


def value_cells(d: Difference) -> tuple[str, str, str, str]:
    """Return A, B, B - A with 95 % intervals, to the second digit of the interval, and unit."""
    halves = [None if not se else SURE_95 * se for se in (d.a.se, d.b.se, d.se)]
    known = [h for h in halves if h]
    least = min(known) if known else max(abs(d.difference), 1e-12)
    largest = max(abs(d.a.value), abs(d.b.value), least)
    power = math.floor(math.log10(largest))
    power = 0 if -1 <= power < 6 else power
    digits = min(max(interval_decimals(least) + power, 0), 12)
    texts = []
    for value, half in zip((d.a.value, d.b.value, d.difference), halves, strict=True):
        text = f"{value / 10.0**power:.{digits}f}".replace("-", "−")
        texts.append(f"{text} ± {half / 10.0**power:.{digits}f}" if half else text)
    unit = "" if d.unit in ("", "1") else d.unit
    unit = f"1e{power} {unit}".strip() if power else unit
    return texts[0], texts[1], texts[2], unit


def _one_sided(found: Comparison) -> Table:
    def rows(side: str, effects: Sequence[OneSided]) -> list[tuple[str, ...]]:
        return [
            (e.name, side, ", ".join(f"{n} = {v}" for n, v in e.values.items())) for e in effects
        ]

    all_rows = (*rows("A", found.only_a), *rows("B", found.only_b))
    return Table("Effects that one result has", ("effect", "in", "parameters"), all_rows, labels=3)


def _responses(found: Comparison, response: ResponseComparison) -> list[Part]:
    at = ", ".join(f"{name} = {value:g}" for name, value in response.schedule.items())
    signals = _signals(found)
    shown = Range(float(response.freq_hz[0]), float(response.freq_hz[-1]))
    curves = [
        _curve("A", 0, response.freq_hz, response.a),
        _curve("B", 1, response.freq_hz, response.b),
    ]
    rows = tuple(_path_row(p) for p in response.paths)
    where = f" at {at}" if at else ""
    return [
        Table(
            f"Largest deviation of B from A{where}",
            ("path", "magnitude", "phase", "in standard errors", "p, all frequencies"),
            rows,
        ),
        Picture(
            "deviation",
            to_svg(deviation_figure(response, signals)),
            "Deviation of the responses in dB and degrees over frequency",
            f"Response of B over that of A{where}. Outside of the band at many frequencies: the "
            "models differ; the table counts that there are many frequencies.",
        ),
        Picture(
            "magnitude",
            to_svg(bode_magnitude(curves, signals, shown=shown)),
            "Magnitude of both responses over frequency",
            f"Magnitude of both models{where}.",
        ),
        Picture(
            "phase",
            to_svg(bode_phase(curves, signals, shown=shown)),
            "Phase of both responses over frequency",
            f"Phase of both models{where}, lag and delay included.",
        ),
    ]


def _path_row(p: PathDeviation) -> tuple[str, ...]:
    name = f"{symbol(p.input)} → {symbol(p.output)}"
    if not p.determined:
        return name, "not determined", "", "", ""
    return (
        name,
        f"{p.decibel:+.2g} dB at {p.decibel_at_hz:.3g} Hz".replace("-", "−"),
        f"{p.degree:+.2g}° at {p.degree_at_hz:.3g} Hz".replace("-", "−"),
        f"{p.in_errors:.1f} at {p.in_errors_at_hz:.3g} Hz",
        chance(p.p_value),
    )


def _method(found: Comparison) -> list[Part]:
    texts = [
        "The errors of the two fits are taken as independent and normal: the standard error of a "
        "difference is the root of the sum of both squared standard errors. The p-values of the "
        "parameters are corrected for the number of tests (Holm), so that with 95 % probability no "
        "parameter is called different by chance.",
        "The p-value of a response holds for all frequencies and paths together (Scheffé), and is "
        "cautious. A path whose magnitude is uncertain by more than 30 % is not determined.",
    ]
    if found.whole is not None:
        value, count, _ = found.whole
        texts.append(
            f"All {count} common parameters together: chi-square {value:.4g} with {count} degrees "
            "of freedom (Wald), correlations included."
        )
    return [Text(text) for text in texts]


def _signals(found: Comparison) -> SignalLabels:
    model = found.a.model
    return SignalLabels(
        tuple(q.name for q in model.inputs),
        tuple(q.unit for q in model.inputs),
        tuple(q.name for q in model.dof),
        tuple(q.unit for q in model.dof),
    )


def _curve(label: str, index: int, freq_hz: Array, response: ModelResponse) -> Curve:
    return Curve(
        label,
        line_of(index),
        freq_hz,
        response.H,
        response.deviation,
        response.error_im,
    )


def _main_paths(found: Comparison) -> list[PathDeviation]:
    """Return the paths from each input to its own output; all if their numbers differ.

    Couplings have zeros, where a small change is many dB.
    """
    if found.response is None:
        return []
    n = len(found.a.model.dof)
    paths = found.response.paths
    own = paths[:: n + 1] if len(paths) == n * n else paths
    return [p for p in own if p.determined]
